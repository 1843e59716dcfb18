"""Time-stamping of samples: sample clock, regression of arrival times, duplicate and late rows, and rate check."""
