"""Blind harness of ``reconcile``: effects are hidden in recordings, found as a user would look for them, then scored.

    python -m tests.experiments.blind --set singles --level plain --seeds 4 --jobs 2 --out plain.jsonl
    python -m tests.experiments.blind --set all --sizes 0.25 1.2 --seeds 8 --jobs 2 --out power.jsonl
    python -m tests.experiments.blind --report plain.jsonl

``processes`` draws every effect by algorithms of its own and ``cases`` makes recordings, baseline models and truths
of them; ``oracle`` knows the truth and sets sizes by log-likelihood; ``run`` calls the program on files; ``score``
compares its ``report.json`` with the truth. Nothing here imports the program under test, but for ``--in-process``.

**Levels** are gains of log-likelihood: plain is at least 50 over the baseline and at least 10 over the best wrong
name, faint 15 and 5. ``cases`` searches the size at which the oracle's gains lie a little above; both stand in the
truth. ``--sizes`` multiplies the size by a factor drawn from a range, so that half the plain size has a quarter of its
gain; the report then shows the share of right names against the factor.

**Not identifiable, so not asked for**: a clock error where no axis has a line (the laws of noise have no clock of
their own: N, B, K and the ratio trade); temperature effects without a recorded temperature; a sinusoid against a
resonance narrower than about 10/T; correlated noise whose correlation time is above T/30 (a random walk); random
telegraph against correlated noise, and Poisson steps against random walk, where single jumps drown in the white
noise; the direction of a leak between two axes of equal noise (so the source here shakes by itself, as its model
says); a scale factor against N, B and K that are each retuned by the same factor, but for their number (a lone
retuned N is what it must beat); a lag against a bias that follows at once, where the time constant is short beside
every change of the temperature.

**Exact by nature**: one value on a grid, one repeat or a pile of values at a limit is impossible under a continuous
law, so resolution, sample hold and saturation have no finite gain: their levels are sizes, said in ``recipes``. A
low-pass of any usual cutoff gains thousands in an hour: its levels are cutoffs.
"""
