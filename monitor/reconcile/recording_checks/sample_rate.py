"""Check whether the stated sample rate is wrong, from the lines and resonances that the model knows.

A wrong sample rate moves all features of all axes by one ratio. ``search.sample_rate_error`` estimates the ratio from
the likelihood of all axes with the noise sizes of the model. Real noise levels and real lines differ from run to run,
and both can imitate a ratio. This module therefore examines each feature alone, relative to the spectrum around it:

- Features of one frequency on several axes, and harmonics, are one group, because one disturbance causes all of them.
- Without further evidence, two groups must move by one ratio, and no group may stay.
- If the model states another sample rate than the recording, one group that moves by just this ratio is sufficient.
- The estimate of ``search.sample_rate_error`` is accepted if the groups move by nearly this ratio and none stays.

The level of the noise is no evidence, because a rate that is 20 % wrong changes the level by 10 %, and the noise of
many sensors changes as much from run to run. The edge of a low-pass filter gains too little: at most 7 nats for an
error of 5 % in 60 000 samples of a real sensor.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import exp, log
from typing import Final

import numpy as np
from scipy.ndimage import maximum_filter1d, uniform_filter1d

from drivers.sample import Floats
from monitor.noise.effects import Narrowband, Sinusoidal
from monitor.noise.model import NoiseModel
from monitor.reconcile.likelihood.axis import Effects
from monitor.reconcile.preparation.cosine_bins import cosine_transform
from monitor.reconcile.preparation.recording import Recording
from monitor.reconcile.preparation.sample_repair import fill_missing
from monitor.reconcile.result import ParameterInterval, RecordingFinding
from monitor.reconcile.search.sample_rate_error import SampleRateErrorEstimate

MAX_LOG_RATIO: Final = 0.25
"""Largest absolute logarithm of the ratio."""
GRID_STEP: Final = 1e-4
"""Step of the logarithm of the ratio."""
DRIFT: Final = 0.002
"""Relative change of a frequency that is natural from run to run."""
MAX_STATED_DRIFT: Final = 0.006
"""The same change if the model states the other rate, which leaves a single ratio to test."""
MAX_GROUP_GAIN: Final = 60.0
"""Largest gain in nats of one group. Larger gains are scaled to it, because a strong line alone must not decide."""
MIN_GROUP_GAIN: Final = 10.0
"""Smallest gain in nats of a group that moves."""
MAX_GROUP_LOSS: Final = 8.0
"""Largest loss in nats of a group. A group that loses more has stayed at the stated frequency."""
MIN_GAIN: Final = 25.0
"""Smallest gain in nats of all groups for any ratio. The price of the search over 5000 ratios is included."""
MIN_STATED_GAIN: Final = 12.0
"""Smallest gain in nats for the one ratio that the model states."""
MAX_SPREAD: Final = 0.25
"""Largest distance of the ratio of a group from the common ratio, relative to the logarithm of the common ratio."""
SUPPORT_REACH: Final = 0.02
"""Distance from the ratio of the likelihood within which the peak of each group is looked for."""
SAME_GROUP_RATIO: Final = 1.01
"""Largest ratio of two frequencies that belong to one group."""
HARMONIC_TOLERANCE: Final = 0.003
"""Largest relative deviation of a harmonic from a multiple of its fundamental frequency."""
MAX_HARMONIC: Final = 5
"""Highest harmonic that is looked for."""
MIN_PEAK_BINS: Final = 3
"""Smallest number of coefficients of a peak."""
CONTINUUM_PEAK_WIDTHS: Final = 10
"""Length of the blocks from which the spectrum around a peak is measured, in widths of the peak."""
MIN_CONTINUUM_BINS: Final = 200
"""Smallest length of these blocks in coefficients."""
CHI2_MEDIAN: Final = 0.4549364
"""Median of χ² with one degree of freedom."""
GRID: Final = np.arange(-round(MAX_LOG_RATIO / GRID_STEP), round(MAX_LOG_RATIO / GRID_STEP) + 1) * GRID_STEP


@dataclass(frozen=True, slots=True)
class FeatureGroup:
    """Features that one disturbance causes, with their gain for each ratio of ``GRID``."""

    axis: str  # axis with the strongest feature
    f_hz: float  # frequency of this feature in the model
    gains: Floats  # [len(GRID)] log-likelihood gain of peaks over no peaks, at most MAX_GROUP_GAIN, nats


def estimate_sample_rate_error(
    coefficients: Mapping[str, Floats],
    rate_hz: float,
    effects: Mapping[str, Effects],
    model_rate_hz: float | None,
    by_likelihood: SampleRateErrorEstimate | None,
) -> SampleRateErrorEstimate | None:
    """Return the error of the stated sample rate that the features show, or None.

    Parameters
    ----------
    coefficients : mapping of str to ndarray, shape (n − 1,)
        Cosine transforms of the axes.
    rate_hz : float
        Stated sample rate in Hz.
    effects : mapping of str to tuple of Effect
        Effects of each axis in the model under test.
    model_rate_hz : float or None
        Sample rate that the model states.
    by_likelihood : SampleRateErrorEstimate or None
        Estimate from the likelihood of all axes.
    """
    groups = feature_groups(coefficients, rate_hz, effects)
    if not groups:
        return by_likelihood
    if model_rate_hz is not None:
        stated = _of_stated_rate(groups, log(model_rate_hz / rate_hz))
        if stated is not None:
            return stated
    common = _of_common_ratio(groups)
    if common is not None:
        return common
    return by_likelihood if by_likelihood and _is_supported(groups, log(float(by_likelihood.ratio.value))) else None


def correct_impossible_rate(recording: Recording, model: NoiseModel) -> tuple[Recording, RecordingFinding] | None:
    """Return the recording at the rate of the model if the model cannot exist at the stated rate.

    A feature of the model above half the stated sample rate is impossible. If the model states a higher rate, at which
    the features are where the model has them, the stated rate is wrong.

    Parameters
    ----------
    recording : Recording
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
        axis: cosine_transform(fill_missing(y, ~np.isfinite(y), rng))
        for axis, y in recording.values.items()
        if np.isfinite(y).any()
    }
    groups = feature_groups(coefficients, rate_hz, model.effects)
    gain = sum(_near(group.gains, 0.0, MAX_STATED_DRIFT) for group in groups)
    if gain < MIN_STATED_GAIN:
        return None
    ratio = rate_hz / recording.rate_hz
    strongest = max(groups, key=lambda group: float(group.gains.max()))
    interval = ParameterInterval(ratio, ratio * exp(-MAX_STATED_DRIFT), ratio * exp(MAX_STATED_DRIFT))
    found = SampleRateErrorEstimate(interval, gain, strongest.axis, (strongest.f_hz, strongest.f_hz / ratio))
    changed = Recording(recording.values, rate_hz, recording.temperature_c)
    return changed, describe_sample_rate_error(found, recording.rate_hz)


