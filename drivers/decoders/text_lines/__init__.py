"""Decoders of serial streams that consist of text lines. Each module is one decoder."""
