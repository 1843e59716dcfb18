"""Comparison of the measured Allan variance in the sliding window with the Allan variance of a noise model.

For each axis and averaging time, the comparison gives the difference z(τ) in standard deviations. The largest |z| of an
axis is called the gap.

If the model is true, ν σ²(τ)/σ²_model(τ) is approximately χ² with ν degrees of freedom. The cube root of χ² is
approximately normal (Wilson & Hilferty, PNAS 17, 1931), which gives

    z(τ) = ((σ²/σ²_model)^(1/3) − 1 + 2/(9ν)) / √(2/(9ν)).

The degrees of freedom are ν = 2 σ⁴_model/V, where V is the variance of the Allan variance that the model predicts. For
the noise terms Q, N, B and K, V is computed exactly in ``uncertainty``. For other effects with the power spectral
density S, V is 4/M ∫ (S G)² df. Here M is the number of second differences, and G is the spectral kernel of the Allan
variance. The integral is accurate if the window is much longer than the correlation time of the noise.

The limits of the gap take the number of averaging times and axes into account by Šidák's inequality (J. Am. Stat.
Assoc. 62, 1967), which holds for normal variables with any correlation. If the model is true, the gap exceeds
``threshold`` on any axis in at most one of 100 independent windows. In 2500 simulated windows of six axes and 14
averaging times, the gap exceeded ``threshold`` in 0.5 % of the windows. For pure random walk, the share was 0.9 %.
Telegraph noise and random steps are not Gaussian, so the gap exceeds ``threshold`` more often.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from drivers.data_types import AXES, Event, Floats, Ints
from monitor.common.distributions import normal_quantile
from monitor.estimation.allan.curve import AllanCurve
from monitor.estimation.allan.uncertainty import NOISES, PAIRS, CovarianceTable, CovarianceTablesByAxis, K, N
from monitor.estimation.estimate import Estimate
from monitor.noise.model import NoiseModel
from monitor.noise.spectrum import MIN_FREQUENCY_CYCLES, Spectrum, frequency_grid
from monitor.noise.standard_terms import STANDARD_TERMS

MIN_EDF: Final = 2.0
"""Minimum number of degrees of freedom that is required to compare an averaging time."""
MIN_SAMPLES: Final = 1000
"""Minimum number of samples that is required to compare an axis. With 1000 samples, the error of N is 3 %."""
FALSE_ALARM: Final = 0.01
"""Probability that the gap of any axis exceeds ``threshold`` in an independent window if the model is true."""
FALSE_ALARM_WATCHED: Final = 0.001
"""Probability that the gap of any axis exceeds ``alarm`` in an independent window if the model is true."""
KIND: Final = "model_disagrees"
RENEWED_SHARE: Final = 0.125
"""Share of the samples in the window that must be new before a decision changes."""
CLEAR_FACTOR: Final = 2.0
"""Ratio of the difference to ``threshold`` above which fewer new samples are sufficient for a disagreement."""


@dataclass(frozen=True, slots=True)
class AxisModelComparison:
    """Comparison of one axis with the noise model."""

    axis: str
    measured: Floats  # [m] measured Allan deviation, unit of the axis; NaN if the window is too short
    model: Floats  # [m] Allan deviation of the model; NaN if unknown
    z: Floats  # [m] difference between measurement and model in standard deviations; NaN if not compared
    gap: float  # largest |z|
    tau_s: tuple[float, float]  # range of averaging times around the largest |z| in which |z| exceeds the threshold
    row: int  # index of the largest |z|
    null95: float  # limit that the gap of this axis exceeds in 5 % of windows if the model is true
    threshold: float  # limit that the gap of any axis exceeds in 1 % of windows if the model is true
    alarm: float  # limit that the gap of any axis exceeds in 0.1 % of windows if the model is true
    samples: int  # number of samples of this axis in the window

    @property
    def ratio(self) -> float:
        """Ratio of the measured Allan deviation to that of the model, at the averaging time with the largest |z|."""
        return float(self.measured[self.row] / self.model[self.row])


@dataclass(frozen=True, slots=True)
class ModelComparison:
    """Comparison of all axes with the noise model."""

    t_ns: int  # time of the newest sample
    rate_hz: float
    window_s: float
    samples: int  # number of samples received since the start
    n: int  # number of samples in the window
    tau_s: Floats  # [m]
    axes: Mapping[str, AxisModelComparison]  # results for the axes that can be compared, in the order of AXES
    agrees: Mapping[str, bool] = field(default_factory=dict)  # current decisions of ``ModelAgreementMonitor``


class NoiseModelComparator:
    """Comparator of a sliding window with a noise model, whose Allan variances are precomputed.

    Parameters
    ----------
    model : NoiseModel
        Noise model of the sensor.
    length : int
        Number of samples in the full window.
    """

    def __init__(self, model: NoiseModel, length: int) -> None:
        self._model = model
        self._length = length
        self._expected: dict[str, _Expected] = {}
        self._tables = CovarianceTablesByAxis(np.empty(0, np.int64), length)
        self._of: tuple[float, tuple[int, ...]] = (0.0, ())  # sample rate and cluster sizes of the precomputed values

    def compare_with_estimate(self, estimate: Estimate) -> ModelComparison:
        """Compare the axes that the model contains and that have at least ``MIN_SAMPLES`` samples in the window."""
        curve = estimate.curve
        tables = self._prepare(curve.factors, estimate.rate_hz)
        found: dict[str, AxisModelComparison] = {}
        for axis, expected in self._expected.items():
            i = AXES.index(axis)
            terms = curve.terms[:, i]
            n = count_axis_samples_in_window(curve, i)
            if n < MIN_SAMPLES:
                continue
            excess = np.broadcast_to(curve.excess, curve.avar.shape)[:, i]
            edf = expected.degrees_of_freedom(tables.table_of_axis(i, n, curve.n), terms, excess)
            one = _axis_gap(axis, curve.tau_s, curve.avar[:, i], expected.avar, excess, edf, n, len(self._expected))
            if one is not None:
                found[axis] = one
        return ModelComparison(
            estimate.t_ns, estimate.rate_hz, estimate.window_s, estimate.samples, curve.n, curve.tau_s, found
        )

    def _prepare(self, factors: Ints, rate_hz: float) -> CovarianceTablesByAxis:
        """Return the covariance tables.

        If the rate or the cluster sizes change, the expected Allan variances are recomputed.
        """
        of = (rate_hz, tuple(factors.tolist()))
        if self._of[1] != of[1]:
            self._tables = CovarianceTablesByAxis(factors, self._length)
        if self._of != of:
            named = (axis for axis in AXES if self._model.effects.get(axis))
            known = {axis: _Expected.from_model(self._model, axis, factors, rate_hz) for axis in named}
            self._expected = {axis: one for axis, one in known.items() if (one.avar > 0.0).any()}
            self._of = of
        return self._tables


def count_axis_samples_in_window(curve: AllanCurve, axis: int) -> int:
    """Return the number of samples of one axis in the window.

    An axis that has been restarted has fewer than ``curve.n`` samples.

    Parameters
    ----------
    curve : AllanCurve
        Allan curve of the window.
    axis : int
        Index into ``AXES``.
    """
    terms = curve.terms[:, axis]
    return int((terms + 2 * curve.factors - 1)[terms > 0].max(initial=0))


@dataclass(frozen=True, slots=True)
class _Expected:
    """Allan variance that the model predicts for one axis, and the variance of its estimate."""

    avar: Floats  # [m] Allan variance, squared unit of the axis
    shape: Floats  # [4] Q², N², B², K² at τ0 = 1
    more: Floats  # [m] additional variance of one second difference that is not caused by Q, N, B and K, unit⁴

    @classmethod
    def from_model(cls, model: NoiseModel, axis: str, cluster_sizes: Ints, rate_hz: float) -> "_Expected":
        """Compute the expected values for one axis of a noise model at the given cluster sizes."""
        spectrum = model.spectrum(axis, 1.0 / rate_hz)
        tau_s = cluster_sizes / rate_hz
        shape, classic = _standard_terms(model, axis, rate_hz)
        more = _excess_variance(spectrum, classic, cluster_sizes, rate_hz)
        # The product of linear drift and noise increases the variance at most as much as a random walk of equal size.
        shape[K] += 1.5 * spectrum.slope**2 * float(tau_s.max()) / rate_hz
        return cls(spectrum.avar(tau_s), shape, more)

    def degrees_of_freedom(self, table: CovarianceTable, terms: Ints, excess: Floats) -> Floats:
        """Return the degrees of freedom [m] of the mean squares, with NaN for averaging times without differences.

        Missing samples, which add ``excess`` [m] to the mean squares, act like white noise.
        """
        shape = np.tile(self.shape, (terms.size, 1))
        shape[:, N] += np.maximum(excess, 0.0) * table.factors
        pairs = np.stack([shape[:, a] * shape[:, b] * (1.0 if a == b else 2.0) for a, b in PAIRS], axis=1)
        exact = np.einsum("iik,ik->i", table.covariance, pairs)
        with np.errstate(divide="ignore", invalid="ignore"):
            variance = exact * table.terms / terms + self.more / terms
            return np.where((terms > 0) & (variance > 0.0), 2.0 * (self.avar + excess) ** 2 / variance, np.nan)


def _standard_terms(model: NoiseModel, axis: str, rate_hz: float) -> tuple[Floats, NoiseModel]:
    """Return Q², N², B² and K² of an axis at τ0 = 1, and the part of the model that contains only these noise terms."""
    letters = ("Q", "N", "B", "K")
    kinds = tuple(STANDARD_TERMS[letter] for letter in letters)
    powers = (2.0, 1.0, 0.0, -1.0)
    effects = tuple(effect for effect in model.effects[axis] if isinstance(effect, kinds))
    shape = np.zeros(NOISES)
    for effect in effects:
        row = kinds.index(type(effect))
        shape[row] += getattr(effect, letters[row]) ** 2 * rate_hz ** powers[row]
    return shape, NoiseModel({axis: effects})


def _excess_variance(spectrum: Spectrum, classic: NoiseModel, factors: Ints, rate_hz: float) -> Floats:
    """Return the share of the Allan variance that comes from effects other than Q, N, B and K.

    The variance is that of a single second difference, in units with τ0 = 1. It is 4 ∫ (S² − S_standard²) G² dν, where
    S is the spectral density and G = 2 sin⁴(πνm)/(m sin πν)² (Parseval's theorem). A spectral line of mean square P
    contributes 4 P S G² at the frequency of the line.
    """
    (axis,) = classic.effects
    f_hz = frequency_grid(MIN_FREQUENCY_CYCLES * rate_hz / float(factors.max()), 1.0 / rate_hz, spectrum.peaks)
    own, known = (s.density(f_hz) * rate_hz for s in (spectrum, classic.spectrum(axis, 1.0 / rate_hz)))
    difference = own**2 - known**2
    if not difference.any() and not spectrum.lines:
        return np.zeros(factors.size)
    nu = f_hz / rate_hz
    more = [4.0 * np.trapezoid(difference * _kernel(nu, m) ** 2, nu) for m in factors.tolist()]
    for line_hz, mean_square in spectrum.lines:
        at = np.array([line_hz])
        here = float(spectrum.density(at)[0]) * rate_hz
        more = [
            one + 4.0 * mean_square * here * float(_kernel(at / rate_hz, m)[0]) ** 2
            for one, m in zip(more, factors.tolist(), strict=True)
        ]
    return np.array(more)


def _kernel(nu: Floats, m: int) -> Floats:
    return np.asarray(2.0 * np.sin(np.pi * nu * m) ** 4 / (m * np.sin(np.pi * nu)) ** 2)


def _axis_gap(
    axis: str, tau_s: Floats, avar: Floats, expected: Floats, excess: Floats, edf: Floats, samples: int, axes: int
) -> AxisModelComparison | None:
    """Compare one axis with the noise model, or return None if no averaging time can be compared."""
    expected = np.where(expected > 0.0, expected, np.nan)
    z = chi2_ratio_to_normal_score((avar + excess) / (expected + excess), edf)
    judged = np.isfinite(z)
    if not judged.any():
        return None
    count = int(judged.sum())
    threshold, alarm = (max_abs_z_limit(share, axes * count) for share in (FALSE_ALARM, FALSE_ALARM_WATCHED))
    size = np.where(judged, np.abs(z), -1.0)
    at = int(size.argmax())
    alike = (size > threshold) & (np.sign(z) == np.sign(z[at]))
    first = last = at
    while first > 0 and alike[first - 1]:
        first -= 1
    while last + 1 < alike.size and alike[last + 1]:
        last += 1
    where = float(tau_s[first]), float(tau_s[last])
    null95 = max_abs_z_limit(0.05, count)
    return AxisModelComparison(
        axis, np.sqrt(avar), np.sqrt(expected), z, float(size[at]), where, at, null95, threshold, alarm, samples
    )


def chi2_ratio_to_normal_score(ratio: Floats, edf: Floats) -> Floats:
    """Convert the ratio χ²/ν to its deviation from 1 in standard deviations.

    The cube root of the ratio is approximately normal. For fewer than ``MIN_EDF`` degrees of freedom, the result is
    NaN. The example converts the 97.5 % quantile of χ² with 100 degrees of freedom.

    Parameters
    ----------
    ratio : ndarray of float64
        Ratio χ²/ν.
    edf : ndarray of float64
        Degrees of freedom ν.

    >>> round(float(chi2_ratio_to_normal_score(np.array([1.29561]), np.array([100.0]))[0]), 2)
    1.96
    """
    spread = 2.0 / (9.0 * np.where(edf >= MIN_EDF, edf, np.nan))
    return np.asarray((np.cbrt(ratio) - 1.0 + spread) / np.sqrt(spread))


def max_abs_z_limit(exceedance_probability: float, count: int) -> float:
    """Return the limit that the largest absolute value of several normal variables exceeds with a given probability.

    The probability is exact for independent variables. For correlated variables, the true probability is smaller.

    Parameters
    ----------
    exceedance_probability : float
        Probability that the largest absolute value exceeds the limit.
    count : int
        Number of normal variables.

    >>> f"{max_abs_z_limit(0.05, 1):.3f} {max_abs_z_limit(0.01, 6 * 14):.3f}"
    '1.960 3.847'
    """
    return -normal_quantile(float(-0.5 * np.expm1(np.log1p(-exceedance_probability) / count)))


@dataclass(slots=True)
class _Axis:
    """Current decision for one axis, and the evidence against it."""

    agrees: bool | None = None  # None until the first decision
    since: tuple[int, int] | None = None  # sample count and time at the first contradicting comparison


class ModelAgreementMonitor:
    """Monitor that decides whether each axis of a device agrees with the noise model, and reports changes as events.

    The sliding window is compared with the noise model ten times per second, so successive comparisons are strongly
    correlated. An axis disagrees with the model if the largest difference stays above ``AxisModelComparison.alarm``
    until 1/8 of the window has been replaced. If the difference exceeds twice ``AxisModelComparison.threshold``,
    ``MIN_SAMPLES`` new samples are sufficient. An axis agrees again if the largest difference stays below ``null95``
    until 1/8 of the window has been replaced. In a simulation of 1600 windows of six axes with 128 comparisons each, a
    true model was rejected three times.
    """

    def __init__(self) -> None:
        self._axes = {axis: _Axis() for axis in AXES}

    @property
    def agreement_by_axis(self) -> Mapping[str, bool]:
        """Current decision for each axis, True if the axis agrees with the noise model. Undecided axes are omitted."""
        return {axis: one.agrees for axis, one in self._axes.items() if one.agrees is not None}

    def update_decisions(self, comparison: ModelComparison) -> list[Event]:
        """Process one comparison, and return an event for each axis whose decision changes."""
        found = (self._update_axis(self._axes[axis], gap, comparison) for axis, gap in comparison.axes.items())
        return [event for event in found if event is not None]

    def _update_axis(self, axis: _Axis, gap: AxisModelComparison, comparison: ModelComparison) -> Event | None:
        if axis.agrees is None and gap.gap <= gap.alarm:
            axis.agrees = True  # Initial agreement is not reported as an event.
        contradicted = gap.gap < gap.null95 if axis.agrees is False else gap.gap > gap.alarm
        if not contradicted:
            axis.since = None
            return None
        if axis.since is None:
            axis.since = comparison.samples, comparison.t_ns
        samples, since_ns = axis.since
        clear = axis.agrees is not False and gap.gap > CLEAR_FACTOR * gap.threshold
        if comparison.samples - samples < max(MIN_SAMPLES, 0 if clear else round(RENEWED_SHARE * gap.samples)):
            return None
        axis.agrees, axis.since = axis.agrees is False, None
        return _event(gap, axis.agrees, comparison.t_ns, since_ns)


def _event(gap: AxisModelComparison, agrees: bool, t_ns: int, since_ns: int) -> Event:
    lo, hi = gap.tau_s
    tau = f"{lo:.3g} s" if lo == hi else f"{lo:.3g} to {hi:.3g} s"
    what = {
        "agrees": agrees,
        "gap": gap.gap,
        "threshold": gap.threshold,
        "ratio": gap.ratio,
        "tau_lo": lo,
        "tau_hi": hi,
    }
    if agrees:
        text = f"{gap.axis} agrees with its model again: the largest gap is {gap.gap:.1f} σ"
    else:
        text = (
            f"{gap.axis} disagrees with its model at τ {tau}: "
            f"the deviation is {gap.ratio:.3g} times the deviation of the model, "
            f"a gap of {gap.gap:.3g} σ with a threshold of {gap.threshold:.1f} σ"
        )
    return Event(KIND, t_ns, text, gap.axis, {"model": what}, since_ns, gap.gap)
