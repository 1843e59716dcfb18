"""Diagnostics that compare a recording with a model, and the distribution of their results under the model."""
