"""Bias drift: models of the bias against temperature, and compensation of the gyro drift."""
