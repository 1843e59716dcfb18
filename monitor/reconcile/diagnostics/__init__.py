"""Diagnostics that compare a recording with a model, and their null distribution."""
