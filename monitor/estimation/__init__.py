"""Estimation of Allan deviations and noise coefficients, and detection of motion and noise changes."""
