"""Attacks: inputs and environments that no careful user would give; all of it: ``pytest tests/attacks -m attack``."""
