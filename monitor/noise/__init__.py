"""Noise models of an IMU: effects with their Allan variance, spectrum and time series."""
