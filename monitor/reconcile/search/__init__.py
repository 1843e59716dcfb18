"""Search for missing effects on one axis, with the checks that each effect must pass."""
