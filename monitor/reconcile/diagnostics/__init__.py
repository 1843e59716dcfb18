"""Diagnostics of the difference between an axis and a model, their null distributions, and the plots of the report."""
