"""Fitting and online updating of thermal models, which describe the bias as a function of temperature."""
