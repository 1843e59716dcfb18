"""Compensation of the gyro drift of a vehicle that may be in motion."""
