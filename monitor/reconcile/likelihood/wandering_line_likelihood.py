"""Likelihood of a wandering line in a frequency band, and random draws of the line given the data.

The band is shifted to zero frequency and becomes a complex series z. The units are chosen so that the background noise
has the variance 1. All log-likelihoods are relative to the background noise alone. Two approximations are computed, and
the larger likelihood is used.

- **Blocks**: The frequency is constant in short blocks and follows a hidden Markov model. The phase of each block is
  unknown (Streit & Barrett, "Frequency line tracking using hidden Markov models", IEEE Trans. ASSP 38 (1990) 586).
  This approximation is suitable for weak lines.
- **Phase**: An iterated Kalman smoother tracks frequency and phase. The likelihood is the Laplace approximation at the
  smoothed phase (Bell, "The iterated Kalman smoother as a Gauss-Newton method", SIAM J. Optim. 4 (1994) 626). This
  approximation is suitable for strong lines.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import log, pi, sqrt, tanh
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import i0e

from drivers.data_types import Floats, Ints
from monitor.common.compiled import compiled

Complexes = NDArray[np.complex128]

BLOCK_LENGTHS: Final = (4, 8, 16, 32, 64, 128)
"""Possible lengths of a block, in samples of z."""
MIN_BLOCKS: Final = 16
PHASE_ITERATIONS: Final = 6
INITIAL_PHASE_VARIANCE: Final = 100.0
"""Prior variance of the first phase, rad²."""
MIN_CURVATURE: Final = 1e-12
"""Smallest curvature of the log-likelihood of one sample with respect to the phase, to avoid a division by zero."""
MIN_PROBABILITY: Final = 1e-300
BESSEL_GRID: Final = np.linspace(0.0, 1.0, 4097)[:-1]
SCALED_BESSEL: Final = np.append(
    i0e(BESSEL_GRID / (1.0 - BESSEL_GRID)) / np.sqrt(1.0 - BESSEL_GRID), 1.0 / sqrt(2.0 * pi)
)
"""Table of I₀(x) exp(−x) √(1 + x) at equally spaced values of x/(1 + x) from 0 to 1."""
MIN_TANH_ARGUMENT: Final = 0.01
"""Smallest ratio x of sample interval and correlation time for which 2x − 4 tanh(x/2) is computed without a series."""


class WanderingLineParameters(NamedTuple):
    """Parameters of a wandering line in a band."""

    power: float  # squared amplitude in z
    deviation_hz: float  # standard deviation of the frequency
    time_s: float  # correlation time of the frequency
    centre_hz: float  # mean frequency in z


@dataclass(frozen=True, slots=True, eq=False)
class FrequencyBand:
    """Frequency band of a real series, shifted to zero frequency."""

    z: Complexes  # [m] complex series; the background noise has the variance 1
    rate_hz: float  # sample rate of z
    centre_hz: float  # frequency in the real series that is zero in z
    first: int  # index of the first frequency of the band in the Fourier transform of the real series
    unit: float  # root mean square of the noise in the Fourier transform of the real series
    power_per_square: float  # power in z of a line of amplitude 1 in the real series

    def to_amplitude(self, power: float) -> float:
        """Convert the power of a line in z to the amplitude in the real series."""
        return sqrt(power / self.power_per_square)


def extract_band(series: Floats, rate_hz: float, centre_hz: float, half_width_hz: float) -> FrequencyBand | None:
    """Extract a frequency band of a real series, or return None if there is no noise next to the band.

    The density of the background noise is the median of the periodogram next to the band, divided by ln 2.

    Parameters
    ----------
    series : ndarray of float64, shape (n,)
        Series in the unit of the axis.
    rate_hz : float
        Sample rate of the series, Hz.
    centre_hz, half_width_hz : float
        Centre and half width of the band, Hz.
    """
    n = series.size
    transform = np.fft.rfft(series)
    lowest, low, high, highest = (
        min(max(round((centre_hz + factor * half_width_hz) * n / rate_hz), 1), transform.size - 1)
        for factor in (-2.0, -1.0, 1.0, 2.0)
    )
    beside, m = np.concatenate([transform[lowest:low], transform[high:highest]]), high - low
    power = float(np.median(np.abs(beside) ** 2)) / log(2.0) if beside.size and m else 0.0
    if not power > 0.0:
        return None
    z = np.asarray(np.fft.ifft(np.fft.ifftshift(transform[low:high])) * sqrt(m / power))
    resolution_hz = rate_hz / n
    return FrequencyBand(
        z, m * resolution_hz, (low + m // 2) * resolution_hz, low, sqrt(power), n**2 / (4.0 * power * m)
    )


def expand_band(band: FrequencyBand, z: Complexes, n: int) -> Floats:
    """Convert a complex series in a band to the real series of length n."""
    transform = np.zeros(n // 2 + 1, np.complex128)
    transform[band.first : band.first + z.size] = np.fft.fftshift(np.fft.fft(z)) * band.unit / sqrt(z.size)
    return np.asarray(np.fft.irfft(transform, n))


class BlockSpectra(NamedTuple):
    """Fourier transforms of the blocks of a series in a band."""

    length: int  # samples in a block
    rate_hz: float  # sample rate of the series
    offsets_hz: Floats  # [k] frequencies
    transforms: Complexes  # [b, k] Fourier transform of each block
    magnitudes: Floats  # [b, k] magnitude of the Fourier transform


def transform_blocks(z: Complexes, rate_hz: float, length: int) -> BlockSpectra:
    """Divide a series into blocks and transform each block.

    Parameters
    ----------
    z : ndarray of complex128, shape (m,)
        Series in a band. Samples after the last complete block are not used.
    rate_hz : float
        Sample rate of z, Hz.
    length : int
        Length of a block in samples.
    """
    transforms = np.fft.fft(z[: z.size // length * length].reshape(-1, length), 2 * length, axis=1)
    offsets_hz = np.asarray(np.fft.fftfreq(2 * length, 1.0 / rate_hz), np.float64)
    return BlockSpectra(length, rate_hz, offsets_hz, transforms, np.abs(transforms))


class BlockEmission(NamedTuple):
    """Likelihood of each block of a series, as a function of the frequency of the line in this block."""

    blocks: BlockSpectra
    relative: Floats  # [b, k] likelihood relative to the most likely frequency
    log_scale: float  # sum of the log-likelihoods of the most likely frequencies


def compute_block_emission(blocks: BlockSpectra, power: float) -> BlockEmission:
    """Compute the likelihood of each block for a line of the given power.

    The average over the unknown phase is I₀(2A|Z|) exp(−A² length) with the amplitude A and the Fourier transform Z.
    """
    argument = 2.0 * sqrt(power) * blocks.magnitudes
    largest = argument.max(axis=1, keepdims=True)
    scaled = i0e(largest)
    relative = np.exp(argument - largest) * _interpolate_scaled_bessel(argument, SCALED_BESSEL) / scaled
    return BlockEmission(blocks, relative, float((np.log(scaled) + largest - blocks.length * power).sum()))


def possible_block_lengths(size: int) -> list[int]:
    """Return the block lengths that divide a series of ``size`` samples into enough blocks."""
    return [length for length in BLOCK_LENGTHS if size >= MIN_BLOCKS * length]


def phase_log_likelihood(
    z: Complexes, rate_hz: float, phase: Floats, parameters: WanderingLineParameters
) -> tuple[float, Floats]:
    """Return the log-likelihood of a wandering line with a tracked phase, and the smoothed phase.

    Parameters
    ----------
    z : ndarray of complex128, shape (m,)
        Series in a band.
    rate_hz : float
        Sample rate of z, Hz.
    phase : ndarray of float64, shape (m,)
        Starting value of the phase, rad.
    parameters : WanderingLineParameters
        Parameters of the line.
    """
    return _smooth_phase(z, phase, _phase_model(rate_hz, parameters), np.zeros((z.size, 2)), PHASE_ITERATIONS)


def track_phase(filtered: "FilteredBlocks", size: int) -> Floats:
    """Return the phase of a wandering line, shape (size,), from the most likely frequency and phase of each block."""
    blocks = filtered.emission.blocks
    rate_hz, length = blocks.rate_hz, blocks.length
    at = _smoothed_states(filtered.forward, filtered.transition, filtered.emission.relative)
    k = np.arange(at.size)
    offset_hz = blocks.offsets_hz[at]
    centre_s = (k * length + 0.5 * (length - 1)) / rate_hz
    theta = np.angle(blocks.transforms[k, at]) + pi * offset_hz * (length - 1) / rate_hz
    advance = pi * (offset_hz[1:] + offset_hz[:-1]) * np.diff(centre_s)
    steps = advance + (np.diff(theta) - advance + pi) % (2.0 * pi) - pi
    unwrapped = theta[0] + np.concatenate([[0.0], np.cumsum(steps)])
    t_s = np.arange(size) / rate_hz
    inside = np.interp(t_s, centre_s, unwrapped)
    before, after = np.minimum(t_s - centre_s[0], 0.0), np.maximum(t_s - centre_s[-1], 0.0)
    return np.asarray(inside + 2.0 * pi * (offset_hz[0] * before + offset_hz[-1] * after))


def draw_line(z: Complexes, rate_hz: float, parameters: WanderingLineParameters, rng: np.random.Generator) -> Complexes:
    """Draw a wandering line from its distribution given the data.

    If the model is true, the series less the drawn line is white noise of variance 1.

    Parameters
    ----------
    z : ndarray of complex128, shape (m,)
        Series in a band.
    rate_hz : float
        Sample rate of z, Hz.
    parameters : WanderingLineParameters
        Parameters of the line.
    rng : numpy.random.Generator
        Generator for the draw.

    Returns
    -------
    ndarray of complex128, shape (m,)
        Drawn line. The line is zero if z is too short.
    """
    if not possible_block_lengths(z.size) or not parameters.power > 0.0:
        return np.zeros_like(z)
    filtered = filter_with_best_block_length(z, rate_hz, [parameters])
    tracked, phase = phase_log_likelihood(z, rate_hz, track_phase(filtered, z.size), parameters)
    if tracked > filtered.log_likelihood:
        draws = rng.standard_normal((z.size, 2))
        _, phase = _smooth_phase(z, phase, _phase_model(rate_hz, parameters), draws, 1)
        return np.asarray(sqrt(parameters.power) * np.exp(1j * phase))
    length = filtered.emission.blocks.length
    padded = np.concatenate([z, np.zeros(-z.size % length)])
    filtered = filter_blocks(
        compute_block_emission(transform_blocks(padded, rate_hz, length), parameters.power), parameters
    )
    blocks = filtered.emission.blocks
    at = _draw_states(filtered.forward, filtered.transition, np.asarray(rng.random(filtered.forward.shape[0])))
    found = blocks.transforms[np.arange(at.size), at]
    theta = rng.vonmises(np.angle(found), 2.0 * sqrt(parameters.power) * np.abs(found))
    turns = blocks.offsets_hz[at][:, None] * np.arange(length) / rate_hz
    line = sqrt(parameters.power) * np.exp(1j * (theta[:, None] + 2.0 * pi * turns))
    return np.asarray(line.ravel()[: z.size])


class FilteredBlocks(NamedTuple):
    """Hidden Markov model of the frequency in blocks of z."""

    log_likelihood: float
    parameters: WanderingLineParameters
    emission: BlockEmission
    transition: Floats  # [k, k] probability of each change of the frequency
    forward: Floats  # [b, k] probability of the frequency given this block and all earlier blocks


def filter_with_best_block_length(
    z: Complexes, rate_hz: float, trials: Sequence[WanderingLineParameters]
) -> FilteredBlocks:
    """Run the forward algorithm with the most likely parameters and block length.

    The likelihood increases with the length of a block until the frequency changes within a block. Longer blocks are
    therefore not tried after the likelihood has decreased.

    Parameters
    ----------
    z : ndarray of complex128, shape (m,)
        Series in a band, long enough for the shortest block length.
    rate_hz : float
        Sample rate of z, Hz.
    trials : sequence of WanderingLineParameters
        Possible parameters of the line.
    """
    best: FilteredBlocks | None = None
    for length in possible_block_lengths(z.size):
        blocks = transform_blocks(z, rate_hz, length)
        emissions = {power: compute_block_emission(blocks, power) for power in {one.power for one in trials}}
        found = max((filter_blocks(emissions[one.power], one) for one in trials), key=lambda one: one.log_likelihood)
        if best is not None and found.log_likelihood < best.log_likelihood:
            break
        best = found
    assert best is not None
    return best


def filter_blocks(emission: BlockEmission, parameters: WanderingLineParameters) -> FilteredBlocks:
    """Run the forward algorithm for a wandering line whose frequency is constant in each block.

    Parameters
    ----------
    emission : BlockEmission
        Likelihood of each block for the power of the line.
    parameters : WanderingLineParameters
        Parameters of the line.
    """
    blocks, offsets_hz = emission.blocks, emission.blocks.offsets_hz
    decay = float(np.exp(-blocks.length / blocks.rate_hz / parameters.time_s))
    from_centre = offsets_hz - parameters.centre_hz
    rounding = (offsets_hz[1] - offsets_hz[0]) ** 2 / 6.0  # of two frequencies to the grid
    variance = parameters.deviation_hz**2
    transition = _normalised(from_centre - decay * from_centre[:, None], variance * (1.0 - decay**2) + rounding)
    first = _normalised(from_centre[None, :], variance + rounding)[0]
    value, forward = _forward(emission.relative, transition, first)
    return FilteredBlocks(value + emission.log_scale, parameters, emission, transition, forward)


@compiled
def _interpolate_scaled_bessel(x: Floats, table: Floats) -> Floats:
    """Return I₀(x) exp(−x), shape (b, k), by cubic interpolation in ``SCALED_BESSEL`` with an error below 10⁻¹²."""
    found = np.empty_like(x)
    for b in range(x.shape[0]):
        for k in range(x.shape[1]):
            place = x[b, k] / (1.0 + x[b, k]) * (table.size - 1)
            at = min(max(int(place), 1), table.size - 3)
            t = place - at
            low, high = t * (t - 1.0) / 6.0, (t + 1.0) * (t - 2.0) / 2.0
            value = low * ((t + 1.0) * table[at + 2] - (t - 2.0) * table[at - 1])
            value += high * ((t - 1.0) * table[at] - t * table[at + 1])
            found[b, k] = value / np.sqrt(1.0 + x[b, k])
    return found


def _normalised(distance_hz: Floats, variance: float) -> Floats:
    """Return Gaussian probabilities whose sum over the last index is 1."""
    weight = np.exp(-0.5 * distance_hz**2 / variance) + MIN_PROBABILITY
    return np.asarray(weight / weight.sum(axis=-1, keepdims=True))


@compiled
def _forward(emission: Floats, transition: Floats, first: Floats) -> tuple[float, Floats]:
    forward = np.empty_like(emission)
    predicted, total = first.copy(), 0.0
    for b in range(emission.shape[0]):
        here = predicted * emission[b] + MIN_PROBABILITY
        density = here.sum()
        total += np.log(density)
        forward[b] = here / density
        predicted = forward[b] @ transition
    return total, forward


@compiled
def _smoothed_states(forward: Floats, transition: Floats, emission: Floats) -> Ints:
    """Return the most likely frequency of each block, given the data of all blocks."""
    states = np.empty(forward.shape[0], np.int64)
    backward = np.ones(forward.shape[1])
    for b in range(forward.shape[0] - 1, -1, -1):
        states[b] = np.argmax(forward[b] * backward)
        backward = transition @ (emission[b] * backward)
        backward /= backward.max()
    return states


@compiled
def _draw_states(forward: Floats, transition: Floats, chances: Floats) -> Ints:
    """Draw the frequencies of all blocks from their joint distribution given the data."""
    states = np.empty(forward.shape[0], np.int64)
    for b in range(forward.shape[0] - 1, -1, -1):
        weight = forward[b].copy()
        if b < forward.shape[0] - 1:
            weight *= transition[:, states[b + 1]]
        running = np.cumsum(weight)
        states[b] = min(np.searchsorted(running, chances[b] * running[-1]), weight.size - 1)
    return states


class _PhaseModel(NamedTuple):
    """Linear model of the phase and of the frequency offset between two samples of z."""

    amplitude: float
    drift: float  # phase advance of the centre frequency, rad
    gain: float  # phase advance per frequency offset, rad/Hz
    decay: float  # of the frequency offset
    variances: tuple[float, float, float]  # of the phase, of both, and of the frequency offset: process noise
    prior: float  # variance of the first frequency offset, Hz²


def _phase_model(rate_hz: float, parameters: WanderingLineParameters) -> _PhaseModel:
    """Return the exact model of sampled frequency and phase (see ``WanderingLine``)."""
    x = 1.0 / (rate_hz * parameters.time_s)
    decay, half = float(np.exp(-x)), 2.0 * pi * parameters.time_s * tanh(0.5 * x)
    driven = parameters.deviation_hz**2 * -float(np.expm1(-2.0 * x))
    scatter = x**3 / 6.0 if x < MIN_TANH_ARGUMENT else 2.0 * x - 4.0 * tanh(0.5 * x)
    own = (2.0 * pi * parameters.deviation_hz * parameters.time_s) ** 2 * scatter
    variances = (half**2 * driven + own, half * driven, driven)
    drift = 2.0 * pi * parameters.centre_hz / rate_hz
    return _PhaseModel(
        sqrt(parameters.power), drift, half * (1.0 + decay), decay, variances, parameters.deviation_hz**2
    )


@compiled
def _smooth_phase(
    z: Complexes, phase: Floats, model: _PhaseModel, draws: Floats, iterations: int
) -> tuple[float, Floats]:
    """Return the log-likelihood and the smoothed phase, or a random draw of the phase if ``draws`` is not zero."""
    n = z.size
    amplitude, gain, decay = model.amplitude, model.gain, model.decay
    q_phase, q_both, q_offset = model.variances
    mean, cov = np.empty((n, 2)), np.empty((n, 3))
    total = 0.0
    found = phase.copy()
    for _ in range(iterations):
        total = 0.0
        at, offset = found[0], 0.0
        p, r, q = INITIAL_PHASE_VARIANCE, 0.0, model.prior  # variances of the phase, of both, and of the offset
        for k in range(n):
            if k > 0:
                at, offset = at + model.drift + gain * offset, decay * offset
                p, r, q = (
                    p + 2.0 * gain * r + gain * gain * q + q_phase,
                    decay * (r + gain * q) + q_both,
                    decay * decay * q + q_offset,
                )
            # second-order expansion of 2A Re(z exp(−iφ)) − A² about the previous phase, in steps of at most 1 rad
            turned = z[k] * np.exp(-1j * found[k])
            slope = 2.0 * amplitude * turned.imag
            noise = 1.0 / max(2.0 * amplitude * turned.real, abs(slope), MIN_CURVATURE)
            innovation = found[k] + slope * noise - at
            total += 0.5 * np.log(noise / (p + noise)) - 0.5 * innovation**2 / (p + noise)
            total += 2.0 * amplitude * turned.real - amplitude**2 + 0.5 * slope**2 * noise
            share, other = p / (p + noise), r / (p + noise)
            at, offset = at + share * innovation, offset + other * innovation
            p, r, q = p * (1.0 - share), r * (1.0 - share), q - other * r
            mean[k, 0], mean[k, 1], cov[k, 0], cov[k, 1], cov[k, 2] = at, offset, p, r, q
        at, offset = 0.0, 0.0
        for k in range(n - 1, -1, -1):
            a, b, p, r, q = mean[k, 0], mean[k, 1], cov[k, 0], cov[k, 1], cov[k, 2]
            if k < n - 1:
                # covariance of this state with the next state, and variance of the next state
                c00, c01, c10, c11 = p + gain * r, decay * r, r + gain * q, decay * q
                v00 = p + 2.0 * gain * r + gain * gain * q + q_phase
                v01, v11 = decay * (r + gain * q) + q_both, decay * decay * q + q_offset
                det = v00 * v11 - v01 * v01
                g00, g01 = (c00 * v11 - c01 * v01) / det, (c01 * v00 - c00 * v01) / det
                g10, g11 = (c10 * v11 - c11 * v01) / det, (c11 * v00 - c10 * v01) / det
                d0, d1 = at - (a + model.drift + gain * b), offset - decay * b
                a, b = a + g00 * d0 + g01 * d1, b + g10 * d0 + g11 * d1
                p, r, q = p - g00 * c00 - g01 * c01, r - g00 * c10 - g01 * c11, q - g10 * c10 - g11 * c11
            root = np.sqrt(max(p, 0.0))
            shared = r / root if root > 0.0 else 0.0
            at = a + root * draws[k, 0]
            offset = b + shared * draws[k, 0] + np.sqrt(max(q - shared * shared, 0.0)) * draws[k, 1]
            found[k] = at
    return total, found
