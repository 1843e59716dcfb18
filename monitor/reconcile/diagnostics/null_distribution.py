"""Null distributions of the diagnostics under a true noise model.

The gap of a diagnostic is √(2 × gain), the size of the strongest departure in standard deviations. The gain is the
maximum over many places, such as frequencies or times. If the noise is Gaussian and the noise model is true, the gain
depends only on the effective number of independent places (``NULL_GAIN_QUANTILE_PARAMETERS``). Let q be the upper
quartile of the gain. Above q, the density of a gain g is modelled as exp(−(g − q)/s).

One simulated recording is used to check that the noise model is Gaussian enough. If a gain is improbably large, more
recordings are simulated. If a gain is improbably large in all ``SIMULATED_RECORDINGS`` recordings, the thresholds are
raised above the simulated gains if necessary. A model that is not Gaussian is simulated this number of times, or until
it is clear which findings on the recording are significant (``is_significance_clear``).

If the noise model is true, 1 % of all recordings exceed a threshold in any diagnostic on any axis.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import log, sqrt
from typing import Final, NamedTuple

import numpy as np

from monitor.reconcile.diagnostics.whiteness_tests import DIAGNOSTICS, WhitenessDeparture
from monitor.reconcile.likelihood.whitening import WhitenedAxis
from monitor.reconcile.result import DiagnosticGap

FALSE_ALARM_PROBABILITY: Final = 0.01
"""Fraction of recordings of a true model with a significant gap in any diagnostic on any axis."""
SIMULATED_RECORDINGS: Final = 6
"""Largest number of simulated recordings that determine a null distribution."""
UPPER_QUANTILE: Final = 0.25
"""Fraction of the largest gains, for which an exponential distribution is assumed."""
EXCESS_RANGE_NATS: Final = (1.0, 1.3)
"""Range of the mean excess of simulated gains over the upper quartile."""
IMPROBABLE: Final = 0.002
"""A gain is improbably large if its probability is below this value. Another recording is then simulated."""
AXIS_MARGIN_NATS: Final = 3.0
"""Margin between the largest simulated gain of an axis and the threshold, in nats."""
CLEAR_GAIN_RATIO: Final = 2.0
"""Smallest ratio of gain and threshold at which a finding is significant without further simulations."""

Findings = Mapping[str, WhitenessDeparture]
"""Findings of all diagnostics on one axis, by the name of the diagnostic."""


@dataclass(frozen=True, slots=True)
class NullDistribution:
    """Quantiles of the log-likelihood gain of one diagnostic under a true noise model."""

    null95: float  # 95 % quantile of the gain, nats
    threshold: float  # gain above which a departure is significant, nats

    @property
    def min_gain_to_test_effects(self) -> float:
        """Gain above which the search tests the effects one by one, in nats.

        With a true model, a gain exceeds the mean of both quantiles in about one of six recordings. The penalties then
        prevent the search from adding wrong effects.
        """
        return 0.5 * (self.null95 + self.threshold)


class NullGainQuantileParameters(NamedTuple):
    """Upper quartile and scale of the gain of a diagnostic under a true Gaussian noise model.

    The upper quartile is ``offset`` + ``slope`` × ln(places).
    """

    offset: float  # nats
    slope: float  # nats
    scale: float  # mean excess over the upper quartile, nats

    def quantile(self, places: float, probability: float) -> float:
        """Return the gain that is exceeded with a small probability."""
        return self.offset + self.slope * log(max(places, 1.0)) + self.scale * log(UPPER_QUANTILE / probability)


NULL_GAIN_QUANTILE_PARAMETERS: Final[Mapping[str, NullGainQuantileParameters]] = {
    "values": NullGainQuantileParameters(0.0, 0.0, 1.0),
    "psd": NullGainQuantileParameters(0.9, 1.0, 1.1),
    "lines": NullGainQuantileParameters(2.4, 1.0, 1.2),
    "autocorrelation": NullGainQuantileParameters(4.0, 0.0, 1.0),
    "level": NullGainQuantileParameters(1.3, 0.95, 1.25),
    "temperature": NullGainQuantileParameters(1.5, 0.0, 1.0),
    "other_axes": NullGainQuantileParameters(0.65, 0.73, 1.0),
    "tails": NullGainQuantileParameters(0.4, 0.0, 1.0),
    "variance": NullGainQuantileParameters(1.75, 1.0, 1.1),
    "spectrogram": NullGainQuantileParameters(0.3, 1.0, 1.1),
}
"""Null distribution of each diagnostic, fitted to simulated recordings of five models with 8192 to 10⁶ samples.

