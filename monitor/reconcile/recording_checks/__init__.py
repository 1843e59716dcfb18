"""Checks of a recording for wrong units, permuted axes, a wrong sample rate, wrong rows and motion.

Without these checks, the search would use many noise effects to explain a wrong unit or a single corrupt row.
``checks.check_recording`` runs the checks and returns the corrected recording with one ``RecordingFinding`` for each
fault. Most checks compare the recording with one simulation of the model under test. The recording and the simulation
are processed in the same way, so that systematic errors of the method cancel.

``sample_rate_from_features`` needs repaired axes, so ``reconcile.reconcile`` calls this check after the preparation.
"""
