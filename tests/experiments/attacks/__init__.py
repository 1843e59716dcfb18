"""Attack suite: hostile files, absurd numbers, shared resources and unusual environments.

Quick cases run with all tests. The other cases run with ``pytest tests/experiments/attacks -m attack``.
"""
