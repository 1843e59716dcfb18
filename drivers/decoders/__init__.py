"""Decoders: each module converts one wire format to samples and back. ``base`` defines the interface."""

from typing import Final

SUBPACKAGES: Final = ("binary_frames", "messages", "text_lines")
"""Subpackages that contain decoders. ``dbc`` is a single decoder."""
