"""Drift of the bias: models of bias against temperature, and compensation of gyro drift while the carrier moves."""
