"""Check of the stated sample rate by the lines and resonances (features) of the model.

A wrong sample rate multiplies the frequencies of all features on all axes by the same ratio.
``search.sample_rate_from_spectrum`` estimates this ratio from the likelihood of all axes. The noise levels and lines of
a real sensor vary from run to run, which can change the likelihood in the same way as a wrong sample rate. This module
therefore tests each feature separately, relative to the surrounding spectrum.

- Features of the same frequency on several axes belong to one group, because they have the same cause. Harmonics
  belong to the group of the fundamental frequency.
- If the model states another sample rate than the recording, one group that moves by the ratio of both rates suffices.
- Otherwise, at least two groups must move by the same ratio, and no group may remain at the stated frequency.
- The estimate of ``search.sample_rate_from_spectrum`` is accepted if the groups move by nearly this ratio and no
  group remains at the stated frequency.
- If the groups are too weak for this test, the estimate is also accepted if the likelihood of the moved frequencies
  alone is clearly larger, and if the same ratio also describes the noise of each axis at least as well.

The noise level alone is no evidence for a wrong sample rate. An error of 20 % changes the level by 10 %, and the
noise of many sensors varies as much from run to run. The cutoff of a low-pass filter is not sharp enough to count as
evidence. For a sample rate that is wrong by 5 %, the gain of the cutoff is at most 7 nats in 60 000 samples of a real
sensor.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import exp, log
from typing import Final

import numpy as np
from scipy.ndimage import maximum_filter1d, uniform_filter1d

from drivers.data_types import Floats
from monitor.noise.effects import Narrowband, Sinusoidal
from monitor.noise.model import NoiseModel
from monitor.reconcile.likelihood.axis_fit import Effects
from monitor.reconcile.preparation.cosine_bins import cosine_transform
from monitor.reconcile.preparation.reconcile_input import RecordedAxes
from monitor.reconcile.result import ParameterInterval, RecordingFinding
from monitor.reconcile.search.sample_rate_from_spectrum import SampleRateErrorEstimate
from monitor.reconcile.search.sample_repair import fill_missing_samples

MAX_LOG_RATIO: Final = 0.25
"""Largest absolute logarithm of the ratio of true to stated sample rate."""
LOG_RATIO_STEP: Final = 1e-4
"""Spacing of the tested logarithms of the ratio."""
MAX_FREQUENCY_DRIFT: Final = 0.002
"""Largest relative change of a feature frequency between runs."""
MAX_STATED_FREQUENCY_DRIFT: Final = 0.006
"""Largest relative change of a feature frequency if the model states the ratio. Then only one ratio is tested."""
MAX_GROUP_GAIN_NATS: Final = 60.0
"""Largest gain in nats of one group. Larger gains are scaled down, so that one strong line cannot decide alone."""
MIN_GROUP_GAIN_NATS: Final = 10.0
"""Smallest gain in nats of a group that moves."""
MAX_GROUP_LOSS_NATS: Final = 8.0
"""Largest loss in nats of a group. A group with a larger loss has remained at the stated frequency."""
MIN_GAIN_NATS: Final = 25.0
"""Smallest total gain in nats of all groups for a ratio from the search over 5000 ratios."""
MIN_STATED_GAIN_NATS: Final = 12.0
"""Smallest total gain in nats for the single ratio that the model states."""
MIN_FEATURE_GAIN_NATS: Final = 20.0
"""Smallest gain in nats of weak features, if the noise of each axis agrees with the ratio."""
MAX_SPREAD: Final = 0.25
"""Largest deviation of a group from the common log ratio, as a fraction of the common log ratio."""
MAX_PEAK_LOG_DISTANCE: Final = 0.02
"""Largest difference between the log ratio from the likelihood and the log ratio at the peak of a group."""
SAME_GROUP_RATIO: Final = 1.01
"""Largest frequency ratio of the same feature on different axes."""
HARMONIC_TOLERANCE: Final = 0.003
"""Largest relative deviation of a harmonic from a multiple of its fundamental frequency."""
MAX_HARMONIC: Final = 5
"""Highest order of a harmonic."""
MIN_PEAK_BINS: Final = 3
"""Smallest number of cosine coefficients in a peak."""
CONTINUUM_PEAK_WIDTHS: Final = 10
"""Length of the blocks for the estimate of the surrounding spectrum, in widths of the peak."""
MIN_CONTINUUM_BINS: Final = 200
"""Smallest length of a block for the surrounding spectrum, in coefficients."""
CHI2_MEDIAN: Final = 0.4549364
"""Median of χ² with one degree of freedom."""
LOG_RATIOS: Final = (
    np.arange(-round(MAX_LOG_RATIO / LOG_RATIO_STEP), round(MAX_LOG_RATIO / LOG_RATIO_STEP) + 1) * LOG_RATIO_STEP
)


@dataclass(frozen=True, slots=True)
class FeaturesOfOneCause:
    """Features with the same cause, and the total gain of these features for each ratio of ``LOG_RATIOS``."""

    axis: str  # axis with the strongest feature
    f_hz: float  # frequency of this feature in the model
    gains: Floats  # [len(LOG_RATIOS)] log-likelihood gain of peaks over no peaks, at most MAX_GROUP_GAIN_NATS, nats


def estimate_sample_rate_error(
    coefficients: Mapping[str, Floats],
    rate_hz: float,
    effects: Mapping[str, Effects],
    model_rate_hz: float | None,
    by_likelihood: SampleRateErrorEstimate | None,
) -> SampleRateErrorEstimate | None:
    """Estimate the error of the stated sample rate from the features, or return None.

    Parameters
    ----------
    coefficients : mapping of str to ndarray, shape (n − 1,)
        Cosine transforms of the axes.
    rate_hz : float
        Stated sample rate in Hz.
    effects : mapping of str to tuple of Effect
        Effects of each axis in the model under test.
    model_rate_hz : float or None
        Sample rate in the model file in Hz.
    by_likelihood : SampleRateErrorEstimate or None
        Estimate from the likelihood of all axes.
    """
    groups = group_features_with_gains(coefficients, rate_hz, effects)
    if not groups:
        return by_likelihood
    if model_rate_hz is not None:
        stated = _estimate_stated_ratio(groups, log(model_rate_hz / rate_hz))
        if stated is not None:
            return stated
    common = _estimate_common_ratio(groups)
    if common is not None:
        return common
    return by_likelihood if by_likelihood and _is_supported(groups, by_likelihood) else None


def correct_impossible_sample_rate(
    recording: RecordedAxes, model: NoiseModel
) -> tuple[RecordedAxes, RecordingFinding] | None:
    """Correct a stated sample rate at which the features of the model are impossible.

    A feature above half the stated sample rate is impossible. The model may state a higher rate. If the features match
    the model at this higher rate, the stated rate is wrong.

    Parameters
    ----------
    recording : RecordedAxes
        Recording to check.
    model : NoiseModel
        Model under test.
    """
    highest = max((e.frequency for _, e in model if isinstance(e, Sinusoidal | Narrowband)), default=0.0)
    rate_hz = model.sample_rate_hz
    if rate_hz is None or not 0.5 * recording.rate_hz <= highest < 0.5 * rate_hz:
        return None
    rng = np.random.default_rng(0)
    coefficients = {
        axis: cosine_transform(fill_missing_samples(y, ~np.isfinite(y), rng))
        for axis, y in recording.values.items()
        if np.isfinite(y).any()
    }
    groups = group_features_with_gains(coefficients, rate_hz, model.effects)
    gain = sum(_max_gain_near(group.gains, 0.0, MAX_STATED_FREQUENCY_DRIFT) for group in groups)
    if gain < MIN_STATED_GAIN_NATS:
        return None
    ratio = rate_hz / recording.rate_hz
    strongest = max(groups, key=lambda group: float(group.gains.max()))
    interval = ParameterInterval(
        ratio, ratio * exp(-MAX_STATED_FREQUENCY_DRIFT), ratio * exp(MAX_STATED_FREQUENCY_DRIFT)
    )
    found = SampleRateErrorEstimate(interval, gain, strongest.axis, (strongest.f_hz, strongest.f_hz / ratio))
    changed = RecordedAxes(recording.values, rate_hz, recording.temperature_c)
    return changed, describe_sample_rate_error(found, recording.rate_hz)


def describe_sample_rate_error(error: SampleRateErrorEstimate, rate_hz: float) -> RecordingFinding:
    """Describe a wrong sample rate.

    Parameters
    ----------
    error : SampleRateErrorEstimate
        Estimated error.
    rate_hz : float
        Stated sample rate in Hz.
    """
    ratio = float(error.ratio.value)
    stated, observed = error.frequency
    return RecordingFinding(
        "sample_rate_error",
        (error.axis,),
        f"The true sample rate is {ratio:.5g} times the stated rate, {rate_hz * ratio:.5g} Hz instead of "
        f"{rate_hz:.5g} Hz. The feature of the model at {stated:.5g} Hz appears at {observed:.5g} Hz on {error.axis}. "
        f"The search uses the true rate.",
        {"ratio": error.ratio},
        {"gain_nats": error.gain, "model_frequency_hz": stated, "observed_frequency_hz": observed},
        corrected=True,
    )


def group_features_with_gains(
    coefficients: Mapping[str, Floats], rate_hz: float, effects: Mapping[str, Effects]
) -> list[FeaturesOfOneCause]:
    """Group the lines and resonances of the model, and compute the gains of the groups in the recording.

    Parameters
    ----------
    coefficients : mapping of str to ndarray, shape (n − 1,)
        Cosine transforms of the axes.
    rate_hz : float
        Stated sample rate in Hz.
    effects : mapping of str to tuple of Effect
        Effects of each axis in the model under test.
    """
    features = sorted(
        (effect.frequency, getattr(effect, "bandwidth", 0.0), axis)
        for axis in coefficients
        for effect in effects.get(axis, ())
        if isinstance(effect, Sinusoidal | Narrowband)
    )
    groups: list[list[tuple[float, str, Floats]]] = []
    for f_hz, width_hz, axis in features:
        one = (f_hz, axis, compute_peak_gains_by_ratio(coefficients[axis], rate_hz, f_hz, width_hz))
        home = next((group for group in groups if any(_is_related(f_hz, other) for other, _, _ in group)), None)
        if home is None:
            groups.append([one])
        else:
            home.append(one)
    found = []
    for group in groups:
        f_hz, axis, _ = max(group, key=lambda one: float(one[2].max()))
        gains = np.sum([one[2] for one in group], axis=0)
        found.append(
            FeaturesOfOneCause(axis, f_hz, gains * min(MAX_GROUP_GAIN_NATS / max(float(gains.max()), 1e-9), 1.0))
        )
    return found


def compute_peak_gains_by_ratio(coefficients: Floats, rate_hz: float, f_hz: float, width_hz: float) -> Floats:
    """Compute the gain in nats of a peak at the model frequency divided by each ratio of ``LOG_RATIOS``.

    Parameters
    ----------
    coefficients : ndarray of float64, shape (n − 1,)
        Cosine transform of one axis.
    rate_hz : float
        Stated sample rate in Hz.
    f_hz : float
        Frequency of the peak in the model in Hz.
    width_hz : float
        Width of the peak in Hz; 0 for a line.

    Examples
    --------
    >>> t = np.arange(20_000) / 100.0
    >>> y = np.random.default_rng(0).standard_normal(t.size) + 0.3 * np.sin(2.0 * np.pi * 10.0 * t)
    >>> gains = compute_peak_gains_by_ratio(cosine_transform(y), 100.0, 10.5, 0.0)
    >>> print(f"{np.exp(LOG_RATIOS[gains.argmax()]):.3f}")
    1.050
    """
    step_hz = 0.5 * rate_hz / (coefficients.size + 1)
    bins = max(MIN_PEAK_BINS, round(2.0 * max(width_hz, LOG_RATIO_STEP * f_hz) / step_hz))
    power = coefficients**2
    block = max(MIN_CONTINUUM_BINS, CONTINUUM_PEAK_WIDTHS * bins)
    first = max(int(f_hz * exp(-MAX_LOG_RATIO) / step_hz) - 2 * block, 0)
    last = min(int(f_hz * exp(MAX_LOG_RATIO) / step_hz) + 2 * block, power.size)
    if last - first < max(block, 2 * bins):
        return np.zeros(LOG_RATIOS.size)
    part = power[first:last]
    whole = part[: part.size // block * block].reshape(-1, block)
    middles = (np.arange(len(whole)) + 0.5) * block
    continuum = np.interp(np.arange(part.size), middles, np.median(whole, axis=1) / CHI2_MEDIAN)
    excess = np.maximum(uniform_filter1d(part / np.maximum(continuum, 1e-300), bins, mode="nearest"), 1.0)
    gains = 0.5 * bins * (excess - 1.0 - np.log(excess))
    at = np.rint(f_hz * np.exp(-LOG_RATIOS) / step_hz).astype(np.int64) - 1 - first
    inside = (at >= 0) & (at < part.size)
    return np.where(inside, gains[np.clip(at, 0, part.size - 1)], 0.0)


def _is_related(one_hz: float, other_hz: float) -> bool:
    """Return True if the frequencies are equal or one frequency is a harmonic of the other."""
    ratio = max(one_hz, other_hz) / min(one_hz, other_hz)
    near = round(ratio)
    return ratio < SAME_GROUP_RATIO or (near <= MAX_HARMONIC and abs(ratio / near - 1.0) < HARMONIC_TOLERANCE)


def _max_gain_near(gains: Floats, x: float, reach: float) -> float:
    """Return the largest gain for log ratios within ``reach`` of ``x``."""
    near = np.abs(LOG_RATIOS - x) <= reach + 0.5 * LOG_RATIO_STEP
    return float(gains[near].max(initial=0.0))


def _estimate_stated_ratio(groups: Sequence[FeaturesOfOneCause], x: float) -> SampleRateErrorEstimate | None:
    """Estimate the ratio near the stated log ratio ``x``, or return None if the features do not move by this ratio."""
    if not 10.0 * LOG_RATIO_STEP < abs(x) <= MAX_LOG_RATIO:
        return None
    reach = min(MAX_STATED_FREQUENCY_DRIFT, 0.5 * abs(x))
    moves = [
        _max_gain_near(one.gains, x, reach) - _max_gain_near(one.gains, 0.0, 0.25 * MAX_FREQUENCY_DRIFT)
        for one in groups
    ]
    if sum(moves) < MIN_STATED_GAIN_NATS or min(moves) < -MAX_GROUP_LOSS_NATS:
        return None
    return _build_estimate(groups, moves, x, reach)


def _estimate_common_ratio(groups: Sequence[FeaturesOfOneCause]) -> SampleRateErrorEstimate | None:
    """Estimate the common ratio by which the frequencies of the groups have moved.

    The result is None if fewer than two groups have moved, if their ratios differ, or if a group remains at the stated
    frequency.
    """
    wide = [maximum_filter1d(one.gains, 2 * round(MAX_FREQUENCY_DRIFT / LOG_RATIO_STEP) + 1) for one in groups]
    total = np.where(np.abs(LOG_RATIOS) > MAX_FREQUENCY_DRIFT, np.sum(wide, axis=0), 0.0)
    best = int(total.argmax())
    moves = [float(one[best] - one[LOG_RATIOS.size // 2]) for one in wide]
    moved = [group for group, gain in zip(groups, moves, strict=True) if gain >= MIN_GROUP_GAIN_NATS]
    if sum(moves) < MIN_GAIN_NATS or len(moved) < 2 or min(moves) < -MAX_GROUP_LOSS_NATS:
        return None
    near = np.abs(LOG_RATIOS - LOG_RATIOS[best]) <= 2.0 * MAX_FREQUENCY_DRIFT
    of_groups = np.array([LOG_RATIOS[near][group.gains[near].argmax()] for group in moved])
    weights = np.array([group.gains[near].max() for group in moved])
    x = float(weights @ of_groups / weights.sum())
    spread = float(np.abs(of_groups - x).max())
    if spread > MAX_SPREAD * abs(x):
        return None
    return _build_estimate(groups, moves, x, 2.0 * spread + LOG_RATIO_STEP)


def _is_supported(groups: Sequence[FeaturesOfOneCause], estimate: SampleRateErrorEstimate) -> bool:
    """Return True if groups move by nearly the estimated ratio and no group remains at the stated frequency."""
    x = log(float(estimate.ratio.value))
    every_axis_agrees = estimate.smallest_axis_gain >= 0.0 and abs(x) > MAX_FREQUENCY_DRIFT
    moves = [
        _max_gain_near(one.gains, x, MAX_FREQUENCY_DRIFT) - _max_gain_near(one.gains, 0.0, 0.25 * MAX_FREQUENCY_DRIFT)
        for one in groups
    ]
    is_clear = sum(moves) >= MIN_STATED_GAIN_NATS or (
        every_axis_agrees and estimate.feature_gain >= MIN_FEATURE_GAIN_NATS
    )
    if not is_clear or min(moves) < -MAX_GROUP_LOSS_NATS:
        return False
    near = np.abs(LOG_RATIOS - x) <= MAX_PEAK_LOG_DISTANCE
    own = [LOG_RATIOS[near][one.gains[near].argmax()] for one in groups if one.gains[near].max() >= MIN_GROUP_GAIN_NATS]
    return all(abs(peak - x) <= max(MAX_SPREAD * abs(x), LOG_RATIO_STEP) for peak in own)


def _build_estimate(
    groups: Sequence[FeaturesOfOneCause], moves: Sequence[float], x: float, error: float
) -> SampleRateErrorEstimate:
    strongest = groups[int(np.argmax(moves))]
    ratio = ParameterInterval(exp(x), exp(x - error), exp(x + error))
    return SampleRateErrorEstimate(ratio, sum(moves), strongest.axis, (strongest.f_hz, strongest.f_hz / exp(x)))
