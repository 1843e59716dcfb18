"""Disturbances beyond the terms of IEEE Std 952."""
