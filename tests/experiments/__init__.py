"""Experiments that run on demand: benchmarks, blind trials, fuzzing, attacks and the pictures of the documentation."""
