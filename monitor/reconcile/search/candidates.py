"""From what a lens shows to effects worth trying, with first guesses from the data.

Every function looks at one family and gives effects whose shapes are the best of their kind beside the effects at
hand; their sizes are fitted by whoever tries them. ``PRICE`` is what a name must be worth before it is given: what
chance gives a true model, more for names that can stand in many places, and an allowance for the shapes that were
fitted. The numbers are empirical.
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
from monitor.reconcile.diagnostics.diagnostics import Sight, line_peaks, power_gain, step_gains
from monitor.reconcile.likelihood.hypothesis import Hypothesis, refined
from monitor.reconcile.preparation.axis import Axis, Effects

PRICE: Final[dict[str, float]] = {
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
PER_DECADE: Final = 4
"""Shapes of a first look."""
LONGEST: Final = 0.1
"""Of the recording: a correlation that is longer reads as a random walk."""
SLOWEST: Final = 0.4
"""Of the recording: a transient or a delay that is longer reads as a slope."""
APART: Final = 24
"""Quarters of a width, to each side: windows nearer than that see one peak."""
PROMPT: Final = 0.002
"""Of the recording: what follows temperature with less delay follows it at once; the thermometer's noise does the
rest."""
PEAKS: Final = 2
ORDERS: Final = (1, 2, 3, 4)

Family = Callable[[Axis, Hypothesis, Sight], list[Effect]]


def noises(axis: Axis, state: Hypothesis, seen: Sight) -> list[Effect]:
    """The classic terms that the axis has not."""
    have = {type(effect) for effect in state.effects}
    small = _small(axis)
    every = (QuantizationNoise(Q=small), AngleRandomWalk(N=small), BiasInstability(B=small), RateRandomWalk(K=small))
    return [effect for effect in every if type(effect) not in have]


def correlated(axis: Axis, state: Hypothesis, seen: Sight) -> list[Effect]:
    """One exponentially correlated noise."""
    shortest, longest = 2.0 / axis.rate_hz, LONGEST * axis.n / axis.rate_hz
    if longest <= shortest:
        return []
    times_s = np.geomspace(shortest, longest, max(3, round(PER_DECADE * np.log10(longest / shortest))))
    trials: list[Effect] = [ExponentiallyCorrelated(sigma=_small(axis), correlation_time=float(t)) for t in times_s]
    best = _best(axis, state.effects, trials)
    found = refined(axis, (*state.effects, best), len(state.effects), ["correlation_time"], 2.0)[-1]
    assert isinstance(found, ExponentiallyCorrelated)
    return [found] if shortest <= found.correlation_time <= longest else []


def ringing(axis: Axis, state: Hypothesis, seen: Sight) -> list[Effect]:
    """Resonances, where the whitened spectrum has peaks."""
    found: list[Effect] = []
    for middle, width in peaks(seen):
        trials: list[Effect] = [
            Narrowband(sigma=_small(axis), frequency=middle, bandwidth=float(width * factor))
            for factor in (0.3, 0.6, 1.0, 1.8)
        ]
        best = _best(axis, state.effects, trials)
        at = len(state.effects)
        effects = refined(axis, (*state.effects, best), at, ["bandwidth"], 2.5)
        effects = refined_frequency(axis, effects, at)
        effects = refined(axis, effects, at, ["bandwidth"], 1.5)
        found.append(effects[at])
    return found


def refined_frequency(axis: Axis, effects: Effects, at: int) -> Effects:
    """The middle of a resonance, searched within its width."""
    peak = effects[at]
    assert isinstance(peak, Narrowband)
    return refined(axis, effects, at, ["frequency"], 1.0 + 0.7 * peak.bandwidth / peak.frequency)


def peaks(seen: Sight, most: int = PEAKS) -> list[tuple[float, float]]:
    """(middle, width) in Hz of what stands out of the whitened spectrum, strongest first, each wider than a line."""
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
            gains[max(at - APART, 0) : at + APART + 1] = 0.0
        width *= 2
    chosen: list[tuple[float, float]] = []
    for gain, middle, wide in sorted(found, reverse=True):
        if gain < PRICE["narrowband"] / 2.0 or len(chosen) == most:
            break
        if all(abs(middle - other) > 2.0 * (wide + width_of) for other, width_of in chosen):
            chosen.append((middle, wide))
    return chosen


def oscillations(axis: Axis, state: Hypothesis, seen: Sight) -> list[Effect]:
    """Lines of the spectrum, their frequency at the top of the periodogram."""
    found: list[Effect] = []
    for gain, f_hz in line_peaks(seen.white, axis.rate_hz, PEAKS):
        if gain > PRICE["sinusoidal"] / 2.0:
            best = line_frequency(seen, f_hz)
            found.append(Sinusoidal(amplitude=_small(axis), frequency=best, phase=0.0))
    return found


def line_frequency(seen: Sight, f_hz: float) -> float:
    """The maximum of the periodogram near a frequency, by golden section."""
    t = np.arange(seen.axis.n) / seen.axis.rate_hz
    half = 0.5 * seen.axis.rate_hz / seen.axis.n

    def power(f: float) -> float:
        return float(abs(np.exp(-2j * np.pi * f * t) @ seen.white))

    lo, hi = f_hz - half, f_hz + half
    for _ in range(16):
        a, b = hi - 0.618 * (hi - lo), lo + 0.618 * (hi - lo)
        lo, hi = (lo, b) if power(a) > power(b) else (a, hi)
    return 0.5 * (lo + hi)


def low_pass(axis: Axis, state: Hypothesis, seen: Sight) -> list[Effect]:
    """The sensor's own bandwidth, unless the model has one."""
    if any(isinstance(effect, BandwidthLimit) for effect in state.effects):
        return []
    nyquist = 0.5 * axis.rate_hz
    cutoffs = nyquist * np.geomspace(0.04, 0.95, 11)
    found: list[Effect] = []
    for order in ORDERS:
        best = _best(axis, state.effects, [BandwidthLimit(cutoff=float(f), order=order) for f in cutoffs])
        at = len(state.effects)
        effects = refined(axis, (*state.effects, best), at, ["cutoff"], 1.4)
        if effects[at].cutoff < 0.99 * nyquist:  # type: ignore[attr-defined]
            found.append(effects[at])
    return [_best(axis, state.effects, found)] if found else []


