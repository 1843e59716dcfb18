"""Candidate effects for one axis, with starting values from the data.

Each function examines one family of effects. It returns effects whose shape parameters are the best of their family,
given the effects that are already in the model. The caller fits their sizes. ``PENALTY_NATS`` is the penalty in nats
that an effect must exceed. It consists of the gain that chance gives a true model, an allowance for effects that can
occur at many places, and an allowance for fitted shape parameters. The values are empirical.
"""

from collections.abc import Callable
from typing import Final

import numpy as np

from monitor.noise.effect import GYROS, Effect
from monitor.noise.effects import (
    AngleRandomWalk,
    BandwidthLimit,
    BiasInstability,
    BiasStep,
    CrossAxis,
    ExponentiallyCorrelated,
    GSensitivity,
    Narrowband,
    PoissonSteps,
    QuantizationNoise,
    RandomTelegraph,
    RateRamp,
    RateRandomWalk,
    Sinusoidal,
    TemperatureBias,
    TemperatureLag,
    TurnOnTransient,
)
from monitor.reconcile.diagnostics.diagnostics import WhitenedAxis, find_line_peaks, power_gain, step_gains
from monitor.reconcile.likelihood.hypothesis import Hypothesis, refine_shape
from monitor.reconcile.preparation.axis import Axis, Effects

PENALTY_NATS: Final[dict[str, float]] = {
    "quantization_noise": 8.5,
    "angle_random_walk": 8.5,
    "bias_instability": 8.5,
    "rate_random_walk": 8.5,
    "rate_ramp": 8.5,
    "exponentially_correlated": 9.5 + 3.0,
    "sinusoidal": 23.0,
    "narrowband": 14.5 + 2.0,
    "temperature_bias": 9.0,
    "temperature_lag": 9.5 + 4.0,
    "turn_on_transient": 9.5 + 1.5,
    "bias_step": 14.5,
    "g_sensitivity": 9.5,
    "cross_axis": 9.5,
    "scale_factor": 10.9,
    "bandwidth_limit": 9.5 + 3.0,
    "sample_hold": 12.0,
    "resolution": 12.0,
    "saturation": 12.0,
    "outliers": 14.0,
    "noise_step": 12.0,
    "random_telegraph": 9.5 + 2.0,
    "poisson_steps": 8.5 + 1.5,
    "power_law": 9.5 + 2.0,
}
"""Penalty of each effect in nats of log-likelihood gain."""
SHAPES_PER_DECADE: Final = 4
"""Number of shape values per decade in the first search."""
MAX_CORRELATION_FRACTION: Final = 0.1
"""Longest correlation time as a fraction of the recording. A longer correlation looks like a random walk."""
MAX_TIME_CONSTANT_FRACTION: Final = 0.4
"""Longest time constant of a transient or delay as a fraction of the recording. A longer one looks like a slope."""
PEAK_SEPARATION_STEPS: Final = 24
"""Distance to each side, in quarters of a width, within which two windows contain the same peak."""
MIN_DELAY_FRACTION: Final = 0.002
"""Shortest temperature delay as a fraction of the recording. A shorter delay cannot be distinguished from none, because
of the noise of the thermometer.
"""
MAX_PEAKS: Final = 2
"""Largest number of peaks that are examined."""
FILTER_ORDERS: Final = (1, 2, 3, 4)
"""Orders of the low-pass filters that are tried."""

CandidateFunction = Callable[[Axis, Hypothesis, WhitenedAxis], list[Effect]]
"""Function that proposes effects of one family."""


def propose_classic_terms(axis: Axis, state: Hypothesis, seen: WhitenedAxis) -> list[Effect]:
    """Return the classic terms Q, N, B and K that the axis does not have yet.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    state : Hypothesis
        Fitted effects.
    seen : Sight
        Axis whitened by ``state``.
    """
    have = {type(effect) for effect in state.effects}
    small = _start_size(axis)
    every = (QuantizationNoise(Q=small), AngleRandomWalk(N=small), BiasInstability(B=small), RateRandomWalk(K=small))
    return [effect for effect in every if type(effect) not in have]


def propose_correlated_noise(axis: Axis, state: Hypothesis, seen: WhitenedAxis) -> list[Effect]:
    """Return a list with the best exponentially correlated noise, or an empty list if its correlation time is out of
    range.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    state : Hypothesis
        Fitted effects.
    seen : Sight
        Axis whitened by ``state``.
    """
    shortest, longest = 2.0 / axis.rate_hz, MAX_CORRELATION_FRACTION * axis.n / axis.rate_hz
    if longest <= shortest:
        return []
    times_s = np.geomspace(shortest, longest, max(3, round(SHAPES_PER_DECADE * np.log10(longest / shortest))))
    trials: list[Effect] = [
        ExponentiallyCorrelated(sigma=_start_size(axis), correlation_time=float(t)) for t in times_s
    ]
    best = _most_likely(axis, state.effects, trials)
    found = refine_shape(axis, (*state.effects, best), len(state.effects), ["correlation_time"], 2.0)[-1]
    assert isinstance(found, ExponentiallyCorrelated)
    return [found] if shortest <= found.correlation_time <= longest else []


