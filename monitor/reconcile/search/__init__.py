"""Search for missing effects on one axis, and the checks that each name has to pass."""
