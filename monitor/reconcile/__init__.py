"""Search for the noise effects that a sensor model lacks, by comparing a recording with simulations of the model."""
