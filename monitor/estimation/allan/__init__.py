"""Allan, total and Hadamard variance with their covariances and degrees of freedom."""
