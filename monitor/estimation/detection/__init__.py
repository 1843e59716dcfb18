"""Detection of motion, noise changes, spectral lines, outliers, repeated samples and disagreement with a model."""
