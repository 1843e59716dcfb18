"""Null distributions of the diagnostics from simulations of the model, and scores of the measured recording.

The gap of a diagnostic is √(2 × gain). It is the size of the strongest departure in standard deviations. The null
distribution of the gain comes from recordings that are simulated from the model under test. The gains of a true model
are nearly pivotal, that is, the same for all axes and models. The gains of all axes are therefore pooled. Above their
upper quartile q, the distribution decreases as exp(−(g − q)/s). The scale s is the mean excess over q, limited to [1,
1.3] as for the tails of maxima of χ²/2.

On a true model, one of 100 recordings exceeds ``threshold`` on any axis in any diagnostic. ``null95`` refers to one
diagnostic on one axis. If the simulated gains of an axis lie above the pooled threshold (coarse or clipped values), the
threshold of this axis is the largest of these gains plus a margin.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import log, sqrt
from typing import Final

import numpy as np

from drivers.sample import Floats
from monitor.reconcile.diagnostics.diagnostics import DIAGNOSTICS, Finding
from monitor.reconcile.likelihood.whitening import WhitenedAxis
from monitor.reconcile.result import DiagnosticGap

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


AxisNull = Mapping[str, NullDistribution]
"""Null distributions of all diagnostics on one axis, by the name of the diagnostic."""


def run_diagnostics(whitened: WhitenedAxis) -> Findings:
    """Run all diagnostics on a whitened axis."""
    return {name: diagnose(whitened) for name, diagnose in DIAGNOSTICS.items()}


def estimate_null_distributions(simulated: Mapping[str, Sequence[Findings]]) -> dict[str, AxisNull]:
    """Return the null distributions of each axis.

    Parameters
    ----------
    simulated : mapping of str to sequence of Findings
        For each axis, the findings of the simulated recordings.
    """
    found: dict[str, dict[str, NullDistribution]] = {axis: {} for axis in simulated}
    for lens in DIAGNOSTICS:
        gains = {axis: np.array([one[lens].gain for one in seen]) for axis, seen in simulated.items()}
        pooled = _tail_quantiles(np.concatenate(list(gains.values())), len(simulated))
        for axis, own in gains.items():
            largest = float(own.max(initial=0.0))
            if largest + AXIS_MARGIN_NATS <= pooled.threshold:
                found[axis][lens] = pooled
            else:
                found[axis][lens] = NullDistribution(max(pooled.null95, largest), largest + AXIS_MARGIN_NATS)
    return dict(found)


def _tail_quantiles(gains: Floats, axis_count: int) -> NullDistribution:
    """Return the quantiles of the null distribution from pooled gains."""
    quartile = float(np.quantile(gains, 1.0 - UPPER_QUANTILE)) if gains.size else 0.0
    beyond = gains[gains > quartile] - quartile
    scale = float(np.clip(beyond.mean() if beyond.size else EXCESS_RANGE_NATS[0], *EXCESS_RANGE_NATS))
    p = FALSE_ALARM_PROBABILITY / (len(DIAGNOSTICS) * axis_count)
    return NullDistribution(quartile + scale * log(UPPER_QUANTILE / 0.05), quartile + scale * log(UPPER_QUANTILE / p))


def measure_gaps(findings: Findings, null: AxisNull) -> tuple[DiagnosticGap, ...]:
    """Return the scores of an axis, in the order of the diagnostics.

    Parameters
    ----------
    findings : Findings
        Findings on the axis.
    null : AxisNull
        Null distribution of each diagnostic.
    """
    return tuple(
        DiagnosticGap(lens, one.where, *(sqrt(2.0 * x) for x in (one.gain, null[lens].null95, null[lens].threshold)))
        for lens, one in findings.items()
    )
