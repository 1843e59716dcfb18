"""Noise terms of IEEE Std 952."""
