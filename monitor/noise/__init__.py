"""Noise models of an IMU, which give the Allan variance, the spectrum and simulated samples."""
