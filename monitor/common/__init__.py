"""Modules that all packages share: units, compiled kernels, zenoh topics, distributions, minimization, folder locks."""
