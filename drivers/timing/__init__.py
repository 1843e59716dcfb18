"""Assignment of sample times, detection of missing and repeated samples, and check of the sample rate."""
