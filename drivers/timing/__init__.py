"""Time-stamping of samples, detection of missing, repeated and late samples, and check of the sample rate."""
