"""Blind trials of ``reconcile``: effects are hidden in recordings, and the names in the report are compared with them.

    python -m tests.experiments.blind --set singles --level plain --seeds 4 --jobs 2 --out plain.jsonl
    python -m tests.experiments.blind --set all --sizes 0.25 1.2 --seeds 8 --jobs 2 --out power.jsonl
    python -m tests.experiments.blind --report plain.jsonl

``processes`` simulates every effect with algorithms of its own. ``cases`` makes recordings, baseline models and truths.
``oracle`` knows the truth and computes gains of the log-likelihood. ``run`` calls the program on files. ``score``
compares the file ``report.json`` with the truth. The package imports the program under test only for ``--in-process``,
``ablations``, ``corruptions`` and ``null_gains``.

**Levels** are gains of the log-likelihood. At the level *plain*, the gain is at least 50 over the baseline and at least
10 over the best wrong name. At the level *faint*, these gains are 15 and 5. ``cases`` searches the size at which the
gains of the oracle are slightly larger, and stores both gains in the truth. ``--sizes`` multiplies the size by a factor
from a range. At half the size of *plain*, the gain is a quarter. The report then contains the share of right names
against the factor.

**Effects that cannot be identified** are not hidden:

- a clock error if no axis has a line, because N, B, K and the ratio of the rates can replace each other
- temperature effects without a recorded temperature
- a sinusoid against a resonance narrower than about 10/T
- correlated noise with a correlation time above T/30 against a random walk
- random telegraph noise against correlated noise, and Poisson steps against a random walk, if the white noise is larger
  than single jumps
- the direction of a leak between two axes with equal noise. The source axis therefore has a vibration of its own, which
  the model contains.
- a scale factor against equal factors on N, B and K. The scale factor must only gain more than a change of a single
  term.
- a temperature lag against a bias without a lag, if the time constant is short beside all changes of the temperature

**Exact effects** are a single value on a grid, a single repeated sample or several values at a limit. They are
impossible under a continuous distribution, so resolution, sample hold and saturation have no finite gain. Their levels
are sizes, which ``recipes`` lists. A low-pass with any usual cutoff gains thousands in an hour, so its levels are
cutoffs.
"""
