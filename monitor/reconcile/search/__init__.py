"""Search for missing effects on one axis, and tests of the effects that the search adds."""
