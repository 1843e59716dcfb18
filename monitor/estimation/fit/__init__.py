"""Least-squares fit of the coefficients Q, N, B, K and R to an Allan curve, with confidence intervals."""
