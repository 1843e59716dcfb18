"""Preparation of a recording: usable axes, value statistics, repair of samples, and the cosine transform."""
