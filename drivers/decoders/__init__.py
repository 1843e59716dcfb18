"""Decoders turn bytes into samples and back: one wire format a file, see ``base`` for what one is."""
