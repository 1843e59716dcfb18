"""Sensor drivers.

A link receives bytes, a decoder converts bytes to samples, and a sample clock assigns a time to each sample.
"""
