"""Time stamps: sample clock, arrival regression, duplicate and late rows, rate check."""
