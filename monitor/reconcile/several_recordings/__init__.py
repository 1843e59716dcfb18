"""Comparison of several recordings of one sensor."""
