"""Attack suite: hostile files, absurd numbers, shared resources and foreign environments.

Cheap cases run with all tests, the others with ``pytest tests/experiments/attacks -m attack``.
"""