def propose_resonances(axis: Axis, state: Hypothesis, seen: WhitenedAxis) -> list[Effect]:
    """Return resonances at the peaks of the whitened spectrum.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    state : Hypothesis
        Fitted effects.
    seen : Sight
        Axis whitened by ``state``.
    """
    found: list[Effect] = []
    for middle, width in find_spectral_peaks(seen):
        trials: list[Effect] = [
            Narrowband(sigma=_start_size(axis), frequency=middle, bandwidth=float(width * factor))
            for factor in (0.3, 0.6, 1.0, 1.8)
        ]
        best = _most_likely(axis, state.effects, trials)
        at = len(state.effects)
        effects = refine_shape(axis, (*state.effects, best), at, ["bandwidth"], 2.5)
        effects = refined_frequency(axis, effects, at)
        effects = refine_shape(axis, effects, at, ["bandwidth"], 1.5)
        found.append(effects[at])
    return found


def refined_frequency(axis: Axis, effects: Effects, index: int) -> Effects:
    """Return the effects with the centre frequency of a resonance refined within its width.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    effects : tuple of Effect
        Effects of the axis.
    index : int
        Index of the resonance.
    """
    peak = effects[index]
    assert isinstance(peak, Narrowband)
    return refine_shape(axis, effects, index, ["frequency"], 1.0 + 0.7 * peak.bandwidth / peak.frequency)


