"""Preparation of a recording: selection of axes, repair of samples, and cosine transform."""
