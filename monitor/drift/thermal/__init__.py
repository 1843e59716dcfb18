"""Fit, online update and prediction of thermal models, which describe the bias as a function of temperature."""
