"""Coefficients Q, N, B, K and R from an Allan curve, with intervals."""
