"""Allan, total and Hadamard variance with covariance and degrees of freedom."""
