"""Detection of motion, noise changes, spectral lines, outliers and disagreement with the noise model."""
