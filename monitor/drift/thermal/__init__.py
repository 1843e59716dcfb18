"""Models of the bias against temperature: fit, online update and prediction."""
