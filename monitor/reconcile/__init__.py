"""Search for the noise effects that a sensor model lacks, by comparing a recording with simulations of the model.

Data flow of ``reconcile.reconcile``, which runs all stages:

1. ``preparation`` selects the usable axes, repairs their samples and transforms them to the frequency domain.
2. ``likelihood`` fits effects to one axis and whitens the axis by the fitted model.
3. ``diagnostics`` measure how far the whitened axis differs from white noise. Simulations of the model give the null
   distribution of each diagnostic, and with it the threshold of a significant difference.
4. ``search`` prepares the axes, proposes effects for the differences, and adds the effects that pass all checks.
5. ``description`` converts the searches into a ``result``, and ``report`` encodes the result as JSON.

``several_recordings`` compares the results of several recordings of one sensor. A module imports only from its own
stage and from earlier stages. ``result`` contains the types that all stages share.
"""
