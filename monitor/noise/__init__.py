"""Noise models of an IMU, with the Allan variance, the spectrum and the simulation of all effects."""