def drifts(axis: Axis, state: Hypothesis, seen: Sight) -> list[Effect]:
    """What follows the clock: a slope, a transient, a step."""
    length_s = axis.n / axis.rate_hz
    have = {type(effect) for effect in state.effects}
    found: list[Effect] = []
    if RateRamp not in have:
        found.append(RateRamp(R=_small(axis)))
    if TurnOnTransient not in have:
        times_s = np.geomspace(0.003, SLOWEST, 9) * length_s
        trials: list[Effect] = [TurnOnTransient(amplitude=1.0, time_constant=float(t)) for t in times_s]
        best = _best(axis, state.effects, trials)
        at = len(state.effects)
        effects = refined(axis, (*state.effects, best), at, ["time_constant"], 1.6)
        if effects[at].time_constant <= SLOWEST * length_s:  # type: ignore[attr-defined]
            found.append(effects[at])
    if not have & {PoissonSteps, RandomTelegraph}:
        gains, times = step_gains(seen)
        found.append(BiasStep(time=float(times[int(np.argmax(gains))]), height=1.0))
    return found


def warmth(axis: Axis, state: Hypothesis, seen: Sight) -> list[Effect]:
    """What follows temperature: at once, with a curve, or late."""
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
        times_s = np.geomspace(PROMPT * length_s, SLOWEST * length_s, 9)
        trials: list[Effect] = [
            TemperatureLag(coefficient=1.0, reference=reference, time_constant=float(t)) for t in times_s
        ]
        best = _best(axis, state.effects, trials)
        at = len(state.effects)
        effects = refined(axis, (*state.effects, best), at, ["time_constant"], 2.2)
        if PROMPT * length_s < effects[at].time_constant <= SLOWEST * length_s:  # type: ignore[attr-defined]
            found.append(effects[at])
    return found


def leaks(axis: Axis, state: Hypothesis, seen: Sight) -> list[Effect]:
    """Other axes in this one."""
    have = {getattr(effect, "source", None) for effect in state.effects}
    found: list[Effect] = []
    for source in axis.others:
        if source not in have:
            same = (source in GYROS) == (axis.name in GYROS)
            leak = CrossAxis if same else GSensitivity
            found.append(leak(source=source, coefficient=1.0))
    return found


NOISE_FAMILIES: Final[tuple[Family, ...]] = (noises, correlated, ringing, oscillations, low_pass)
COURSE_FAMILIES: Final[tuple[Family, ...]] = (drifts, warmth, leaks)


def _best(axis: Axis, effects: Effects, trials: list[Effect]) -> Effect:
    """The most likely of several, all sizes free."""
    return max(trials, key=lambda one: axis.fit((*effects, one)).log_likelihood)


def _small(axis: Axis) -> float:
    """A size to start from: none, beside the samples' own deviation."""
    return 1e-3 * float(np.sqrt(np.mean(axis.coefficients**2)))
