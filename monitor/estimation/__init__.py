"""What the samples say: windowed Allan variance, its uncertainty, and the coefficients fitted to it."""
