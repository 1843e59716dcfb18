"""Noise monitor: noise models, estimation, and publication of the results."""
