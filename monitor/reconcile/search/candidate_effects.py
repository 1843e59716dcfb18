"""Candidate effects for one axis, with starting values from the data.

Each function proposes effects of one kind for a whitened axis. Shape parameters are fitted here, and the caller fits
the sizes. ``PENALTY_NATS`` contains the log-likelihood gain that an effect reaches by chance. Effects that can occur at
many frequencies or times have larger penalties.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import log
from typing import Final

import numpy as np

from monitor.noise.effect import GYROS, Effect
from monitor.noise.effects import (
    AngleRandomWalk,
    BandwidthLimit,
    BiasCurve,
    BiasInstability,
    BiasStep,
    CrossAxis,
    ExponentiallyCorrelated,
    GSensitivity,
    Narrowband,
    PoissonSteps,
    PowerLaw,
    PulseTrain,
    QuantizationNoise,
    RandomTelegraph,
    RateRamp,
    RateRandomWalk,
    Sinusoidal,
    TemperatureBias,
    TemperatureHysteresis,
    TemperatureLag,
    TurnOnTransient,
)
from monitor.reconcile.diagnostics.whiteness_tests import (
    compute_level_step_gains,
    find_peak_gains_and_frequencies,
)
from monitor.reconcile.effect_properties import PENALTY_NATS
from monitor.reconcile.likelihood.axis_fit import Axis, AxisFit, Effects
from monitor.reconcile.likelihood.effect_roles import linear_coefficient_names
from monitor.reconcile.likelihood.hypothesis_fit import find_maximum_by_golden_section, fit_shape_parameter
from monitor.reconcile.likelihood.whitening import WhitenedAxis

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
REVERSAL_FRACTIONS: Final = (0.02, 0.04, 0.08, 0.15, 0.25, 0.4, 0.6)
"""Values of the hysteresis parameter ``reversal`` in the first search, as fractions of the temperature range."""
MIN_AGEING_FRACTION: Final = 0.003
"""Shortest time constant of a logarithmic drift, as a fraction of the recording length."""
MIN_REFINED_SHARE: Final = 0.15
"""Smallest gain, relative to the penalty, for which a parameter of shape is refined. Trials need twice this gain."""
MAX_PEAKS: Final = 2
POWER_LAW_EXPONENTS: Final = (0.4, 0.7, 1.0, 1.4, 1.8, 2.3, 2.8)
FILTERS: Final = (
    *(("butterworth", order) for order in (1, 2, 3, 4)),
    *(("iir", order) for order in (1, 2)),
    *(("fir", order) for order in (1, 2)),
)
"""Kind and order of each filter that is tried."""
HIGHEST_FREQUENCIES: Final = (0.42, 0.5)
"""Frequency range in which quantization noise is strongest, as fractions of the sample rate."""
MIDDLE_FREQUENCIES: Final = (0.2, 0.3)
"""Frequency range in the middle of the spectrum, as fractions of the sample rate."""
FLOOR_PENALTY_NATS: Final = 2.0
"""Smallest log-likelihood gain, in nats, of white noise added after a filter."""
LINE_BLOCKS: Final = 4096
"""Approximate number of blocks over which the series is summed to refine the frequency of a line."""
LINE_SEARCH_ITERATIONS: Final = 16

CandidateFunction = Callable[[WhitenedAxis], list[Effect]]
"""Function that proposes effects of one kind."""


def propose_allan_terms(whitened: WhitenedAxis) -> list[Effect]:
    """Propose the noise terms Q, N, B and K that the current hypothesis lacks.

    Quantization noise is not proposed beside a low-pass filter if the spectrum falls. Q would only correct the shape of
    the filter.
    """
    small = initial_effect_size(whitened.axis)
    every = (QuantizationNoise(Q=small), AngleRandomWalk(N=small), BiasInstability(B=small), RateRandomWalk(K=small))
    known = whitened.effect_types
    if BandwidthLimit in known and not _spectrum_rises(whitened.fit):
        known = known | {QuantizationNoise}
    return [effect for effect in every if type(effect) not in known]


def _spectrum_rises(fit: AxisFit) -> bool:
    """Return True if the noise density at the highest frequencies exceeds the density in the middle of the spectrum."""
    bins, power = fit.axis.bins, fit.whittle.residual
    high, middle = (
        float(power[inside].sum() / max(float(bins.count[inside].sum()), 1.0))
        for lo, hi in (HIGHEST_FREQUENCIES, MIDDLE_FREQUENCIES)
        for inside in [(bins.f_hz > lo * bins.rate_hz) & (bins.f_hz < hi * bins.rate_hz)]
    )
    return high > middle


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


def propose_power_law(whitened: WhitenedAxis) -> list[Effect]:
    """Propose power-law noise, if the current hypothesis contains none."""
    if PowerLaw in whitened.effect_types:
        return []
    axis, small = whitened.axis, initial_effect_size(whitened.axis)
    trials = [PowerLaw(density=small, exponent=one) for one in POWER_LAW_EXPONENTS]
    best = _most_likely(axis, whitened.effects, trials)
    return [fit_shape_parameter(axis, whitened.effects, best, "exponent", 1.6)]


def propose_resonances(whitened: WhitenedAxis) -> list[Effect]:
    """Propose resonances at the peaks of the whitened spectrum."""
    axis, found = whitened.axis, list[Effect]()
    for middle, width in find_broad_spectral_peaks(whitened):
        trials = [
            Narrowband(sigma=initial_effect_size(axis), frequency=middle, bandwidth=float(width * factor))
            for factor in (0.3, 0.6, 1.0, 1.8)
        ]
        found.append(fit_resonance(axis, whitened.effects, _most_likely(axis, whitened.effects, trials)))
    return found


def fit_resonance(axis: Axis, other_effects: Effects, first: Effect) -> Effect:
    """Fit the frequency and the bandwidth of a resonance.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    other_effects : tuple of Effect
        Other effects of the axis.
    first : Effect
        Resonance with the starting values.
    """
    peak = fit_shape_parameter(axis, other_effects, first, "bandwidth", 2.5)
    assert isinstance(peak, Narrowband)
    peak = fit_shape_parameter(axis, other_effects, peak, "frequency", 1.0 + 0.7 * peak.bandwidth / peak.frequency)
    return fit_shape_parameter(axis, other_effects, peak, "bandwidth", 1.5)


def find_broad_spectral_peaks(whitened: WhitenedAxis, max_peaks: int = MAX_PEAKS) -> list[tuple[float, float]]:
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
        step = max(1, width // 4)
        power = running[2 * width : n - 1 : step] - running[width : n - 1 - width : step]
        for _ in range(max_peaks):
            at = int(np.argmax(power))
            ratio = max(float(power[at]) / width, 1.0)
            middle = (width + at * step + 0.5 * width) * step_hz
            found.append((0.5 * width * (ratio - 1.0 - log(ratio)), middle, width * step_hz))
            power[max(at - PEAK_SEPARATION_STEPS, 0) : at + PEAK_SEPARATION_STEPS + 1] = 0.0
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
        for gain, f_hz in find_peak_gains_and_frequencies(whitened.periodogram, whitened.axis.rate_hz, MAX_PEAKS)
        if gain > PENALTY_NATS["sinusoidal"] / 2.0
    ]


def _line_frequency(whitened: WhitenedAxis, f_hz: float) -> float:
    """Return the frequency, near ``f_hz``, with the largest value of the periodogram.

    The series is multiplied by a phasor of frequency ``f_hz`` and summed over blocks. Within the search range, the
    phase of a line relative to the phasor changes by less than π/4096 in a block.
    """
    n, rate_hz = whitened.axis.n, whitened.axis.rate_hz
    length = max(1, n // LINE_BLOCKS)
    blocks = np.pad(whitened.series, (0, -n % length)).reshape(-1, length)
    phasors = np.exp(-2j * np.pi * f_hz / rate_hz * np.arange(length))
    sums = np.einsum("kl,l->k", blocks, phasors.real) + 1j * np.einsum("kl,l->k", blocks, phasors.imag)
    start_s = np.arange(sums.size) * length / rate_hz
    half = 0.5 * rate_hz / n

    def amplitude(f: float) -> float:
        return float(abs((np.exp(-2j * np.pi * f * start_s) * sums).sum()))

    return find_maximum_by_golden_section(amplitude, f_hz - half, f_hz + half, LINE_SEARCH_ITERATIONS)


def propose_pulse_trains(whitened: WhitenedAxis) -> list[Effect]:
    """Propose periodic pulses, unless a shape other than a rectangle fits clearly better."""
    if PulseTrain in whitened.effect_types or whitened.harmonic_series.gain < PENALTY_NATS["pulse_train"] / 4.0:
        return []
    found = whitened.pulses
    if found is None or not found.is_rectangular or found.gain < PENALTY_NATS["pulse_train"] / 2.0:
        return []
    return [PulseTrain(height=1.0, period=found.period_s, width=found.width_s, delay=found.delay_s)]


def propose_low_pass(whitened: WhitenedAxis) -> list[Effect]:
    """Propose a low-pass filter, if the current hypothesis contains none."""
    if BandwidthLimit in whitened.effect_types:
        return []
    found = fit_low_pass(whitened.axis, whitened.effects)
    return [] if found is None else [found]


def fit_low_pass(axis: Axis, other_effects: Effects) -> BandwidthLimit | None:
    """Fit a low-pass filter of each kind and order, and return the most likely filter.

    Parameters
    ----------
    axis : Axis
        Axis to fit.
    other_effects : tuple of Effect
        Other effects of the axis.

    Returns
    -------
    BandwidthLimit or None
        Filter with the fitted cutoff. None if the cutoff is half the sample rate, or if no filter gains enough in the
        first search.
    """
    nyquist = 0.5 * axis.rate_hz
    unfiltered = axis.fit(other_effects).log_likelihood
    cutoffs = nyquist * np.geomspace(0.04, 0.95, 11)
    found: dict[BandwidthLimit, float] = {}
    for kind, order in FILTERS:
        floor = initial_effect_size(axis) / axis.rate_hz**0.5
        trials = [BandwidthLimit(cutoff=float(f), order=order, floor=floor, kind=kind) for f in cutoffs]
        best = _most_likely(axis, other_effects, trials)
        gain = axis.candidate_log_likelihood((*other_effects, best)) - unfiltered
        if gain < MIN_REFINED_SHARE * PENALTY_NATS[best.name]:
            continue
        refined = fit_shape_parameter(axis, other_effects, best, "cutoff", 1.4)
        assert isinstance(refined, BandwidthLimit)
        for one, penalty in ((refined, FLOOR_PENALTY_NATS), (replace(refined, floor=None), 0.0)):
            if one.cutoff < 0.99 * nyquist:
                found[one] = axis.candidate_log_likelihood((*other_effects, one)) - penalty
    return max(found, key=lambda one: found[one]) if found else None


def propose_drifts_and_steps(whitened: WhitenedAxis) -> list[Effect]:
    """Propose a ramp, a transient at the start, a curved drift, and a step of the bias."""
    found: list[Effect] = []
    if RateRamp not in whitened.effect_types:
        found.append(RateRamp(R=initial_effect_size(whitened.axis)))
    if TurnOnTransient not in whitened.effect_types:
        times_s = np.geomspace(0.003, MAX_TIME_CONSTANT_FRACTION, 9) * whitened.axis.length_s
        trials = [TurnOnTransient(amplitude=1.0, time_constant=float(t)) for t in times_s]
        found += _best_time_constant(whitened, trials, 1.6, 0.0)
    if BiasCurve not in whitened.effect_types:
        found.append(BiasCurve(slope=1.0, curvature=1.0))
        times_s = np.geomspace(MIN_AGEING_FRACTION, MAX_TIME_CONSTANT_FRACTION, 9) * whitened.axis.length_s
        curves = [BiasCurve(slope=1.0, logarithmic=1.0, time_constant=float(t)) for t in times_s]
        found += _best_time_constant(whitened, curves, 1.8, MIN_AGEING_FRACTION * whitened.axis.length_s)
    if not whitened.effect_types & {PoissonSteps, RandomTelegraph}:
        gains, times_s, _ = compute_level_step_gains(whitened)
        found.append(BiasStep(time=float(times_s[int(np.argmax(gains))]), height=1.0))
    return found


def propose_temperature_effects(whitened: WhitenedAxis) -> list[Effect]:
    """Propose polynomials of the temperature, and delayed temperature effects.

    If the hypothesis contains a polynomial, only polynomials of a higher order are proposed.
    """
    temperature_c = whitened.axis.temperature_c
    if temperature_c is None or np.ptp(temperature_c) == 0.0:
        return []
    known = [effect for effect in whitened.effects if isinstance(effect, TemperatureBias)]
    reference = known[0].reference if known else float(round(temperature_c.mean(), 2))
    polynomials = (
        TemperatureBias(coefficient=1.0, reference=reference),
        TemperatureBias(coefficient=1.0, reference=reference, quadratic=1.0),
        TemperatureBias(coefficient=1.0, reference=reference, quadratic=1.0, cubic=1.0),
    )
    order = max((len(linear_coefficient_names(effect)) for effect in known), default=0)
    found: list[Effect] = list(polynomials[order:])
    if TemperatureLag not in whitened.effect_types:
        shortest_s = MIN_DELAY_FRACTION * whitened.axis.length_s
        times_s = np.geomspace(shortest_s, MAX_TIME_CONSTANT_FRACTION * whitened.axis.length_s, 9)
        lags = [TemperatureLag(coefficient=1.0, reference=reference, time_constant=float(t)) for t in times_s]
        found += _best_time_constant(whitened, lags, 2.2, shortest_s)
    if TemperatureHysteresis not in whitened.effect_types:
        reversals_c = np.array(REVERSAL_FRACTIONS) * np.ptp(temperature_c)
        loops = [TemperatureHysteresis(height=1.0, reversal=float(one)) for one in reversals_c]
        best = _most_likely(whitened.axis, whitened.effects, loops)
        refined = fit_shape_parameter(whitened.axis, whitened.effects, best, "reversal", 1.6)
        assert isinstance(refined, TemperatureHysteresis)
        found += [refined] if reversals_c[0] <= refined.reversal <= reversals_c[-1] else []
    return found


def _best_time_constant(
    whitened: WhitenedAxis, trials: Sequence[Effect], search_factor: float, shortest_s: float
) -> list[Effect]:
    """Return the most likely effect, or an empty list if the fitted time constant is out of range.

    If the first search finds only a small gain, the function returns an empty list and does not refine the time
    constant. Between adjacent time constants T and 1.84 T, the correlation of an exponential with the nearer
    exponential is at least 2 √1.36/(1 + 1.36) = 0.988. The first search therefore finds nearly the largest gain.
    """
    best = _most_likely(whitened.axis, whitened.effects, trials)
    gain = whitened.axis.candidate_log_likelihood((*whitened.effects, best))
    if gain - whitened.axis.fit(whitened.effects).log_likelihood < MIN_REFINED_SHARE * PENALTY_NATS[best.name]:
        return []
    refined = fit_shape_parameter(whitened.axis, whitened.effects, best, "time_constant", search_factor)
    assert isinstance(refined, (TurnOnTransient, TemperatureLag, BiasCurve))
    assert refined.time_constant is not None
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
    propose_pulse_trains,
    propose_power_law,
)
"""Functions that propose noise effects and filters."""
DETERMINISTIC_CANDIDATES: Final[tuple[CandidateFunction, ...]] = (
    propose_drifts_and_steps,
    propose_temperature_effects,
    propose_leaks_from_other_axes,
)
"""Functions that propose effects that depend on time, temperature or another axis."""


def _most_likely(axis: Axis, effects: Effects, trials: Sequence[Effect]) -> Effect:
    return max(trials, key=lambda one: axis.candidate_log_likelihood((*effects, one)))


def initial_effect_size(axis: Axis) -> float:
    """Return a small starting value for the size of an effect, relative to the noise of the axis."""
    return 1e-3 * axis.cosine_transform_rms
