"""Decoders: each module converts one wire format to samples and back. ``base`` defines the interface."""
