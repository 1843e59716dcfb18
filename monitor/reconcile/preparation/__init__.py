"""Preparation of a recording: selection of axes, properties of the values, and cosine transform."""
