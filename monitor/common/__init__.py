"""Shared by all packages: units, compiled kernels, zenoh topics, distributions, minimization, locks."""
