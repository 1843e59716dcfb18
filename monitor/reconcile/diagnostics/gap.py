"""Scores of the difference between measurement and model, with thresholds from simulations of the model.

A gap is √(2 × gain): the size, in standard deviations, of the strongest departure that a diagnostic finds. Its null
distribution comes from recordings that are simulated from the model under test and examined with the same diagnostics.
The gains of a true model are nearly pivotal, that is, the same for all axes and models. The gains of all axes are
therefore pooled. Above their upper quartile q, they decrease as exp(−(g − q)/s). The scale s is the mean excess over q,
limited to [1, 1.3] as for the tails of maxima of χ²/2. ``threshold`` is exceeded on one axis in one diagnostic once in
100 × diagnostics × axes recordings. ``null95`` refers to one diagnostic and one axis alone. If the simulated gains of
an axis lie above the pooled threshold (coarse or clipped values), its threshold is the largest of them plus a margin.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import log, sqrt
from typing import Final

import numpy as np

from drivers.sample import Floats
from monitor.reconcile.diagnostics.diagnostics import DIAGNOSTICS, Finding, WhitenedAxis
from monitor.reconcile.result import Score

FALSE_ALARM_PROBABILITY: Final = 0.01
"""Fraction of the recordings of a true model that pass a threshold in any diagnostic on any axis."""
UPPER_QUANTILE: Final = 0.25
"""Fraction of the gains above which their distribution is modelled as exponential."""
EXCESS_RANGE_NATS: Final = (1.0, 1.3)
"""Limits of the mean excess in nats."""
AXIS_MARGIN_NATS: Final = 3.0
"""Margin in nats above the largest simulated gain of an axis."""

Findings = Mapping[str, Finding]
"""Findings of all diagnostics on one axis, by the name of the diagnostic."""


@dataclass(frozen=True, slots=True)
class NullDistribution:
    """Null distribution of one diagnostic under a true model."""

    null95: float  # 95 % quantile of the gain, nats
    threshold: float  # gain above which a departure is significant, nats


def run_diagnostics(seen: WhitenedAxis) -> Findings:
    """Run all diagnostics on a whitened axis."""
    return {name: lens(seen) for name, lens in DIAGNOSTICS.items()}


def null_distributions(
    simulated: Mapping[str, Sequence[Findings]], looks: int
) -> dict[str, dict[str, NullDistribution]]:
    """Return the null distribution of each axis and diagnostic.

    Parameters
    ----------
    simulated : mapping of str to sequence of Findings
        For each axis, the findings of the simulated recordings.
    looks : int
        Number of axes that are tested together.
    """
    found: dict[str, dict[str, NullDistribution]] = {axis: {} for axis in simulated}
    for lens in DIAGNOSTICS:
        gains = {axis: np.array([one[lens].gain for one in seen]) for axis, seen in simulated.items()}
        pooled = _tail_quantiles(np.concatenate(list(gains.values())), looks)
        for axis, own in gains.items():
            beyond = float(own.max(initial=0.0)) + AXIS_MARGIN_NATS
            found[axis][lens] = (
                pooled if beyond <= pooled.threshold else NullDistribution(max(pooled.null95, float(own.max())), beyond)
            )
    return found


def _tail_quantiles(gains: Floats, looks: int) -> NullDistribution:
    """Return the quantiles of the null distribution from pooled gains."""
    quartile = float(np.quantile(gains, 1.0 - UPPER_QUANTILE)) if gains.size else 0.0
    beyond = gains[gains > quartile] - quartile
    scale = float(np.clip(beyond.mean() if beyond.size else EXCESS_RANGE_NATS[0], *EXCESS_RANGE_NATS))
    p = FALSE_ALARM_PROBABILITY / (len(DIAGNOSTICS) * looks)
    return NullDistribution(quartile + scale * log(UPPER_QUANTILE / 0.05), quartile + scale * log(UPPER_QUANTILE / p))


def score_findings(seen: Findings, null: Mapping[str, NullDistribution]) -> tuple[Score, ...]:
    """Return the scores of an axis, in the order of the diagnostics.

    Parameters
    ----------
    seen : Findings
        Findings on the axis.
    null : mapping of str to Null
        Null distribution of each diagnostic.
    """
    return tuple(
        Score(lens, one.where, *(sqrt(2.0 * x) for x in (one.gain, null[lens].null95, null[lens].threshold)))
        for lens, one in seen.items()
    )
