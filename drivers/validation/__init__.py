"""Validation of settings: models of settings, ranges of numbers, and look-up of modules by name."""
