"""Every effect's series, drawn by algorithms of their own.

Each is another way to the law that the effect's name stands for, so that an error of the program's generator cannot
hide in this one: white noise through the inverse normal distribution, random walks by halving intervals (Lévy 1948;
P. Mörters and Y. Peres, Brownian Motion, section 1.1), flicker shaped in the frequency domain (Timmer and König,
Astron. Astrophys. 300 (1995) 707) with eight times the length so that it wraps nowhere, resonances as two slow
quadratures on a carrier, popcorn by drawn dwells, jumps by a drawn count at uniform times, low-passes by their
frequency response. Spectra are two-sided. All is in SI of the axis and at the true sample rate.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.signal import lfilter
from scipy.special import ndtri

Floats = NDArray[np.float64]
Parameters = Mapping[str, Any]

PAD: Final = 8  # flicker is cut out of a series so many times longer: its spectrum reaches down to 1/(8T)
SUBSTEPS: Final = 8  # steps of the frequency of a wandering line for each sample
SETTLING: Final = 8192  # samples of constant input before a filter


@dataclass(frozen=True, slots=True)
class Clock:
    """What a series is drawn on."""

    n: int
    rate_hz: float  # true
    temperature_c: Floats | None = None  # [n]

    @property
    def t_s(self) -> Floats:
        """[n] from the first sample."""
        return np.arange(self.n) / self.rate_hz


def generator(seed: int, *names: object) -> np.random.Generator:
    """Independent draws for each tuple of names: changing a size changes no draw."""
    key = tuple(crc32(str(name).encode()) for name in names)
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(seed, spawn_key=key)))


def white(n: int, rng: np.random.Generator) -> Floats:
    """[n] of variance 1."""
    return np.asarray(ndtri(rng.random(n)))


def quantization_noise(clock: Clock, rng: np.random.Generator, Q: float) -> Floats:
    """White error of the angle, differenced over a sample: S = 4Q²/τ0 · sin²(πfτ0)."""
    return np.asarray(np.diff(Q * white(clock.n + 1, rng)) * clock.rate_hz)


def angle_random_walk(clock: Clock, rng: np.random.Generator, N: float) -> Floats:
    """S = N²: samples of variance N²/τ0."""
    return np.asarray(N * np.sqrt(clock.rate_hz) * white(clock.n, rng))


def shaped(clock: Clock, rng: np.random.Generator, density: Callable[[Floats], Floats]) -> Floats:
    """Gaussian noise of two-sided density S(f): independent Gaussian amplitudes, √(S·fs·M) each, one transform."""
    size = next_fast_len(PAD * clock.n, real=True)
    f_hz = np.arange(1, size // 2 + 1) * clock.rate_hz / size
    amplitude = np.sqrt(0.5 * density(f_hz) * clock.rate_hz * size)
    spectrum = np.zeros(size // 2 + 1, np.complex128)
    spectrum[1:] = amplitude * (rng.standard_normal(f_hz.size) + 1j * rng.standard_normal(f_hz.size))
    return np.asarray(irfft(spectrum, size)[: clock.n])


def bias_instability(clock: Clock, rng: np.random.Generator, B: float) -> Floats:
    """S = B²/(2πf), exactly, up to half the sample rate."""
    return shaped(clock, rng, lambda f: B**2 / (2.0 * np.pi * f))


def rate_random_walk(clock: Clock, rng: np.random.Generator, K: float) -> Floats:
    """Brownian motion of variance K²t: its end first, then the middle of every interval given both ends."""
    levels = int(np.ceil(np.log2(clock.n)))
    path = np.zeros(2**levels + 1)
    span = 2**levels
    path[span] = np.sqrt(span) * rng.standard_normal()
    while span > 1:
        half = span // 2
        ends = path[::span]
        path[half::span] = 0.5 * (ends[:-1] + ends[1:]) + 0.5 * np.sqrt(span) * rng.standard_normal(ends.size - 1)
        span = half
    return np.asarray(K / np.sqrt(clock.rate_hz) * path[1 : clock.n + 1])


def rate_ramp(clock: Clock, rng: np.random.Generator, R: float) -> Floats:
    """A slope."""
    return R * clock.t_s


def exponentially_correlated(clock: Clock, rng: np.random.Generator, sigma: float, correlation_time: float) -> Floats:
    """x ← φx + σ√(1 − φ²) w, φ = exp(−τ0/T_c), begun in its stationary law."""
    phi = np.exp(-1.0 / (correlation_time * clock.rate_hz))
    shocks = np.sqrt(1.0 - phi**2) * white(clock.n, rng)
    shocks[0] = rng.standard_normal()
    return sigma * np.asarray(lfilter([1.0], [1.0, -phi], shocks))


def sinusoidal(clock: Clock, rng: np.random.Generator, amplitude: float, frequency: float, phase: float) -> Floats:
    """A line."""
    return amplitude * np.sin(2.0 * np.pi * frequency * clock.t_s + phase)


def narrowband(clock: Clock, rng: np.random.Generator, sigma: float, frequency: float, bandwidth: float) -> Floats:
    """Two correlated noises of T_c = 1/(πΔ) on the cosine and the sine: autocovariance σ² exp(−πΔ|t|) cos 2πft."""
    cosine, sine = (exponentially_correlated(clock, rng, sigma, 1.0 / (np.pi * bandwidth)) for _ in range(2))
    angle = 2.0 * np.pi * frequency * clock.t_s
    return cosine * np.cos(angle) + sine * np.sin(angle)


def wandering_line(
    clock: Clock,
    rng: np.random.Generator,
    amplitude: float,
    frequency: float,
    frequency_deviation: float,
    correlation_time: float,
    phase: float,
) -> Floats:
    """A line of constant amplitude: its frequency is correlated noise about the centre, summed up in fine steps."""
    fine = Clock(clock.n * SUBSTEPS, clock.rate_hz * SUBSTEPS)
    hz = frequency + exponentially_correlated(fine, rng, frequency_deviation, correlation_time)
    turns = np.concatenate([[0.0], np.cumsum(0.5 * (hz[1:] + hz[:-1]))]) / fine.rate_hz
    return amplitude * np.sin(2.0 * np.pi * turns[::SUBSTEPS] + phase)


def power_law(clock: Clock, rng: np.random.Generator, density: float, exponent: float) -> Floats:
    """S = D² (sin(πfτ0)/(πτ0))^−α; what wraps at the ends of a steep one is far away."""
    tau0 = 1.0 / clock.rate_hz
    return shaped(clock, rng, lambda f: density**2 * (np.sin(np.pi * f * tau0) / (np.pi * tau0)) ** -exponent)


def temperature_bias(
    clock: Clock, rng: np.random.Generator, coefficient: float, reference: float, quadratic: float = 0.0
) -> Floats:
    """At once."""
    if clock.temperature_c is None:
        raise ValueError("temperature_bias needs a temperature")
    warmer = clock.temperature_c - reference
    return coefficient * warmer + quadratic * warmer**2


def temperature_lag(
    clock: Clock, rng: np.random.Generator, coefficient: float, reference: float, time_constant: float
) -> Floats:
    """First-order lag, settled at the first temperature; the temperature is held between samples."""
    if clock.temperature_c is None:
        raise ValueError("temperature_lag needs a temperature")
    stay = np.exp(-1.0 / (time_constant * clock.rate_hz))
    first = clock.temperature_c[0]
    inside = first + lfilter([0.0, 1.0 - stay], [1.0, -stay], clock.temperature_c - first)
    return coefficient * (np.asarray(inside) - reference)


def temperature_hysteresis(clock: Clock, rng: np.random.Generator, height: float, reversal: float) -> Floats:
    """Half the height above or below the middle: where T stands in a window that it drags along."""
    if clock.temperature_c is None:
        raise ValueError("temperature_hysteresis needs a temperature")
    half, middle = 0.5 * reversal, np.empty(clock.n)
    at = float(clock.temperature_c[0])
    for k, one in enumerate(clock.temperature_c.tolist()):
        at = min(max(at, one - half), one + half)
        middle[k] = at
    return height * (clock.temperature_c - middle) / reversal


def turn_on_transient(clock: Clock, rng: np.random.Generator, amplitude: float, time_constant: float) -> Floats:
    """A exp(−t/τ)."""
    return amplitude * np.exp(-clock.t_s / time_constant)


def bias_step(clock: Clock, rng: np.random.Generator, time: float, height: float) -> Floats:
    """One jump."""
    return np.where(clock.t_s >= time, height, 0.0)


def bias_curve(clock: Clock, rng: np.random.Generator, slope: float, curvature: float) -> Floats:
    """A parabola."""
    return np.asarray(np.polyval([curvature, slope, 0.0], clock.t_s))


def random_telegraph(clock: Clock, rng: np.random.Generator, amplitude: float, dwell_time: float) -> Floats:
    """Levels ±a/2, by drawn dwells."""
    seconds = clock.n / clock.rate_hz
    count = int(seconds / dwell_time + 10.0 * np.sqrt(seconds / dwell_time) + 20.0)
    flips = np.cumsum(rng.exponential(dwell_time, count))
    parity = np.searchsorted(flips, clock.t_s, side="right") + rng.integers(2)
    return np.where(parity % 2, 0.5 * amplitude, -0.5 * amplitude)


def poisson_steps(clock: Clock, rng: np.random.Generator, rate: float, height: float) -> Floats:
    """A drawn number of jumps, at uniform times."""
    seconds = clock.n / clock.rate_hz
    times = np.sort(rng.uniform(0.0, seconds, rng.poisson(rate * seconds)))
    levels = np.concatenate([[0.0], np.cumsum(height * rng.standard_normal(times.size))])
    return np.asarray(levels[np.searchsorted(times, clock.t_s, side="right")])


def heavy_tails(clock: Clock, rng: np.random.Generator, nu: float) -> Floats:
    """[n] in front of Gaussian samples: √((ν − 2)/χ²) makes them Student's t of the same variance."""
    return np.sqrt((nu - 2.0) / rng.chisquare(nu, clock.n))


