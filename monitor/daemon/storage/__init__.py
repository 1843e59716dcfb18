"""Recording of samples to segment files, and deletion of old segments."""
