"""Bias against temperature: model, fit, online update and prediction."""
