"""Diagnostic tests of a whitened axis, the null distributions of the tests, and the data for plots."""
