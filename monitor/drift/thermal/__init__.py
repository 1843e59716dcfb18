"""Models of bias against temperature: fit, online update and prediction."""
