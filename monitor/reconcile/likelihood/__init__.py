"""Likelihood functions for the noise effects of one axis."""