def outliers(clock: Clock, rng: np.random.Generator, fraction: float, scale: float) -> Floats:
    """A drawn number of samples, any of them."""
    values = np.zeros(clock.n)
    hit = rng.choice(clock.n, rng.binomial(clock.n, fraction), replace=False)
    values[hit] = scale * rng.standard_normal(hit.size)
    return values


def pulse_train(
    clock: Clock, rng: np.random.Generator, height: float, period: float, width: float, delay: float
) -> Floats:
    """By the times of rising and falling edges."""
    count = int(clock.n / clock.rate_hz / period) + 3
    rising = delay + period * np.arange(-1, count)
    edges = np.stack([rising, rising + width], axis=1).ravel() - 1e-9
    return height * (np.searchsorted(edges, clock.t_s, side="right") % 2)


def modulated(clock: Clock, depth: float, period: float, phase: float) -> Floats:
    """Variance that rises and falls, relative to its mean."""
    return np.asarray(1.0 + depth * np.imag(np.exp(1j * (2.0 * np.pi * clock.t_s / period + phase))))


def wandering_gain(clock: Clock, rng: np.random.Generator, deviation: float, correlation_time: float) -> Floats:
    """[n] in front of Gaussian samples: the logarithm of the variance is a Gauss–Markov process."""
    decay = np.exp(-1.0 / (clock.rate_hz * correlation_time))
    drive = deviation * np.sqrt(1.0 - decay**2) * rng.standard_normal(clock.n)
    drive[0] = deviation * rng.standard_normal()
    return np.asarray(np.exp(0.5 * lfilter([1.0], [1.0, -decay], drive) - 0.25 * deviation**2))


