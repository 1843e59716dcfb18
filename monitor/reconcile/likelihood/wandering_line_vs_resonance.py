"""Likelihood comparison of a wandering line, a resonance and an amplitude-modulated line with similar spectra.

The amplitude of a wandering line is constant. The amplitude of a resonance has a Rayleigh distribution, and its phase
wanders together with the amplitude. The amplitude of a modulated line varies, but its phase is constant. The resonance
and the modulated line are Gaussian processes, for which the Whittle likelihood is used.
"""

from dataclasses import dataclass
from math import log, pi, sqrt
from typing import Final

import numpy as np

from drivers.data_types import Floats
from monitor.common.distributions import Z95
from monitor.noise.effects import Narrowband, WanderingLine
from monitor.reconcile.likelihood.event_process_likelihood import (
    estimate_log_parameter_standard_deviations,
    log_interval,
    maximise_over_log_parameters,
)
from monitor.reconcile.likelihood.wandering_line_likelihood import (
    Complexes,
    WanderingLineParameters,
    compute_block_emission,
    draw_line,
    expand_band,
    extract_band,
    filter_blocks,
    filter_with_best_block_length,
    phase_log_likelihood,
    possible_block_lengths,
    track_phase,
)
from monitor.reconcile.result import ParameterInterval

BAND_HALF_WIDTHS: Final = 4.0
"""Half width of the band, in half widths of the resonance."""
BAND_DEVIATIONS: Final = 5.0
"""Half width of the band, in standard deviations of the frequency of a wandering line."""
MIN_BAND_CYCLES: Final = 256.0
"""Smallest half width of the band, in cycles per recording."""
MAX_COMPARED_SAMPLES: Final = 1 << 14
"""Largest number of complex samples in the comparison. The end of a longer recording is not used."""
START_TIMES: Final = 6
"""Number of correlation times that are tried as starting values."""
START_FACTORS: Final = (0.7, 1.2)
"""Starting values of the power and of the frequency deviation, relative to those of the resonance."""
START_WIDTHS: Final = (0.3, 1.0)
"""Starting values of the bandwidth, relative to that of the resonance."""
HALF_POWER_DEVIATIONS: Final = sqrt(8.0 * log(2.0))
"""Full width of a Gaussian line at half power, in standard deviations."""
MIN_POWER: Final = 1e-3
MIN_MODULATION_GAIN_NATS: Final = 3.0
"""Log-likelihood in nats by which a modulated line must exceed both other processes, so that neither of them is
named."""
MAX_SWEEP_RESIDUAL: Final = 1e-3
"""Largest variance of the phase around a parabola, relative to the variance around a straight line, at which the line
is a sweep. For a random frequency, the ratio is near 1."""
CARRIER_PADDING: Final = 4
"""Zero padding of the periodogram that determines the frequency of a modulated line."""


@dataclass(frozen=True, slots=True)
class WanderingLineComparison:
    """Comparison of a wandering line with a resonance and with an amplitude-modulated line."""

    line: WanderingLine
    gain: float  # log-likelihood of the wandering line less the log-likelihood of the resonance, nats
    modulation_gain: float  # log-likelihood of a modulated line less the log-likelihood of the resonance, nats
    sweep_residual: float  # relative variance of the phase that a linear change of the frequency leaves
    parameters: dict[str, ParameterInterval]  # of the wandering line, 95 %

    @property
    def is_modulated(self) -> bool:
        """True if a line with a constant phase and a varying amplitude is the most likely process."""
        return self.modulation_gain > max(self.gain, 0.0) + MIN_MODULATION_GAIN_NATS

    @property
    def is_sweep(self) -> bool:
        """True if the frequency changes linearly in time, and not at random."""
        return self.sweep_residual < MAX_SWEEP_RESIDUAL


