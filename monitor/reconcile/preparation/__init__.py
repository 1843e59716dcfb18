"""Preparation of a recording: missing and wrong samples, value statistics, sample rate."""