SOURCES: Final[dict[str, Callable[..., Floats]]] = {
    function.__name__: function
    for function in (
        quantization_noise,
        angle_random_walk,
        bias_instability,
        rate_random_walk,
        rate_ramp,
        exponentially_correlated,
        sinusoidal,
        narrowband,
        wandering_line,
        power_law,
        temperature_bias,
        temperature_lag,
        temperature_hysteresis,
        turn_on_transient,
        bias_step,
        bias_curve,
        random_telegraph,
        poisson_steps,
        outliers,
        pulse_train,
    )
}


def scale_factor(values: Floats, rate_hz: float, rng: np.random.Generator, factor: float) -> Floats:
    """Another unit."""
    return factor * values


def bandwidth_limit(
    values: Floats, rate_hz: float, rng: np.random.Generator, cutoff: float, order: int, floor: float = 0.0
) -> Floats:
    """Butterworth's poles on the unit circle, bilinear: s = i tan(πfτ0)/tan(πf_cτ0); settled at the first sample."""
    padded = np.concatenate([np.full(SETTLING, values[0]), values])
    size = next_fast_len(padded.size, real=True)
    # at half the sample rate the tangent is infinite and the response zero
    angle = np.minimum(np.pi * np.arange(size // 2 + 1) / size, 0.5 * np.pi - 1e-9)
    s = 1j * np.tan(angle) / np.tan(np.pi * cutoff / rate_hz)
    poles = np.exp(1j * np.pi * (2.0 * np.arange(1, order + 1) + order - 1.0) / (2.0 * order))
    response = 1.0 / np.prod(s[:, None] - poles, axis=1)
    # circular: what the end of the series leaves behind falls into the constant stretch, which is cut off
    filtered = irfft(rfft(padded - values[0], size) * response, size)[SETTLING : padded.size]
    return np.asarray(filtered + values[0] + floor * np.sqrt(rate_hz) * white(values.size, rng))


def saturation(values: Floats, rate_hz: float, rng: np.random.Generator, limit: float) -> Floats:
    """Clipped."""
    return np.where(np.abs(values) > limit, np.copysign(limit, values), values)


def resolution(values: Floats, rate_hz: float, rng: np.random.Generator, step: float) -> Floats:
    """The nearest multiple of a step."""
    return np.floor(values / step + 0.5) * step


def sample_hold(values: Floats, rate_hz: float, rng: np.random.Generator, fraction: float) -> Floats:
    """Each sample is the newest one that was not held."""
    fresh = np.where(rng.random(values.size) < fraction, 0, np.arange(values.size))
    return np.asarray(values[np.maximum.accumulate(fresh)])


TRANSFORMS: Final[dict[str, Callable[..., Floats]]] = {
    function.__name__: function for function in (scale_factor, bandwidth_limit, saturation, resolution, sample_hold)
}  # in the order in which they act