For the diagnostics ``autocorrelation`` and ``temperature``, the number of places is constant.
"""

AxisNull = Mapping[str, NullDistribution]
"""Null distributions of all diagnostics on one axis, by the name of the diagnostic."""


def run_diagnostics(whitened: WhitenedAxis) -> Findings:
    """Run all diagnostics on a whitened axis."""
    return {name: diagnose(whitened) for name, diagnose in DIAGNOSTICS.items()}


def all_simulations_have_improbable_gain(findings: Sequence[Findings]) -> bool:
    """Return True if a diagnostic has an improbably large gain in all simulated recordings of an axis."""
    return any(
        all(one[diagnostic].gain > _quantile(diagnostic, one[diagnostic], IMPROBABLE) for one in findings)
        for diagnostic in DIAGNOSTICS
    )


def is_significance_clear(recorded: Findings, simulated: Sequence[Findings], axis_count: int) -> bool:
    """Return True if further simulations can hardly change which findings of an axis are significant.

    A simulation can only raise a threshold. A finding below the known threshold is therefore not significant, nor is a
    finding below a simulated gain if the thresholds will be raised. A finding is clearly significant if its gain is at
    least ``CLEAR_GAIN_RATIO`` times the current threshold.

    Parameters
    ----------
    recorded : Findings
        Findings on the axis of the recording.
    simulated : sequence of Findings
        Findings on the simulated recordings of the axis so far.
    axis_count : int
        Number of simulated axes.
    """
    chance = _false_alarm_probability_of_one_diagnostic(axis_count)
    for diagnostic, one in recorded.items():
        known = _quantile(diagnostic, one, chance)
        largest = max(findings[diagnostic].gain for findings in simulated)
        lower = max(known, largest) if _raises_thresholds(simulated) else known
        if lower < one.gain < CLEAR_GAIN_RATIO * max(known, largest + AXIS_MARGIN_NATS):
            return False
    return True


def estimate_null_distributions(simulated: Mapping[str, Sequence[Findings]]) -> dict[str, AxisNull]:
    """Estimate the null distributions of each axis from the findings on simulated recordings.

    Parameters
    ----------
    simulated : mapping of str to sequence of Findings
        Findings on 1 to ``SIMULATED_RECORDINGS`` simulated recordings of each axis. If all recordings of an axis are
        simulated, or if all its recordings have an improbably large gain, its thresholds are raised above the gains if
        necessary.
    """
    chance = _false_alarm_probability_of_one_diagnostic(len(simulated))
    complete = [axis for axis, of in simulated.items() if _raises_thresholds(of)]
    null: dict[str, dict[str, NullDistribution]] = {axis: {} for axis in simulated}
    for diagnostic in DIAGNOSTICS:
        pooled = [one[diagnostic].gain for axis in complete for one in simulated[axis]]
        for axis, of in simulated.items():
            expected = [_quantile(diagnostic, of[0][diagnostic], p) for p in (0.05, chance)]
            if axis in complete:
                own = _simulated_null_distribution(pooled, max(one[diagnostic].gain for one in of), chance)
                expected = [max(expected[0], own.null95), max(expected[1], own.threshold)]
            null[axis][diagnostic] = NullDistribution(*expected)
    return dict(null)


def _raises_thresholds(findings: Sequence[Findings]) -> bool:
    """Return True if the simulated gains of an axis raise its thresholds."""
    return len(findings) >= SIMULATED_RECORDINGS or all_simulations_have_improbable_gain(findings)


def _simulated_null_distribution(pooled: Sequence[float], largest: float, chance: float) -> NullDistribution:
    """Return the null distribution from the gains of several axes.

    The threshold is raised if it would be less than ``AXIS_MARGIN_NATS`` above the largest gain of the axis.
    """
    quartile = float(np.quantile(pooled, 1.0 - UPPER_QUANTILE))
    excess = [gain - quartile for gain in pooled if gain > quartile]
    scale = float(np.clip(np.mean(excess) if excess else EXCESS_RANGE_NATS[0], *EXCESS_RANGE_NATS))
    null95, threshold = (quartile + scale * log(UPPER_QUANTILE / p) for p in (0.05, chance))
    if largest + AXIS_MARGIN_NATS <= threshold:
        return NullDistribution(null95, threshold)
    return NullDistribution(max(null95, largest), largest + AXIS_MARGIN_NATS)


def _quantile(diagnostic: str, found: WhitenessDeparture, probability: float) -> float:
    return NULL_GAIN_QUANTILE_PARAMETERS[diagnostic].quantile(found.places, probability)


def _false_alarm_probability_of_one_diagnostic(axis_count: int) -> float:
    return FALSE_ALARM_PROBABILITY / (len(DIAGNOSTICS) * max(axis_count, 1))


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
        DiagnosticGap(
            diagnostic,
            one.where,
            *(sqrt(2.0 * x) for x in (one.gain, null[diagnostic].null95, null[diagnostic].threshold)),
        )
        for diagnostic, one in findings.items()
    )
