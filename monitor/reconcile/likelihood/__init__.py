"""Likelihood of the noise effects of one axis."""
