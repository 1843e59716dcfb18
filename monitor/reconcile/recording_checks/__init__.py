"""Checks of a recording before any spectrum is fitted: units, axes, sample rate, rows and motion.

A wrong unit or a single corrupt row would otherwise be described by many noise effects. ``checks.check_recording``
runs all checks and returns the corrected recording with one ``RecordingFinding`` for each fault. Each module holds one
check. A check compares the recording with itself, or with one simulation of the model under test. Both are reduced in
the same way, so that all properties of the reduction cancel.

``block_spectra`` holds the spectra that the checks of units and axes share. ``sample_rate`` is the only check that
needs prepared axes. It runs after the preparation.
"""
