"""Decoders of serial streams that consist of binary frames. Each module is one decoder."""
