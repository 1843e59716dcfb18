"""What the bias does, and taking it out: bias against temperature, drift compensated while the carrier may move."""
