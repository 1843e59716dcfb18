"""Sensor drivers: links that move bytes, decoders that turn bytes into samples, and clocks that time each sample."""
