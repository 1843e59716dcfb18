"""Simulated IMU, which sends samples of a noise model in a real wire format over a real link."""
