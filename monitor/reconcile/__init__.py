"""Search for the noise effects that a sensor model lacks, by comparing a recording with simulations of the model.

Data flow of the function ``reconcile.reconcile``:

1. ``preparation`` selects the usable axes, repairs their samples and transforms them to the frequency domain.
2. ``likelihood`` fits effects to one axis and whitens the axis by the fitted model.
3. ``diagnostics`` measures how far the whitened axis differs from white noise. Simulations of the model give the null
   distribution of each diagnostic, from which the threshold of a significant difference follows.
4. ``search`` proposes effects that may explain the differences, and adds the effects that pass all checks.
5. ``description`` converts the search results into a ``Reconciliation``, and ``report`` encodes the result as JSON.

``several_recordings`` compares the results of several recordings of one sensor. A module imports only from the same
stage and from earlier stages. ``result`` contains the types that all stages share.
"""
