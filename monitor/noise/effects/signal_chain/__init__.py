"""Effects of the signal chain of the sensor, such as filters and rounding."""
