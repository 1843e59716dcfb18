"""Compensation of the gyro drift while the carrier may move."""
