"""What an IMU's noise is: effects with their Allan variance, spectrum and time series."""
