"""Likelihoods of effects on one axis."""
