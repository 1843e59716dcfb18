"""Search for the noise effects that a noise model lacks, by comparison of a recording with simulations of the model.

Data flow through the packages:

1. ``recording_checks`` finds faults of the recording, such as wrong units, and corrects them.
2. ``preparation`` selects the usable axes and repairs missing or altered samples.
3. ``likelihood`` fits effects to one axis and whitens the axis by the fitted model.
4. ``diagnostics`` tests whether the whitened axis is white noise.
5. ``search`` adds effects that explain the remaining differences.

``several_recordings`` compares the results of several recordings of one sensor.
"""