def compare_wandering_line_with_resonance(
    series: Floats, rate_hz: float, resonance: Narrowband
) -> WanderingLineComparison | None:
    """Compare the likelihoods of a wandering line, a resonance and an amplitude-modulated line.

    Parameters
    ----------
    series : ndarray of float64, shape (n,)
        Series in the unit of the axis.
    rate_hz : float
        Sample rate, Hz.
    resonance : Narrowband
        Fitted resonance, which gives the starting values.

    Returns
    -------
    WanderingLineComparison or None
        The comparison, or None if the recording is too short.
    """
    half_hz = max(0.5 * BAND_HALF_WIDTHS * resonance.bandwidth, MIN_BAND_CYCLES * rate_hz / series.size)
    band = extract_band(series, rate_hz, resonance.frequency, half_hz)
    longest = 0 if band is None else max(possible_block_lengths(min(band.z.size, MAX_COMPARED_SAMPLES)), default=0)
    if band is None or not longest:
        return None
    z = band.z[: min(band.z.size, MAX_COMPARED_SAMPLES) // longest * longest]
    start_power = max(float(np.mean(np.abs(z) ** 2)) - 1.0, MIN_POWER)
    centre_hz = resonance.frequency - band.centre_hz
    as_resonance = _fit_resonance(z, band.rate_hz, start_power, resonance.bandwidth, centre_hz)
    as_modulated = _fit_modulated_line(z, band.rate_hz, start_power, resonance.bandwidth)
    as_line, fitted, deviations = _fit_line(z, band.rate_hz, start_power, resonance.bandwidth, centre_hz)
    line = WanderingLine(
        amplitude=band.to_amplitude(fitted.power),
        frequency=band.centre_hz + fitted.centre_hz,
        frequency_deviation=fitted.deviation_hz,
        correlation_time=fitted.time_s,
    )
    # the mean of Gauss–Markov noise over a time far above T has the variance 2 s² T/time
    error_hz = Z95 * fitted.deviation_hz * sqrt(min(2.0 * fitted.time_s * band.rate_hz / z.size, 1.0))
    amplitude = log_interval(fitted.power, float(deviations[0]))
    lo, hi = (None if end is None else band.to_amplitude(end) for end in (amplitude.lo, amplitude.hi))
    parameters = {
        "amplitude": ParameterInterval(line.amplitude, lo, hi),
        "frequency": ParameterInterval(line.frequency, line.frequency - error_hz, line.frequency + error_hz),
        "frequency_deviation": log_interval(fitted.deviation_hz, float(deviations[1])),
        "correlation_time": log_interval(fitted.time_s, float(deviations[2])),
    }
    drawn = draw_line(z, band.rate_hz, fitted, np.random.default_rng(0))
    return WanderingLineComparison(
        line, as_line - as_resonance, as_modulated - as_resonance, _sweep_residual(drawn), parameters
    )


def _sweep_residual(line: Complexes) -> float:
    """Return the variance of the phase around a parabola, relative to the variance around a straight line."""
    phase, t = np.unwrap(np.angle(line)), np.linspace(-1.0, 1.0, line.size)
    straight, parabola = (float(np.var(phase - np.polyval(np.polyfit(t, phase, k), t))) for k in (1, 2))
    return parabola / straight if straight > 0.0 else 1.0


def draw_wandering_line(series: Floats, rate_hz: float, line: WanderingLine, rng: np.random.Generator) -> Floats:
    """Draw a wandering line from its distribution given the series.

    If the parameters are true, only the other noise remains in the series less the drawn line.

    Parameters
    ----------
    series : ndarray of float64, shape (n,)
        Series in the unit of the axis.
    rate_hz : float
        Sample rate, Hz.
    line : WanderingLine
        Parameters of the line.
    rng : numpy.random.Generator
        Generator for the draw.

    Returns
    -------
    ndarray of float64, shape (n,)
        Drawn line.
    """
    half_hz = max(BAND_DEVIATIONS * line.frequency_deviation, MIN_BAND_CYCLES * rate_hz / series.size)
    band = extract_band(series, rate_hz, line.frequency, half_hz)
    if band is None:
        return np.zeros_like(series)
    power, centre_hz = line.amplitude**2 * band.power_per_square, line.frequency - band.centre_hz
    parameters = WanderingLineParameters(power, line.frequency_deviation, line.correlation_time, centre_hz)
    return expand_band(band, draw_line(band.z, band.rate_hz, parameters, rng), series.size)


def _fit_line(
    z: Complexes, rate_hz: float, power: float, width_hz: float, centre_hz: float
) -> tuple[float, WanderingLineParameters, Floats]:
    """Return the log-likelihood, the parameters and the standard deviations of the logarithms of the first three."""
    starts = [
        WanderingLineParameters(power * factor, _deviation(width_hz, float(time_s)) * other, float(time_s), centre_hz)
        for factor in START_FACTORS
        for time_s in np.geomspace(1.0 / rate_hz, 0.25 * z.size / rate_hz, START_TIMES)
        for other in START_FACTORS
    ]
    best = filter_with_best_block_length(z, rate_hz, starts)
    blocks = best.emission.blocks

    def log_likelihood_in_blocks(power: float, deviation_hz: float, time_s: float) -> float:
        parameters = WanderingLineParameters(power, deviation_hz, time_s, centre_hz)
        return filter_blocks(compute_block_emission(blocks, power), parameters).log_likelihood

    value, at = maximise_over_log_parameters(log_likelihood_in_blocks, best.parameters[:3])
    fitted = _line_parameters(at, centre_hz)
    # the blocks do not resolve the deviation of a narrow line, so the phase is tracked with each start too
    block_phase = track_phase(filter_blocks(compute_block_emission(blocks, fitted.power), fitted), z.size)
    candidates = dict.fromkeys([fitted, *(one._replace(power=fitted.power) for one in starts)])
    tracked, phase, with_tracked = max(
        ((*phase_log_likelihood(z, rate_hz, block_phase, one), one) for one in candidates), key=lambda one: one[0]
    )
    log_likelihood = log_likelihood_in_blocks
    if tracked > value:

        def log_likelihood_with_tracked_phase(power: float, deviation_hz: float, time_s: float) -> float:
            return phase_log_likelihood(
                z, rate_hz, phase, WanderingLineParameters(power, deviation_hz, time_s, centre_hz)
            )[0]

        log_likelihood = log_likelihood_with_tracked_phase
        value, at = maximise_over_log_parameters(log_likelihood, with_tracked[:3])
        fitted = _line_parameters(at, centre_hz)
    deviations = estimate_log_parameter_standard_deviations(lambda x: log_likelihood(*np.exp(x).tolist()), at, value)
    return value, fitted, deviations


def _deviation(width_hz: float, time_s: float) -> float:
    """Return the frequency deviation of a line with the given width at half power (see ``WanderingLine``)."""
    return max(width_hz / HALF_POWER_DEVIATIONS, sqrt(width_hz / (4.0 * pi * time_s)))


def _line_parameters(log_parameters: Floats, centre_hz: float) -> WanderingLineParameters:
    power, deviation_hz, time_s = np.exp(log_parameters).tolist()
    return WanderingLineParameters(power, deviation_hz, time_s, centre_hz)


def _fit_resonance(z: Complexes, rate_hz: float, power: float, width_hz: float, centre_hz: float) -> float:
    """Return the largest log-likelihood of a resonance."""
    periodogram = np.abs(np.fft.fft(z)) ** 2 / z.size
    f_hz = np.asarray(np.fft.fftfreq(z.size, 1.0 / rate_hz), np.float64)

    def resonance_log_likelihood(power: float, width: float, shift: float) -> float:
        centre = centre_hz + width_hz * log(shift)
        variance = 1.0 + power * rate_hz * _lorentzian(f_hz - centre, width)
        return float((periodogram - np.log(variance) - periodogram / variance).sum())

    return max(
        maximise_over_log_parameters(resonance_log_likelihood, (power, factor * width_hz, 1.0))[0]
        for factor in START_WIDTHS
    )


def _fit_modulated_line(z: Complexes, rate_hz: float, power: float, width_hz: float) -> float:
    """Return the largest log-likelihood of a line with a constant phase and an amplitude that varies.

    The square of such a line is a steady oscillation of twice the frequency. The number of independent frequencies
    is subtracted as a penalty.
    """
    squared = np.fft.fft(z**2, CARRIER_PADDING * z.size)
    twice_hz = float(np.fft.fftfreq(squared.size, 1.0 / rate_hz)[int(np.argmax(np.abs(squared)))])
    steady = z * np.exp(-1j * np.pi * twice_hz * np.arange(z.size) / rate_hz)
    best = -np.inf
    for halves in (0.0, 0.5):  # the square has the same frequency for lines that differ by half the sample rate
        turned = steady * np.exp(-2j * np.pi * halves * np.arange(z.size))
        turned = turned * np.exp(-0.5j * np.angle(np.sum(turned**2)))
        best = max(best, _fit_real_amplitude(turned.real, rate_hz, power, width_hz))
    return best - log(z.size)


def _fit_real_amplitude(amplitude: Floats, rate_hz: float, power: float, width_hz: float) -> float:
    """Return the largest log-likelihood of a constant plus Gauss–Markov noise. The background has the variance 1/2."""
    periodogram = 2.0 * np.abs(np.fft.fft(amplitude)) ** 2 / amplitude.size
    f_hz = np.asarray(np.fft.fftfreq(amplitude.size, 1.0 / rate_hz), np.float64)

    def modulated_line_log_likelihood(power: float, width: float) -> float:
        variance = 1.0 + 2.0 * power * rate_hz * _lorentzian(f_hz, width)
        variance[0] = max(periodogram[0], variance[0])
        return 0.5 * float((periodogram - np.log(variance) - periodogram / variance).sum())

    return max(
        maximise_over_log_parameters(modulated_line_log_likelihood, (power, factor * width_hz))[0]
        for factor in START_WIDTHS
    )


def _lorentzian(offset_hz: Floats, width_hz: float) -> Floats:
    """Return the Lorentzian with the full width ``width_hz`` at half power and the integral 1, in 1/Hz."""
    return np.asarray(width_hz / (2.0 * np.pi) / (offset_hz**2 + 0.25 * width_hz**2))
