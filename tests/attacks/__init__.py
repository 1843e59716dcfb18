"""Attacks on a running service. The cheap ones run with all tests, the others with ``pytest tests/attacks -m attack``."""