def describe_sample_rate_error(error: SampleRateErrorEstimate, rate_hz: float) -> RecordingFinding:
    """Return the finding for a wrong sample rate.

    Parameters
    ----------
    error : SampleRateErrorEstimate
        Detected error.
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


def feature_groups(
    coefficients: Mapping[str, Floats], rate_hz: float, effects: Mapping[str, Effects]
) -> list[FeatureGroup]:
    """Return the groups of lines and resonances of the model, with their gains in the recording.

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
        one = (f_hz, axis, peak_gains(coefficients[axis], rate_hz, f_hz, width_hz))
        home = next((group for group in groups if any(_is_related(f_hz, other) for other, _, _ in group)), None)
        if home is None:
            groups.append([one])
        else:
            home.append(one)
    found = []
    for group in groups:
        f_hz, axis, _ = max(group, key=lambda one: float(one[2].max()))
        gains = np.sum([one[2] for one in group], axis=0)
        found.append(FeatureGroup(axis, f_hz, gains * min(MAX_GROUP_GAIN / max(float(gains.max()), 1e-9), 1.0)))
    return found


def peak_gains(coefficients: Floats, rate_hz: float, f_hz: float, width_hz: float) -> Floats:
    """Return for each ratio of ``GRID`` the gain of a peak at the frequency divided by the ratio, in nats.

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
    >>> gains = peak_gains(cosine_transform(y), 100.0, 10.5, 0.0)
    >>> print(f"{np.exp(GRID[gains.argmax()]):.3f}")
    1.050
    """
    step_hz = 0.5 * rate_hz / (coefficients.size + 1)
    bins = max(MIN_PEAK_BINS, round(2.0 * max(width_hz, GRID_STEP * f_hz) / step_hz))
    power = coefficients**2
    block = max(MIN_CONTINUUM_BINS, CONTINUUM_PEAK_WIDTHS * bins)
    first = max(int(f_hz * exp(-MAX_LOG_RATIO) / step_hz) - 2 * block, 0)
    last = min(int(f_hz * exp(MAX_LOG_RATIO) / step_hz) + 2 * block, power.size)
    if last - first < max(block, 2 * bins):
        return np.zeros(GRID.size)
    part = power[first:last]
    whole = part[: part.size // block * block].reshape(-1, block)
    middles = (np.arange(len(whole)) + 0.5) * block
    continuum = np.interp(np.arange(part.size), middles, np.median(whole, axis=1) / CHI2_MEDIAN)
    excess = np.maximum(uniform_filter1d(part / np.maximum(continuum, 1e-300), bins, mode="nearest"), 1.0)
    gains = 0.5 * bins * (excess - 1.0 - np.log(excess))
    at = np.rint(f_hz * np.exp(-GRID) / step_hz).astype(np.int64) - 1 - first
    inside = (at >= 0) & (at < part.size)
    return np.where(inside, gains[np.clip(at, 0, part.size - 1)], 0.0)


def _is_related(one_hz: float, other_hz: float) -> bool:
    """Return True if two frequencies are equal, or one is a harmonic of the other."""
    ratio = max(one_hz, other_hz) / min(one_hz, other_hz)
    near = round(ratio)
    return ratio < SAME_GROUP_RATIO or (near <= MAX_HARMONIC and abs(ratio / near - 1.0) < HARMONIC_TOLERANCE)


def _near(gains: Floats, x: float, reach: float) -> float:
    """Return the largest gain within a distance of one logarithm of the ratio."""
    near = np.abs(GRID - x) <= reach + 0.5 * GRID_STEP
    return float(gains[near].max(initial=0.0))


def _of_stated_rate(groups: Sequence[FeatureGroup], x: float) -> SampleRateErrorEstimate | None:
    """Return the ratio that the model states if the features move by it."""
    if not 10.0 * GRID_STEP < abs(x) <= MAX_LOG_RATIO:
        return None
    reach = min(MAX_STATED_DRIFT, 0.5 * abs(x))
    moves = [_near(one.gains, x, reach) - _near(one.gains, 0.0, 0.25 * DRIFT) for one in groups]
    if sum(moves) < MIN_STATED_GAIN or min(moves) < -MAX_GROUP_LOSS:
        return None
    return _estimate(groups, moves, x, reach)


def _of_common_ratio(groups: Sequence[FeatureGroup]) -> SampleRateErrorEstimate | None:
    """Return the ratio by which at least two groups move and no group stays."""
    wide = [maximum_filter1d(one.gains, 2 * round(DRIFT / GRID_STEP) + 1) for one in groups]
    total = np.where(np.abs(GRID) > DRIFT, np.sum(wide, axis=0), 0.0)
    best = int(total.argmax())
    moves = [float(one[best] - one[GRID.size // 2]) for one in wide]
    moved = [group for group, gain in zip(groups, moves, strict=True) if gain >= MIN_GROUP_GAIN]
    if sum(moves) < MIN_GAIN or len(moved) < 2 or min(moves) < -MAX_GROUP_LOSS:
        return None
    near = np.abs(GRID - GRID[best]) <= 2.0 * DRIFT
    of_groups = np.array([GRID[near][group.gains[near].argmax()] for group in moved])
    weights = np.array([group.gains[near].max() for group in moved])
    x = float(weights @ of_groups / weights.sum())
    spread = float(np.abs(of_groups - x).max())
    if spread > MAX_SPREAD * abs(x):
        return None
    return _estimate(groups, moves, x, 2.0 * spread + GRID_STEP)


def _is_supported(groups: Sequence[FeatureGroup], x: float) -> bool:
    """Return True if groups move by a ratio, all of them by nearly the same ratio, and no group stays."""
    moves = [_near(one.gains, x, DRIFT) - _near(one.gains, 0.0, 0.25 * DRIFT) for one in groups]
    if sum(moves) < MIN_STATED_GAIN or min(moves) < -MAX_GROUP_LOSS:
        return False
    near = np.abs(GRID - x) <= SUPPORT_REACH
    own = [GRID[near][one.gains[near].argmax()] for one in groups if one.gains[near].max() >= MIN_GROUP_GAIN]
    return all(abs(peak - x) <= max(MAX_SPREAD * abs(x), GRID_STEP) for peak in own)


def _estimate(
    groups: Sequence[FeatureGroup], moves: Sequence[float], x: float, error: float
) -> SampleRateErrorEstimate:
    """Return the estimate for one logarithm of the ratio."""
    strongest = groups[int(np.argmax(moves))]
    ratio = ParameterInterval(exp(x), exp(x - error), exp(x + error))
    return SampleRateErrorEstimate(ratio, sum(moves), strongest.axis, (strongest.f_hz, strongest.f_hz / exp(x)))
