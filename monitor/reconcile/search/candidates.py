"""Candidate effects for one axis, with starting values from the data.

Each function proposes effects of one kind for a whitened axis. Shape parameters are fitted here, and the caller fits
the sizes. ``PENALTY_NATS`` contains the log-likelihood gain that an effect reaches by chance. The penalties are
empirical. Effects that can occur at many frequencies or times have larger penalties.
"""

from collections.abc import Callable, Sequence
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
from monitor.reconcile.diagnostics.diagnostics import (
    compute_level_step_gains,
    find_periodogram_peaks,
    fitted_variance_gain_nats,
)
from monitor.reconcile.likelihood.axis_fit import Axis, Effects
from monitor.reconcile.likelihood.hypothesis import fit_shape_parameter
from monitor.reconcile.likelihood.whitening import WhitenedAxis

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
"""Penalty of each effect in nats."""
SHAPES_PER_DECADE: Final = 4
"""Number of shape values per decade in the first search."""
MAX_CORRELATION_FRACTION: Final = 0.1
"""Longest correlation time, as a fraction of the recording length."""
MAX_TIME_CONSTANT_FRACTION: Final = 0.4
"""Longest time constant of a transient or delay, as a fraction of the recording length."""
PEAK_SEPARATION_STEPS: Final = 24
"""Smallest distance between two peaks, in quarters of the window width."""
MIN_DELAY_FRACTION: Final = 0.002
"""Shortest temperature delay, as a fraction of the recording length."""
MAX_PEAKS: Final = 2
FILTER_ORDERS: Final = (1, 2, 3, 4)

CandidateFunction = Callable[[WhitenedAxis], list[Effect]]
"""Function that proposes effects of one kind."""


def propose_allan_terms(whitened: WhitenedAxis) -> list[Effect]:
    """Propose the noise terms Q, N, B and K that the current hypothesis lacks."""
    small = initial_effect_size(whitened.axis)
    every = (QuantizationNoise(Q=small), AngleRandomWalk(N=small), BiasInstability(B=small), RateRandomWalk(K=small))
    return [effect for effect in every if type(effect) not in whitened.effect_types]


def propose_correlated_noise(whitened: WhitenedAxis) -> list[Effect]:
    """Propose exponentially correlated noise, if a suitable correlation time is found."""
    return fit_correlated_noise(whitened.axis, whitened.effects)


def fit_correlated_noise(axis: Axis, effects: Effects) -> list[Effect]:
    """Fit exponentially correlated noise. The list is empty if the correlation time is out of range.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    effects : tuple of Effect
        Other effects of the axis.
    """
    shortest, longest = 2.0 / axis.rate_hz, MAX_CORRELATION_FRACTION * axis.n / axis.rate_hz
    if longest <= shortest:
        return []
    times_s = np.geomspace(shortest, longest, max(3, round(SHAPES_PER_DECADE * np.log10(longest / shortest))))
    best = _most_likely(
        axis,
        effects,
        [ExponentiallyCorrelated(sigma=initial_effect_size(axis), correlation_time=float(t)) for t in times_s],
    )
    found = fit_shape_parameter(axis, effects, best, "correlation_time", 2.0)
    assert isinstance(found, ExponentiallyCorrelated)
    return [found] if shortest <= found.correlation_time <= longest else []


def propose_resonances(whitened: WhitenedAxis) -> list[Effect]:
    """Propose resonances at the peaks of the whitened spectrum."""
    axis, found = whitened.axis, list[Effect]()
    for middle, width in find_spectral_peaks(whitened):
        trials = [
            Narrowband(sigma=initial_effect_size(axis), frequency=middle, bandwidth=float(width * factor))
            for factor in (0.3, 0.6, 1.0, 1.8)
        ]
        peak = _most_likely(axis, whitened.effects, trials)
        peak = fit_shape_parameter(axis, whitened.effects, peak, "bandwidth", 2.5)
        assert isinstance(peak, Narrowband)
        peak = fit_shape_parameter(
            axis, whitened.effects, peak, "frequency", 1.0 + 0.7 * peak.bandwidth / peak.frequency
        )
        found.append(fit_shape_parameter(axis, whitened.effects, peak, "bandwidth", 1.5))
    return found


