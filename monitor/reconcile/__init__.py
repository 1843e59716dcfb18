"""Search for the noise effects that a sensor model lacks, by comparing a recording with simulations of the model.

Data flow of ``reconcile.reconcile``, which runs all stages:

1. ``recording_checks`` find faults of the recording, such as wrong units and corrupt rows, and correct them.
2. ``preparation`` selects the usable axes, repairs their samples and transforms them to the frequency domain.
3. ``likelihood`` fits effects to one axis and whitens the axis by the fitted model.
4. ``diagnostics`` measure how far the whitened axis differs from white noise. Simulations of the model give the null
   distribution of each diagnostic, and with it the threshold of a significant difference.
5. ``search`` prepares the axes, proposes effects for the differences, and adds the effects that pass all checks.
6. ``description`` converts the searches into a ``result``, and ``report`` encodes the result as JSON.

``several_recordings`` compares the results of several recordings of one sensor. A module imports only from its own
stage and from earlier stages. There are two exceptions: ``recording_checks`` uses ``preparation``, and the check of
the sample rate uses estimates of ``search``. ``result`` contains the types that all stages share.
"""