def find_spectral_peaks(seen: WhitenedAxis, most: int = MAX_PEAKS) -> list[tuple[float, float]]:
    """Return the peaks of the whitened spectrum that are wider than a line, strongest first.

    Parameters
    ----------
    seen : Sight
        Whitened axis.
    most : int, optional
        Largest number of peaks.

    Returns
    -------
    list of tuple of float
        Centre frequency and width of each peak in Hz.
    """
    n = seen.axis.n
    step_hz = 0.5 * seen.axis.rate_hz / n
    running = np.concatenate([[0.0], np.cumsum(seen.whitened**2)])
    found: list[tuple[float, float, float]] = []
    width = 8
    while width < n // 8:
        first = np.arange(width, n - 1 - width, max(1, width // 4))
        gains = power_gain(
            np.maximum((running[first + width] - running[first]) / width, 1.0), np.full(first.size, width)
        )
        for _ in range(most):
            at = int(np.argmax(gains))
            middle = (first[at] + 0.5 * width) * step_hz
            found.append((float(gains[at]), float(middle), float(width * step_hz)))
            gains[max(at - PEAK_SEPARATION_STEPS, 0) : at + PEAK_SEPARATION_STEPS + 1] = 0.0
        width *= 2
    chosen: list[tuple[float, float]] = []
    for gain, middle, wide in sorted(found, reverse=True):
        if gain < PENALTY_NATS["narrowband"] / 2.0 or len(chosen) == most:
            break
        if all(abs(middle - other) > 2.0 * (wide + width_of) for other, width_of in chosen):
            chosen.append((middle, wide))
    return chosen


def propose_sinusoids(axis: Axis, state: Hypothesis, seen: WhitenedAxis) -> list[Effect]:
    """Return sinusoids at the lines of the spectrum.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    state : Hypothesis
        Fitted effects.
    seen : Sight
        Axis whitened by ``state``.
    """
    found: list[Effect] = []
    for gain, f_hz in find_line_peaks(seen.white, axis.rate_hz, MAX_PEAKS):
        if gain > PENALTY_NATS["sinusoidal"] / 2.0:
            best = line_frequency(seen, f_hz)
            found.append(Sinusoidal(amplitude=_start_size(axis), frequency=best, phase=0.0))
    return found


def line_frequency(seen: WhitenedAxis, f_hz: float) -> float:
    """Return the frequency of the maximum of the periodogram near a given frequency, by golden-section search.

    Parameters
    ----------
    seen : Sight
        Whitened axis.
    f_hz : float
        Approximate frequency in Hz.
    """
    t = np.arange(seen.axis.n) / seen.axis.rate_hz
    half = 0.5 * seen.axis.rate_hz / seen.axis.n

    def power(f: float) -> float:
        return float(abs(np.exp(-2j * np.pi * f * t) @ seen.white))

    lo, hi = f_hz - half, f_hz + half
    for _ in range(16):
        a, b = hi - 0.618 * (hi - lo), lo + 0.618 * (hi - lo)
        lo, hi = (lo, b) if power(a) > power(b) else (a, hi)
    return 0.5 * (lo + hi)


def propose_low_pass(axis: Axis, state: Hypothesis, seen: WhitenedAxis) -> list[Effect]:
    """Return a list with the best low-pass filter, or an empty list if the effects already contain one or no filter
    fits.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    state : Hypothesis
        Fitted effects.
    seen : Sight
        Axis whitened by ``state``.
    """
    if any(isinstance(effect, BandwidthLimit) for effect in state.effects):
        return []
    nyquist = 0.5 * axis.rate_hz
    cutoffs = nyquist * np.geomspace(0.04, 0.95, 11)
    found: list[Effect] = []
    for order in FILTER_ORDERS:
        best = _most_likely(axis, state.effects, [BandwidthLimit(cutoff=float(f), order=order) for f in cutoffs])
        at = len(state.effects)
        effects = refine_shape(axis, (*state.effects, best), at, ["cutoff"], 1.4)
        if effects[at].cutoff < 0.99 * nyquist:  # type: ignore[attr-defined]
            found.append(effects[at])
    return [_most_likely(axis, state.effects, found)] if found else []


def propose_drifts(axis: Axis, state: Hypothesis, seen: WhitenedAxis) -> list[Effect]:
    """Return effects that follow time: a ramp, a transient after the start, and a step.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    state : Hypothesis
        Fitted effects.
    seen : Sight
        Axis whitened by ``state``.
    """
    length_s = axis.n / axis.rate_hz
    have = {type(effect) for effect in state.effects}
    found: list[Effect] = []
    if RateRamp not in have:
        found.append(RateRamp(R=_start_size(axis)))
    if TurnOnTransient not in have:
        times_s = np.geomspace(0.003, MAX_TIME_CONSTANT_FRACTION, 9) * length_s
        trials: list[Effect] = [TurnOnTransient(amplitude=1.0, time_constant=float(t)) for t in times_s]
        best = _most_likely(axis, state.effects, trials)
        at = len(state.effects)
        effects = refine_shape(axis, (*state.effects, best), at, ["time_constant"], 1.6)
        if effects[at].time_constant <= MAX_TIME_CONSTANT_FRACTION * length_s:  # type: ignore[attr-defined]
            found.append(effects[at])
    if not have & {PoissonSteps, RandomTelegraph}:
        gains, times = step_gains(seen)
        found.append(BiasStep(time=float(times[int(np.argmax(gains))]), height=1.0))
    return found


def propose_temperature_effects(axis: Axis, state: Hypothesis, seen: WhitenedAxis) -> list[Effect]:
    """Return effects that follow the temperature: linearly, quadratically or with a delay.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    state : Hypothesis
        Fitted effects.
    seen : Sight
        Axis whitened by ``state``.
    """
    if axis.temperature_c is None or np.ptp(axis.temperature_c) == 0.0:
        return []
    have = {type(effect) for effect in state.effects}
    reference = float(round(axis.temperature_c.mean(), 2))
    found: list[Effect] = []
    if TemperatureBias not in have:
        found.append(TemperatureBias(coefficient=1.0, reference=reference))
        found.append(TemperatureBias(coefficient=1.0, reference=reference, quadratic=1.0))
    if TemperatureLag not in have:
        length_s = axis.n / axis.rate_hz
        times_s = np.geomspace(MIN_DELAY_FRACTION * length_s, MAX_TIME_CONSTANT_FRACTION * length_s, 9)
        trials: list[Effect] = [
            TemperatureLag(coefficient=1.0, reference=reference, time_constant=float(t)) for t in times_s
        ]
        best = _most_likely(axis, state.effects, trials)
        at = len(state.effects)
        effects = refine_shape(axis, (*state.effects, best), at, ["time_constant"], 2.2)
        if MIN_DELAY_FRACTION * length_s < effects[at].time_constant <= MAX_TIME_CONSTANT_FRACTION * length_s:  # type: ignore[attr-defined]
            found.append(effects[at])
    return found


def propose_leaks(axis: Axis, state: Hypothesis, seen: WhitenedAxis) -> list[Effect]:
    """Return leaks from the other axes.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    state : Hypothesis
        Fitted effects.
    seen : Sight
        Axis whitened by ``state``.
    """
    have = {getattr(effect, "source", None) for effect in state.effects}
    found: list[Effect] = []
    for source in axis.others:
        if source not in have:
            same = (source in GYROS) == (axis.name in GYROS)
            leak = CrossAxis if same else GSensitivity
            found.append(leak(source=source, coefficient=1.0))
    return found


NOISE_CANDIDATES: Final[tuple[CandidateFunction, ...]] = (
    propose_classic_terms,
    propose_correlated_noise,
    propose_resonances,
    propose_sinusoids,
    propose_low_pass,
)
"""Functions that propose noise effects and filters."""
DETERMINISTIC_CANDIDATES: Final[tuple[CandidateFunction, ...]] = (
    propose_drifts,
    propose_temperature_effects,
    propose_leaks,
)
"""Functions that propose effects that follow time, temperature or another axis."""


def _most_likely(axis: Axis, effects: Effects, trials: list[Effect]) -> Effect:
    """Return the effect with the largest likelihood, with all sizes free."""
    return max(trials, key=lambda one: axis.fit((*effects, one)).log_likelihood)


def _start_size(axis: Axis) -> float:
    """Return a starting size that is small compared with the standard deviation of the samples."""
    return 1e-3 * float(np.sqrt(np.mean(axis.coefficients**2)))
