"""Compilation of the numerical kernels when the daemon starts."""
