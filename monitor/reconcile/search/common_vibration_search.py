"""Search for vibration that several axes share, after the search on each axis.

The coefficients of two whitened axes x and y are uncorrelated if no source acts on both axes. A common vibration with
the unit variance S and the gains g causes the correlation

    ρ = g_x g_y S/√(v_x v_y)

in each frequency bin, where v are the variances of the coefficients. The log-likelihood gain of n coefficients with the
product sum P is −½[n ln(1 − ρ²) + 2(nρ² − ρP)/(1 − ρ²)]. The gains g maximise the sum of this gain over all pairs of
axes and the likelihoods of the spectra of all axes. A leak has a constant coefficient over frequency and is found by
the search on one axis.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import copysign, exp, log, pi
from typing import Final

import numpy as np

from drivers.data_types import Floats
from monitor.common.distributions import HALF_CHI2_95
from monitor.noise.effect import AxisLeak
from monitor.noise.effects import CommonVibration, ExponentiallyCorrelated, Narrowband
from monitor.reconcile.diagnostics.null_distribution import AxisNull
from monitor.reconcile.effect_properties import PENALTY_NATS
from monitor.reconcile.likelihood.axis_fit import Effects
from monitor.reconcile.likelihood.hypothesis_fit import (
    Hypothesis,
    find_maximum_by_golden_section,
    fit_with_fewest_changes,
)
from monitor.reconcile.likelihood.whitening import WhitenedAxis, whiten_axis
from monitor.reconcile.preparation.cosine_bins import FrequencyBins, build_frequency_bins, cosine_transform
from monitor.reconcile.result import ParameterInterval
from monitor.reconcile.search.cross_validation import accept_without_validation
from monitor.reconcile.search.search import AxisSearchResult, SearchRound, diagnose_hypothesis
from monitor.reconcile.search.trials import Trial

MAX_SOURCES: Final = 3
LOW_PASS_BANDWIDTHS: Final = 14
"""Number of bandwidths of low-pass vibration in the first search."""
MIN_CYCLES: Final = 40.0
"""Smallest bandwidth of a low-pass vibration, in cycles per recording."""
FREQUENCY_PENALTY_NATS: Final = PENALTY_NATS["narrowband"] - PENALTY_NATS["exponentially_correlated"]
"""Penalty for the frequency of a vibration, in nats. The search compares all frequency bands."""
MIN_BAND_BINS: Final = 2
"""Smallest number of bins in a band that is searched for correlation."""
MAX_CORRELATION: Final = 0.995
MAX_DEVIATION: Final = 1e100
"""Largest standard deviation of a coefficient. A larger value marks a stop band, which is not compared."""
BALANCE_ITERATIONS: Final = 20
GAIN_ITERATIONS: Final = 12
GAIN_SWEEPS: Final = 2
MAX_LOG_GAIN_CHANGE: Final = 1.5
"""Largest change of the logarithm of a gain in one sweep of the fit."""
MAX_LOG_BANDWIDTH_CHANGE: Final = 1.0
"""Largest change of the logarithm of a bandwidth relative to the first search."""
MIN_FIRST_GAIN_SHARE: Final = 0.5
"""Smallest gain in the first search relative to the penalty. A finer bandwidth does not double the gain."""
MIN_HALF_SHARE: Final = 0.2
"""Smallest share of the gain that each half of the recording must contribute, for all axes together and for each
axis."""
MIN_AXIS_GAIN_NATS: Final = PENALTY_NATS[CommonVibration.name]
"""Smallest log-likelihood gain of each axis beyond two, in nats. Each axis needs the evidence for a name of its own."""
MAX_LOSS_SHARE: Final = 0.2
"""Largest increase of the significant gains of all diagnostics, relative to the gain of the correlations."""
MAX_SAME_BANDWIDTH_RATIO: Final = 4.0
"""Largest ratio of the bandwidths of a vibration and a noise effect that the vibration replaces."""
VALIDATION_REASON: Final = "both halves of the recording contain the correlation of the axes"
Shape = tuple[float | None, float]
"""Frequency, or None for a low-pass spectrum, and bandwidth in Hz."""


@dataclass(frozen=True, slots=True)
class CrossSpectra:
    """Correlations of d whitened axes in m common frequency bins."""

    bins: FrequencyBins
    deviation: Floats  # [d, m] standard deviation of the coefficients, in the unit of the axis
    products: Floats  # [d, d, m] sum of the products of the coefficients of two whitened axes
    known: Floats  # [d, d, m] correlation that known common vibrations explain
    used: Floats  # [d, d] 1 for pairs of axes without a leak, 0 for other pairs

    def gain_nats(self, unit: Floats, gains: Floats) -> float:
        """Return the log-likelihood gain of a vibration with the unit variance [m] and the gains [d]."""
        scaled = np.clip(gains[:, None] * np.sqrt(unit) / self.deviation, -1.0, 1.0)
        x, y = np.nonzero(np.triu(self.used * np.outer(gains, gains), 1))
        known, products, count = self.known[x, y], self.products[x, y], self.bins.count
        whole = correlation_gain(_limited(known + scaled[x] * scaled[y]), products, count)
        return whole - correlation_gain(known, products, count) if known.any() else whole


@dataclass(frozen=True, slots=True)
class _Vibration:
    shape: Shape
    gains: Floats  # [d] gain of each axis, 0 for axes without this vibration
    gain_nats: float  # log-likelihood gain of the correlations

    @property
    def penalty_nats(self) -> float:
        """Smallest gain of the correlations of a true vibration."""
        axes_penalty = MIN_AXIS_GAIN_NATS * max(int(np.count_nonzero(self.gains)) - 2, 0)
        frequency_penalty = 0.0 if self.shape[0] is None else FREQUENCY_PENALTY_NATS
        return PENALTY_NATS[CommonVibration.name] + axes_penalty + frequency_penalty


def correlation_gain(correlation: Floats, products: Floats, count: Floats) -> float:
    """Return the log-likelihood gain of a correlation between two whitened axes, in nats.

    Parameters
    ----------
    correlation : ndarray of float64, shape (m,) or (p, m)
        Correlation in each frequency bin. The gains of p pairs of axes are added.
    products : ndarray of float64, shape (m,) or (p, m)
        Sum of the products of the coefficients of both axes in each bin.
    count : ndarray of float64, shape (m,)
        Number of coefficients in each bin.

    Examples
    --------
    >>> print(f"{correlation_gain(np.array([0.6]), np.array([60.0]), np.array([100.0])):.2f}")  # −50 ln(1 − 0.36)
    22.31
    """
    rest = 1.0 - correlation**2
    return float(-0.5 * (count * np.log(rest) + 2.0 * correlation * (count * correlation - products) / rest).sum())


def _limited(correlation: Floats) -> Floats:
    return np.clip(correlation, -MAX_CORRELATION, MAX_CORRELATION)


def name_common_vibrations(
    found: Mapping[str, AxisSearchResult], null: Mapping[str, AxisNull]
) -> dict[str, AxisSearchResult]:
    """Add the vibrations that several axes share to the results of the search on each axis.

    Parameters
    ----------
    found : mapping of str to AxisSearchResult
        Result of the search on each axis.
    null : mapping of str to AxisNull
        Null distributions of each axis.
    """
    searches = dict(found)
    for _ in range(MAX_SOURCES if len(searches) > 1 else 0):
        axis, none = next(iter(searches.values())).hypothesis.axis, dict[str, AxisSearchResult]()
        better = axis.evaluate_candidate(CommonVibration.name, partial(_with_strongest_vibration, searches, null), none)
        if not better:
            break
        searches |= better
    return searches


def _with_strongest_vibration(
    searches: Mapping[str, AxisSearchResult], null: Mapping[str, AxisNull]
) -> dict[str, AxisSearchResult]:
    """Return the results of the axes that share the strongest vibration, or an empty dictionary."""
    hypotheses = [one.hypothesis for one in searches.values()]
    whitened = [whiten_axis(one.fit) for one in hypotheses]
    shapes = _candidate_shapes(hypotheses)
    spectra = build_cross_spectra(whitened, shapes)
    if not spectra.used.any():
        return {}
    shapes.append(_strongest_band(spectra))
    spectra = build_cross_spectra(whitened, shapes)
    best = _fit_shape(spectra, shapes)
    if best.gain_nats < best.penalty_nats:
        return {}
    joint = _fit_gains_with_spectra(spectra, best, hypotheses)
    halves = _cross_spectra_of_halves(joint, whitened, shapes)
    joint = _without_weak_axes(joint, spectra, halves)
    best = joint.vibration
    if best.gain_nats < best.penalty_nats or not all(
        one.gain_nats(_unit_variance(one.bins, best.shape), best.gains) >= MIN_HALF_SHARE * best.gain_nats
        for one in halves
    ):
        return {}
    used = [e.source_number for one in hypotheses for e in one.effects if isinstance(e, CommonVibration)]
    number = 1.0 + max(used, default=0.0)
    names, changed = list(searches), dict[str, AxisSearchResult]()
    for at in np.flatnonzero(best.gains).tolist():
        changed[names[at]] = _with_vibration(searches[names[at]], joint.kept[at], _build_trial(joint, number, at))
    before = sum(_significant_gain(searches[name], null[name]) for name in changed)
    after = sum(_significant_gain(one, null[name]) for name, one in changed.items())
    return changed if after - before < MAX_LOSS_SHARE * best.gain_nats else {}


def _significant_gain(search: AxisSearchResult, null: AxisNull) -> float:
    """Return the sum of the gains of the significant diagnostics of one axis, in nats."""
    return sum(one.gain for diagnostic, one in search.final.findings.items() if one.gain > null[diagnostic].threshold)


def _cross_spectra_of_halves(
    joint: "_JointFit", whitened: Sequence[WhitenedAxis], shapes: Sequence[Shape]
) -> list[CrossSpectra]:
    """Return the correlations of both halves of the recording, with the deviations of the joint fit."""
    n, found = whitened[0].axis.n, []
    for part in (slice(0, n // 2), slice(n - n // 2, n)):
        half = build_cross_spectra(whitened, shapes, part)
        deviation = [np.interp(half.bins.f_hz, joint.spectra.bins.f_hz, one) for one in joint.spectra.deviation]
        found.append(replace(half, deviation=np.array(deviation)))
    return found


def _without_weak_axes(joint: "_JointFit", spectra: CrossSpectra, halves: Sequence[CrossSpectra]) -> "_JointFit":
    """Leave out the axes on which the vibration explains too little, as long as more than two axes remain.

    The gain of an axis comes from its correlations with the other axes and from its spectrum. This gain and the gain
    of the correlations alone must exceed ``MIN_AXIS_GAIN_NATS``, and each half of the recording must contribute to the
    gain from the correlations.

    Parameters
    ----------
    joint : _JointFit
        Fit of all gains.
    spectra : CrossSpectra
        Correlations with the deviations before the fit.
    halves : sequence of CrossSpectra
        Correlations of both halves of the recording.
    """
    while np.count_nonzero(joint.vibration.gains) > 2:
        axes = np.flatnonzero(joint.vibration.gains).tolist()
        gains = [_gain_of_axis(joint, spectra, halves, at) for at in axes]
        least = int(np.argmin(gains))
        if gains[least] > MIN_AXIS_GAIN_NATS:
            break
        joint = _without_axis(joint, spectra, axes[least])
    return joint


def _gain_of_axis(joint: "_JointFit", spectra: CrossSpectra, halves: Sequence[CrossSpectra], at: int) -> float:
    """Return the log-likelihood gain of the vibration on one axis, but at most the gain of the correlations.

    A peak in the spectrum of an axis is no evidence that the axis shares the vibration. If a half of the recording
    contributes too little, the value is negative.
    """
    vibration, hypothesis = joint.vibration, joint.hypotheses[at]
    rest = np.where(np.arange(vibration.gains.size) == at, 0.0, vibration.gains)
    whole, *parts = (
        one.gain_nats(unit, vibration.gains) - one.gain_nats(unit, rest)
        for one in (joint.spectra, *halves)
        for unit in [_unit_variance(one.bins, vibration.shape)]
    )
    if min(parts) < MIN_HALF_SHARE * whole:
        return min(parts) - MIN_HALF_SHARE * whole
    common = frozenset(i for i, effect in enumerate(hypothesis.effects) if isinstance(effect, CommonVibration))
    without = hypothesis.axis.fit(hypothesis.effects, common).log_likelihood
    without += _without_axis(joint, spectra, at).vibration.gain_nats
    saved = sum(PENALTY_NATS[effect.name] for effect in hypothesis.added if effect not in joint.kept[at])
    return min(whole, _joint_log_likelihood(joint, at, float(vibration.gains[at])) - without + saved)


def _without_axis(joint: "_JointFit", spectra: CrossSpectra, at: int) -> "_JointFit":
    deviation, gains = joint.spectra.deviation.copy(), joint.vibration.gains.copy()
    deviation[at], gains[at] = spectra.deviation[at], 0.0
    left, shape = replace(joint.spectra, deviation=deviation), joint.vibration.shape
    gain_nats = left.gain_nats(_unit_variance(left.bins, shape), gains)
    return replace(joint, spectra=left, vibration=_Vibration(shape, gains, gain_nats))


def _candidate_shapes(hypotheses: Sequence[Hypothesis]) -> list[Shape]:
    """Return low-pass shapes, and the shapes of known resonances and known correlated noise."""
    axis = hypotheses[0].axis
    widths = np.geomspace(MIN_CYCLES / axis.length_s, 4.0 * axis.rate_hz, LOW_PASS_BANDWIDTHS)
    shapes: list[Shape] = [(None, float(width)) for width in widths]
    for effect in (effect for one in hypotheses for effect in one.effects):
        if isinstance(effect, Narrowband):
            shapes.append((effect.frequency, effect.bandwidth))
        elif isinstance(effect, ExponentiallyCorrelated):
            shapes.append((None, 1.0 / (pi * effect.correlation_time)))
    return shapes


def _strongest_band(spectra: CrossSpectra) -> Shape:
    """Return the centre and the width of the frequency band with the largest unexplained correlation of two axes."""
    bins = spectra.bins
    excess = np.cumsum(np.pad(spectra.products - bins.count * spectra.known, [(0, 0), (0, 0), (1, 0)]), axis=2)
    count = np.concatenate([[0.0], np.cumsum(bins.count)])
    best, first, last, width = 0.0, 0, 0, MIN_BAND_BINS
    while width < bins.count.size:
        gains = (excess[..., width:] - excess[..., :-width]) ** 2 / (count[width:] - count[:-width])
        gains = (gains * spectra.used[..., None]).max(axis=(0, 1))
        at = int(np.argmax(gains))
        if gains[at] > best:
            best, first, last = float(gains[at]), at, at + width - 1
        width *= 2
    lo_hz, hi_hz = float(bins.f_hz[first]), float(bins.f_hz[last])
    length_s = float(bins.count.sum()) / bins.rate_hz
    return 0.5 * (lo_hz + hi_hz), max(hi_hz - lo_hz, MIN_CYCLES / length_s)


def build_cross_spectra(
    whitened: Sequence[WhitenedAxis], shapes: Sequence[Shape], part: slice | None = None
) -> CrossSpectra:
    """Build the correlations of all axes.

    Parameters
    ----------
    whitened : sequence of WhitenedAxis
        Axes, each whitened with its own model.
    shapes : sequence of Shape
        Shapes of vibrations. The bins are finer around resonances.
    part : slice or None, optional
        Part of the recording. By default, the whole recording is used.
    """
    axis = whitened[0].axis
    peaks = [(frequency, width) for frequency, width in shapes if frequency is not None]
    whole = build_frequency_bins(axis.n, axis.rate_hz, peaks)
    bins = whole if part is None else build_frequency_bins(part.stop - part.start, axis.rate_hz, peaks)
    flat, deviation = [], []
    for one in whitened:
        coefficients = one.coefficients if part is None else cosine_transform(one.series[part])
        power = bins.smoothed_mean_square(coefficients)
        flat.append(coefficients / np.sqrt(bins.expand_to_coefficients(power)))
        weight = np.interp(bins.f_hz, whole.f_hz, one.weights[whole.first])
        deviation.append(1.0 / np.maximum(weight, 1e-150))
    products = np.array([[bins.sum_over_bins(x * y) for y in flat] for x in flat])
    products = _limited_by_power(products, bins.count)
    known = _known_correlations(whitened, np.array(deviation), bins)
    return CrossSpectra(bins, np.array(deviation), products, known, _pairs_without_leak(whitened))


def _limited_by_power(products: Floats, count: Floats) -> Floats:
    """Divide the products [d, d, m] by the power of both axes in the bin, where this power exceeds the smoothed power.

    Without this division, a bin with a few large coefficients would have an unlimited log-likelihood gain.
    """
    power = np.einsum("xxm->xm", products)
    return np.asarray(products * count / np.maximum(count, np.sqrt(power[:, None] * power[None])))


def _pairs_without_leak(whitened: Sequence[WhitenedAxis]) -> Floats:
    """Return 1 for pairs of axes, and 0 for pairs with a leak. A leak that was removed leaves a correlation."""
    used = 1.0 - np.eye(len(whitened))
    names = [one.axis.name for one in whitened]
    for at, one in enumerate(whitened):
        for effect in one.effects:
            if isinstance(effect, AxisLeak) and effect.source in names:
                source = names.index(effect.source)
                used[at, source] = used[source, at] = 0.0
    return used


def _known_correlations(whitened: Sequence[WhitenedAxis], deviation: Floats, bins: FrequencyBins) -> Floats:
    found = np.zeros((len(whitened), len(whitened), bins.count.size))
    vibrations = [
        (at, one, one.gain * np.sqrt(_unit_variance(bins, (one.frequency, one.bandwidth))) / deviation[at])
        for at, axis in enumerate(whitened)
        for one in axis.effects
        if isinstance(one, CommonVibration)
    ]
    for x, one, first in vibrations:
        for y, two, second in vibrations:
            if one.source_number == two.source_number:
                found[x, y] += first * second
    return _limited(found)


def _unit_variance(bins: FrequencyBins, shape: Shape) -> Floats:
    """Return the variance of a coefficient in each bin, shape (m,), for a gain of one."""
    return _as_effect(shape, 1.0).two_sided_psd(bins.f_hz, 1.0 / bins.rate_hz) * bins.rate_hz


def _as_effect(shape: Shape, gain: float, number: float = 1.0) -> CommonVibration:
    return CommonVibration(source_number=number, gain=gain, bandwidth=shape[1], frequency=shape[0])


def fit_correlations(spectra: CrossSpectra, shape: Shape) -> _Vibration:
    """Fit the gains of all axes to the correlations, and leave out the axes that contribute too little.

    The correlations of two axes determine only the product of the gains. The shares of the vibration in both axes are
    then assumed to be equal.

    Parameters
    ----------
    spectra : CrossSpectra
        Correlations of the axes.
    shape : Shape
        Frequency and bandwidth of the vibration.
    """
    unit, count = _unit_variance(spectra.bins, shape), spectra.bins.count
    relative = np.sqrt(unit) / spectra.deviation
    scale = np.sqrt((count * relative**2).sum(axis=1) / count.sum())  # the gains are fitted in these units
    relative /= scale[:, None]
    right = np.einsum("xm,ym,xym->xy", relative, relative, spectra.products - count * spectra.known)
    weight = np.einsum("xm,ym,m->xy", relative**2, relative**2, count)
    right, weight = right * spectra.used, weight * spectra.used
    values = right**2 / np.maximum(weight, 1e-300)
    x, y = np.unravel_index(int(np.argmax(values)), values.shape)
    gains = np.zeros(scale.size)
    gains[[x, y]] = np.sqrt(abs(right[x, y]) / max(weight[x, y], 1e-300)) * np.array([1.0, copysign(1.0, right[x, y])])
    for at in (at for at in range(scale.size) if at not in (x, y)):
        partial = gains * np.isin(np.arange(scale.size), (x, y))
        gains[at] = (right[at] @ partial) / max(float(weight[at] @ partial**2), 1e-300)
    while True:
        for _ in range(BALANCE_ITERATIONS if np.count_nonzero(gains) > 2 else 0):
            for at in np.flatnonzero(gains).tolist():
                gains[at] = (right[at] @ gains) / max(float(weight[at] @ gains**2), 1e-300)
        whole = spectra.gain_nats(unit, gains / scale)
        active = np.flatnonzero(gains)
        if active.size <= 2:
            return _Vibration(shape, gains / scale, whole)
        rest = [spectra.gain_nats(unit, gains / scale * (np.arange(scale.size) != at)) for at in active]
        if whole - max(rest) > MIN_AXIS_GAIN_NATS:
            return _Vibration(shape, gains / scale, whole)
        gains[active[int(np.argmax(rest))]] = 0.0


def _fit_shape(spectra: CrossSpectra, shapes: Sequence[Shape]) -> _Vibration:
    """Return the strongest vibration. The bandwidth is fitted if the vibration can be significant."""
    found = []
    for resonance in (False, True):
        fits = [fit_correlations(spectra, shape) for shape in shapes if (shape[0] is not None) == resonance]
        if fits:
            best = max(fits, key=lambda one: one.gain_nats)
            possible = best.gain_nats > MIN_FIRST_GAIN_SHARE * best.penalty_nats
            found.append(_with_fitted_bandwidth(spectra, best) if possible else best)
    return max(found, key=lambda one: one.gain_nats - one.penalty_nats)


def _with_fitted_bandwidth(spectra: CrossSpectra, vibration: _Vibration) -> _Vibration:
    frequency, width = vibration.shape
    best = find_maximum_by_golden_section(
        lambda x: fit_correlations(spectra, (frequency, exp(x))).gain_nats,
        log(width) - MAX_LOG_BANDWIDTH_CHANGE,
        log(width) + MAX_LOG_BANDWIDTH_CHANGE,
        GAIN_ITERATIONS,
    )
    return max(vibration, fit_correlations(spectra, (frequency, exp(best))), key=lambda one: one.gain_nats)


@dataclass(frozen=True, slots=True)
class _JointFit:
    """Fit of the gains of one vibration to the correlations and to the spectra of the axes."""

    spectra: CrossSpectra  # the deviations contain the fitted vibration
    vibration: _Vibration
    hypotheses: Sequence[Hypothesis]
    kept: Sequence[Effects]  # added effects of each axis without the noise effects that the vibration replaces

    def with_gain(self, at: int, gain: float) -> "tuple[float, _JointFit]":
        """Return the joint log-likelihood, and the fit, with a new gain of one axis."""
        hypothesis, shape = self.hypotheses[at], self.vibration.shape
        effects = (*hypothesis.model, *self.kept[at], _as_effect(shape, gain))
        fixed = frozenset(i for i, effect in enumerate(effects) if isinstance(effect, CommonVibration))
        fit, bins = hypothesis.axis.fit(effects, fixed), hypothesis.axis.bins
        deviation, gains = self.spectra.deviation.copy(), self.vibration.gains.copy()
        stop_band = deviation[at] > MAX_DEVIATION
        deviation[at] = np.interp(self.spectra.bins.f_hz, bins.f_hz, np.sqrt(fit.whittle.variance))
        deviation[at, stop_band] = self.spectra.deviation[at, stop_band]
        gains[at] = gain
        spectra = replace(self.spectra, deviation=deviation)
        gain_nats = spectra.gain_nats(_unit_variance(spectra.bins, shape), gains)
        changed = replace(self, spectra=spectra, vibration=_Vibration(shape, gains, gain_nats))
        return fit.log_likelihood + gain_nats, changed


def _fit_gains_with_spectra(
    spectra: CrossSpectra, vibration: _Vibration, hypotheses: Sequence[Hypothesis]
) -> _JointFit:
    """Fit the gains to the correlations and to the spectra of the axes."""
    kept = [tuple(e for e in one.added if not _is_replaced(e, vibration.shape)) for one in hypotheses]
    joint = _JointFit(spectra, vibration, hypotheses, kept)
    for _ in range(GAIN_SWEEPS):
        for at in np.flatnonzero(vibration.gains).tolist():
            gain = _fit_gain(partial(_joint_log_likelihood, joint, at), float(joint.vibration.gains[at]))
            joint = joint.with_gain(at, gain)[1]
    return joint


def _joint_log_likelihood(joint: _JointFit, at: int, gain: float) -> float:
    return joint.with_gain(at, gain)[0]


def _fit_gain(log_likelihood: Callable[[float], float], start: float) -> float:
    return copysign(
        exp(
            find_maximum_by_golden_section(
                lambda x: log_likelihood(copysign(exp(x), start)),
                log(abs(start)) - MAX_LOG_GAIN_CHANGE,
                log(abs(start)) + MAX_LOG_GAIN_CHANGE,
                GAIN_ITERATIONS,
            )
        ),
        start,
    )


def _is_replaced(effect: object, shape: Shape) -> bool:
    """Return True if a vibration of the given shape replaces an added noise effect."""
    frequency, bandwidth = shape
    if isinstance(effect, Narrowband) and frequency is not None:
        return abs(effect.frequency - frequency) < max(effect.bandwidth, bandwidth)
    if isinstance(effect, ExponentiallyCorrelated) and frequency is None:
        return abs(log(bandwidth * pi * effect.correlation_time)) < log(MAX_SAME_BANDWIDTH_RATIO)
    return False


def _build_trial(joint: _JointFit, number: float, at: int) -> Trial:
    """Return the trial of the vibration on one axis, with half the gain of the correlations of this axis."""
    vibration = joint.vibration
    gain = float(vibration.gains[at])
    best = _joint_log_likelihood(joint, at, gain)
    ends = []
    for sign in (-1.0, 1.0):
        step = 0.01
        while step < 2.0 and best - _joint_log_likelihood(joint, at, gain * exp(sign * step)) < HALF_CHI2_95:
            step *= 1.5
        ends.append(gain * exp(sign * step))
    effect = _as_effect(vibration.shape, gain, number)
    intervals = {
        "source_number": ParameterInterval(number),
        "gain": ParameterInterval(gain, min(ends), max(ends)),
        "bandwidth": ParameterInterval(effect.bandwidth),
    }
    if effect.frequency is not None:
        intervals["frequency"] = ParameterInterval(effect.frequency)
    without = vibration.gains.copy()
    without[at] = 0.0
    penalty = PENALTY_NATS[effect.name] / np.count_nonzero(vibration.gains)
    unit = _unit_variance(joint.spectra.bins, vibration.shape)
    score = 0.5 * (vibration.gain_nats - joint.spectra.gain_nats(unit, without)) - penalty
    return Trial(effect.name, effect, score, intervals=intervals)


def _with_vibration(search: AxisSearchResult, kept: Effects, trial: Trial) -> AxisSearchResult:
    """Return the result of one axis with the vibration."""
    assert trial.effect is not None
    trial.effect.check_rate(search.hypothesis.axis.rate_hz)
    hypothesis = fit_with_fewest_changes(search.hypothesis.axis, (*kept, trial.effect), search.hypothesis.model)
    done = SearchRound(search.final, (trial,), hypothesis, accept_without_validation(VALIDATION_REASON))
    rounds, final = (*search.rounds, done), diagnose_hypothesis(hypothesis)
    return replace(search, rounds=rounds, hypothesis=hypothesis, final=final)
