"""Estimation from samples: windowed Allan variance, its uncertainty, fitted coefficients and event detection."""
