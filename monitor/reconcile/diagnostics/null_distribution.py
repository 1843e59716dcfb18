"""Null distributions of the diagnostics, estimated from simulated recordings of the noise model.

The gap of a diagnostic is √(2 × gain), the size of the strongest departure in standard deviations. Let q be the upper
quartile of the simulated gains of all axes. Above q, the density of a gain g is modelled as exp(−(g − q)/s). The scale
s is the mean excess over q, limited to the range from 1 to 1.3, which is typical of the maximum of many χ²/2 variables.

If the noise model is true, 1 % of all recordings exceed a threshold in any diagnostic on any axis. An axis with coarse
or clipped values can have a larger threshold.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import log, sqrt
from typing import Final

import numpy as np

from drivers.data_types import Floats
from monitor.reconcile.diagnostics.diagnostics import DIAGNOSTICS, Finding
from monitor.reconcile.likelihood.whitening import WhitenedAxis
from monitor.reconcile.result import DiagnosticGap

FALSE_ALARM_PROBABILITY: Final = 0.01
"""Fraction of recordings of a true model with a significant gap in any diagnostic on any axis."""
UPPER_QUANTILE: Final = 0.25
"""Fraction of the largest gains, for which an exponential distribution is assumed."""
EXCESS_RANGE_NATS: Final = (1.0, 1.3)
AXIS_MARGIN_NATS: Final = 3.0
"""Margin between the largest simulated gain of an axis and the threshold, in nats."""

Findings = Mapping[str, Finding]
"""Findings of all diagnostics on one axis, by the name of the diagnostic."""


@dataclass(frozen=True, slots=True)
class NullDistribution:
    """Quantiles of the log-likelihood gain of one diagnostic under a true noise model."""

    null95: float  # 95 % quantile of the gain, nats
    threshold: float  # gain above which a departure is significant, nats


AxisNull = Mapping[str, NullDistribution]
"""Null distributions of all diagnostics on one axis, by the name of the diagnostic."""


def run_diagnostics(whitened: WhitenedAxis) -> Findings:
    """Run all diagnostics on a whitened axis."""
    return {name: diagnose(whitened) for name, diagnose in DIAGNOSTICS.items()}


def estimate_null_distributions(simulated: Mapping[str, Sequence[Findings]]) -> dict[str, AxisNull]:
    """Estimate the null distributions of each axis from the findings on simulated recordings."""
    found: dict[str, dict[str, NullDistribution]] = {axis: {} for axis in simulated}
    for lens in DIAGNOSTICS:
        gains = {axis: np.array([one[lens].gain for one in findings]) for axis, findings in simulated.items()}
        pooled = _tail_quantiles(np.concatenate(list(gains.values())), len(simulated))
        for axis, own in gains.items():
            largest = float(own.max(initial=0.0))
            if largest + AXIS_MARGIN_NATS <= pooled.threshold:
                found[axis][lens] = pooled
            else:
                found[axis][lens] = NullDistribution(max(pooled.null95, largest), largest + AXIS_MARGIN_NATS)
    return dict(found)


def _tail_quantiles(gains: Floats, axis_count: int) -> NullDistribution:
    quartile = float(np.quantile(gains, 1.0 - UPPER_QUANTILE)) if gains.size else 0.0
    beyond = gains[gains > quartile] - quartile
    scale = float(np.clip(beyond.mean() if beyond.size else EXCESS_RANGE_NATS[0], *EXCESS_RANGE_NATS))
    p = FALSE_ALARM_PROBABILITY / (len(DIAGNOSTICS) * axis_count)
    return NullDistribution(quartile + scale * log(UPPER_QUANTILE / 0.05), quartile + scale * log(UPPER_QUANTILE / p))


def compute_diagnostic_gaps(findings: Findings, null: AxisNull) -> tuple[DiagnosticGap, ...]:
    """Compute the differences between recording and model (gaps) in all diagnostics on one axis.

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
