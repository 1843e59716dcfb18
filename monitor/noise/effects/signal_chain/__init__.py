"""Effects of the sensor's signal chain, which act on the finished signal."""