def find_spectral_peaks(whitened: WhitenedAxis, max_peaks: int = MAX_PEAKS) -> list[tuple[float, float]]:
    """Find the peaks of the whitened spectrum that are wider than a spectral line, in descending order.

    Parameters
    ----------
    whitened : WhitenedAxis
        Whitened axis.
    max_peaks : int, optional
        Largest number of peaks.

    Returns
    -------
    list of tuple of float
        Centre frequency and width of each peak in Hz.
    """
    n = whitened.axis.n
    step_hz = 0.5 * whitened.axis.rate_hz / n
    running = np.concatenate([[0.0], np.cumsum(whitened.coefficients**2)])
    found: list[tuple[float, float, float]] = []
    width = 8
    while width < n // 8:
        first = np.arange(width, n - 1 - width, max(1, width // 4))
        power = np.maximum((running[first + width] - running[first]) / width, 1.0)
        gains = fitted_variance_gain_nats(power, np.full(first.size, width))
        for _ in range(max_peaks):
            at = int(np.argmax(gains))
            middle = (first[at] + 0.5 * width) * step_hz
            found.append((float(gains[at]), float(middle), float(width * step_hz)))
            gains[max(at - PEAK_SEPARATION_STEPS, 0) : at + PEAK_SEPARATION_STEPS + 1] = 0.0
        width *= 2
    chosen: list[tuple[float, float]] = []
    for gain, middle, wide in sorted(found, reverse=True):
        if gain < PENALTY_NATS["narrowband"] / 2.0 or len(chosen) == max_peaks:
            break
        if all(abs(middle - other) > 2.0 * (wide + width_of) for other, width_of in chosen):
            chosen.append((middle, wide))
    return chosen


def propose_sinusoids(whitened: WhitenedAxis) -> list[Effect]:
    """Propose sinusoids at the strongest spectral lines."""
    return [
        Sinusoidal(amplitude=initial_effect_size(whitened.axis), frequency=_line_frequency(whitened, f_hz), phase=0.0)
        for gain, f_hz in find_periodogram_peaks(whitened.series, whitened.axis.rate_hz, MAX_PEAKS)
        if gain > PENALTY_NATS["sinusoidal"] / 2.0
    ]


def _line_frequency(whitened: WhitenedAxis, f_hz: float) -> float:
    """Return the frequency, near ``f_hz``, with the largest value of the periodogram."""
    t = np.arange(whitened.axis.n) / whitened.axis.rate_hz
    half = 0.5 * whitened.axis.rate_hz / whitened.axis.n

    def power(f: float) -> float:
        return float(abs(np.exp(-2j * np.pi * f * t) @ whitened.series))

    lo, hi = f_hz - half, f_hz + half
    for _ in range(16):
        a, b = hi - 0.618 * (hi - lo), lo + 0.618 * (hi - lo)
        lo, hi = (lo, b) if power(a) > power(b) else (a, hi)
    return 0.5 * (lo + hi)


def propose_low_pass(whitened: WhitenedAxis) -> list[Effect]:
    """Propose a low-pass filter, if the current hypothesis contains none."""
    if BandwidthLimit in whitened.effect_types:
        return []
    axis = whitened.axis
    nyquist = 0.5 * axis.rate_hz
    cutoffs = nyquist * np.geomspace(0.04, 0.95, 11)
    found: list[Effect] = []
    for order in FILTER_ORDERS:
        best = _most_likely(axis, whitened.effects, [BandwidthLimit(cutoff=float(f), order=order) for f in cutoffs])
        refined = fit_shape_parameter(axis, whitened.effects, best, "cutoff", 1.4)
        assert isinstance(refined, BandwidthLimit)
        if refined.cutoff < 0.99 * nyquist:
            found.append(refined)
    return [_most_likely(axis, whitened.effects, found)] if found else []


def propose_drifts(whitened: WhitenedAxis) -> list[Effect]:
    """Propose a ramp, a transient at the start, and a step of the bias."""
    found: list[Effect] = []
    if RateRamp not in whitened.effect_types:
        found.append(RateRamp(R=initial_effect_size(whitened.axis)))
    if TurnOnTransient not in whitened.effect_types:
        times_s = np.geomspace(0.003, MAX_TIME_CONSTANT_FRACTION, 9) * whitened.axis.length_s
        trials = [TurnOnTransient(amplitude=1.0, time_constant=float(t)) for t in times_s]
        found += _best_time_constant(whitened, trials, 1.6, 0.0)
    if not whitened.effect_types & {PoissonSteps, RandomTelegraph}:
        gains, times_s = compute_level_step_gains(whitened)
        found.append(BiasStep(time=float(times_s[int(np.argmax(gains))]), height=1.0))
    return found


def propose_temperature_effects(whitened: WhitenedAxis) -> list[Effect]:
    """Propose linear, quadratic and delayed temperature effects."""
    temperature_c = whitened.axis.temperature_c
    if temperature_c is None or np.ptp(temperature_c) == 0.0:
        return []
    reference = float(round(temperature_c.mean(), 2))
    found: list[Effect] = []
    if TemperatureBias not in whitened.effect_types:
        found.append(TemperatureBias(coefficient=1.0, reference=reference))
        found.append(TemperatureBias(coefficient=1.0, reference=reference, quadratic=1.0))
    if TemperatureLag not in whitened.effect_types:
        shortest_s = MIN_DELAY_FRACTION * whitened.axis.length_s
        times_s = np.geomspace(shortest_s, MAX_TIME_CONSTANT_FRACTION * whitened.axis.length_s, 9)
        lags = [TemperatureLag(coefficient=1.0, reference=reference, time_constant=float(t)) for t in times_s]
        found += _best_time_constant(whitened, lags, 2.2, shortest_s)
    return found


def _best_time_constant(
    whitened: WhitenedAxis, trials: Sequence[TurnOnTransient | TemperatureLag], search_factor: float, shortest_s: float
) -> list[Effect]:
    """Return the most likely effect, or an empty list if the fitted time constant is out of range."""
    best = _most_likely(whitened.axis, whitened.effects, trials)
    refined = fit_shape_parameter(whitened.axis, whitened.effects, best, "time_constant", search_factor)
    assert isinstance(refined, (TurnOnTransient, TemperatureLag))
    longest_s = MAX_TIME_CONSTANT_FRACTION * whitened.axis.length_s
    return [refined] if shortest_s < refined.time_constant <= longest_s else []


def propose_leaks_from_other_axes(whitened: WhitenedAxis) -> list[Effect]:
    """Propose a leak from each other axis that is not yet a source of a leak."""
    known = {getattr(effect, "source", None) for effect in whitened.effects}
    found: list[Effect] = []
    for source in whitened.axis.leak_sources:
        if source not in known:
            same_kind = (source in GYROS) == (whitened.axis.name in GYROS)
            leak = CrossAxis if same_kind else GSensitivity
            found.append(leak(source=source, coefficient=1.0))
    return found


NOISE_CANDIDATES: Final[tuple[CandidateFunction, ...]] = (
    propose_allan_terms,
    propose_correlated_noise,
    propose_resonances,
    propose_sinusoids,
    propose_low_pass,
)
"""Functions that propose noise effects and filters."""
DETERMINISTIC_CANDIDATES: Final[tuple[CandidateFunction, ...]] = (
    propose_drifts,
    propose_temperature_effects,
    propose_leaks_from_other_axes,
)
"""Functions that propose effects that depend on time, temperature or another axis."""


def _most_likely(axis: Axis, effects: Effects, trials: Sequence[Effect]) -> Effect:
    return max(trials, key=lambda one: axis.fit((*effects, one)).log_likelihood)


def initial_effect_size(axis: Axis) -> float:
    """Return a small starting value for the size of an effect, relative to the noise of the axis."""
    return 1e-3 * axis.coefficient_rms
