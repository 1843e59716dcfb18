"""Models of the bias as a function of temperature, and compensation of the gyro drift."""
