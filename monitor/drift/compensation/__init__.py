"""Compensation of gyro drift while the carrier may move."""
