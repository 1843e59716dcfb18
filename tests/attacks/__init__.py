"""Attacks on a running service. Cheap ones run with all tests, the others with ``pytest tests/attacks -m attack``."""
