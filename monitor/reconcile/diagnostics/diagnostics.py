"""Lenses: one function each, for measured and simulated recordings alike.

A lens sees a ``Sight``: an axis beside a model, made white by it. Where the model is true, the whitened coefficients
are independent with variance one, and so is the whitened series; every lens asks this in its own way, and answers with
the largest gain in ln L, in nats, that a departure of its kind would bring at one place, and with the place. Gains of a
true model are nearly the same for every model and length, which is what ``gap`` builds its thresholds on.

The same data give the same answer; nothing is changed.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil
from typing import Final

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from drivers.sample import Floats
from monitor.noise.effect import first_sample
from monitor.noise.effects import (
    NoiseStep,
    PoissonSteps,
    RandomTelegraph,
    RateRamp,
    Resolution,
    SampleHold,
    Saturation,
    TemperatureBias,
    TemperatureLag,
    TurnOnTransient,
)
from monitor.reconcile.likelihood.outlier_statistics import Outliers, outliers
from monitor.reconcile.likelihood.variance_history import Course, Tiles, tiles, variance_course
from monitor.reconcile.preparation.axis import Axis, Effects, Likely
from monitor.reconcile.preparation.cosine_bins import bins as even_bins
from monitor.reconcile.preparation.cosine_bins import series
from monitor.reconcile.result import Where

LAGS: Final = 64
"""Samples of the autocorrelation."""
DECAYS: Final = 0.3 / 3.0 ** np.arange(6)
"""Of the recording: time constants of transients."""
DELAYS_S: Final = (10.0, 30.0, 90.0, 270.0, 810.0)
SLOW: Final = 0.01
"""Of the band: slower parts say nothing of tails and variance, and are the first that a model misses."""
FEW: Final = 64
"""Coefficients whose power is known to a sixth; where a bin has fewer, NEIGHBOURS bins are taken together."""
NEIGHBOURS: Final = 9
MARGIN: Final = 0.001
"""Of the recording, at each end: no step is looked for there, where the ends show in the spectrum themselves."""
LOW: Final = 1e-3
"""Of the power in the median bin: a stop band says nothing of single samples."""


@dataclass(frozen=True, slots=True)
class Sight:
    """An axis beside a model."""

    axis: Axis
    likely: Likely
    whitened: Floats  # [n − 1] coefficients over their standard deviation; draws where nothing is heard
    weight: Floats  # [n − 1] one over their standard deviation; 0 where nothing is heard
    white: Floats  # [n] the series of these
    fast: Floats  # [n] the same without slow parts and with every bin at its own power: for tails and variance

    @property
    def course(self) -> Course:
        """Its variance over time."""
        return variance_course(self.fast, 1.0 / self.axis.rate_hz)

    @property
    def outliers(self) -> Outliers | None:
        """Its tails."""
        return outliers(self.fast)


@dataclass(frozen=True, slots=True)
class Finding:
    """The strongest departure that a lens sees."""

    gain: float  # nats
    where: Where


Lens = Callable[[Sight], Finding]


def sight(axis: Axis, likely: Likely) -> Sight:
    """Make an axis white by a model."""
    weight = axis.bins.spread(axis.heard / np.sqrt(likely.fitted.variance))
    whitened = axis.residual(likely) * weight
    silent = np.flatnonzero(weight == 0.0)
    # a hole in the band would itself be seen
    whitened[silent] = np.random.default_rng(silent.size).standard_normal(silent.size)
    return Sight(axis, likely, whitened, weight, series(whitened), _fast(axis, likely, whitened))


def _fast(axis: Axis, likely: Likely, whitened: Floats) -> Floats:
    """Whatever the spectrum is, tails and variance are then those of white noise."""
    count, together = axis.bins.count, np.ones(NEIGHBOURS)
    sums = axis.bins.sums(whitened**2)
    around = np.convolve(sums, together, "same") / np.convolve(count, together, "same")
    power = np.where(count >= FEW, sums / count, around)
    flat = whitened * axis.bins.spread(1.0 / np.sqrt(power))
    density = power * likely.fitted.variance
    silent = np.flatnonzero(axis.bins.spread(density) < LOW * np.median(density))
    flat[silent] = np.random.default_rng(silent.size).standard_normal(silent.size)
    slow = int(SLOW * axis.n)
    flat[:slow] = np.random.default_rng(slow).standard_normal(slow)  # as above
    return series(flat) / noise_course(likely.effects, axis.n, axis.rate_hz)


def noise_course(effects: Effects, n: int, rate_hz: float) -> Floats:
    """Deviation [n] of the white noise over its root mean square, by the noise steps of the axis."""
    course = np.ones(n)
    for effect in effects:
        if isinstance(effect, NoiseStep):
            course[min(first_sample(effect.time, rate_hz), n) :] *= effect.ratio
    return np.asarray(course / np.sqrt(np.mean(course**2)))


def psd(seen: Sight) -> Finding:
    """Power over frequency: the run of bins, of any width, that is furthest from its expectation."""
    bins = even_bins(seen.axis.n, seen.axis.rate_hz)  # the same for recordings with peaks and without
    power = np.concatenate([[0.0], np.cumsum(bins.sums(seen.whitened**2))])
    count = np.concatenate([[0.0], np.cumsum(bins.count)])
    best, place = 0.0, (0, 1)
    width = 1
    while width <= bins.count.size:
        step = max(1, width // 4)
        first = np.arange(0, bins.count.size - width + 1, step)
        c = count[first + width] - count[first]
        gains = power_gain((power[first + width] - power[first]) / c, c)
        at = int(np.argmax(gains))
        if gains[at] > best:
            best, place = float(gains[at]), (int(first[at]), int(first[at]) + width)
        width *= 2
    lo, hi = bins.f_hz[place[0]], bins.f_hz[place[1] - 1]
    return Finding(best, Where(frequency=(float(lo), float(hi))))


def power_gain(ratio: Floats, count: Floats) -> Floats:
    """Gain of a variance of its own for ``count`` coefficients whose mean square is ``ratio``: n/2 (ρ − 1 − ln ρ)."""
    safe = np.maximum(ratio, 1e-300)
    return np.asarray(0.5 * count * (safe - 1.0 - np.log(safe)))


def lines(seen: Sight) -> Finding:
    """A steady oscillation: the largest of the periodogram, at twice its own spacing."""
    found = line_peaks(seen.white, seen.axis.rate_hz, 1)
    gain, f_hz = found[0]
    half = seen.axis.rate_hz / seen.axis.n
    return Finding(gain, Where(frequency=(f_hz - half, f_hz + half)))


def line_peaks(white: Floats, rate_hz: float, most: int) -> list[tuple[float, float]]:
    """(gain, Hz) of the largest peaks of the periodogram of a white series, strongest first, apart from each other."""
    power = periodogram(white)
    size = 2 * (power.size - 1)
    found = []
    for _ in range(most):
        at = int(np.argmax(power))
        if power[at] <= 0.0:
            break
        found.append((float(power[at]), at * rate_hz / size))
        power[max(at - 12, 0) : at + 13] = 0.0
    return found


def periodogram(white: Floats) -> Floats:
    """Gain of a line [m + 1] at frequencies from 0 to half the rate, more than twice as many as samples have turns."""
    n = white.size
    size = next_fast_len(2 * n, real=True)
    size += size % 2
    turned = rfft(white, size)
    power = (turned.real**2 + turned.imag**2) / n
    power[: 2 * size // n] = 0.0  # slower than one turn
    power[-2:] = 0.0
    return np.asarray(power)


def level(seen: Sight) -> Finding:
    """The level over time: a step at any time, a slope, or a transient after the start.

    Where the model itself jumps, a level that moves says nothing: no spectrum takes jumps out.
    """
    if any(isinstance(effect, (PoissonSteps, RandomTelegraph)) for effect in seen.likely.effects):
        return Finding(0.0, Where())
    gains, times_s = step_gains(seen)
    at = int(np.argmax(gains))
    best = Finding(float(gains[at]), Where(time=(float(times_s[at]), float(times_s[at]))))
    axis = seen.axis
    length_s = axis.n / axis.rate_hz
    for share in DECAYS:
        effect = TurnOnTransient(amplitude=1.0, time_constant=float(share * length_s))
        gain = course_gain(seen, axis.columns(effect))
        if gain > best.gain:
            best = Finding(gain, Where(time=(0.0, effect.time_constant)))
    ramp = axis.columns(RateRamp(R=1.0))
    gain = max(course_gain(seen, ramp), course_gain(seen, [*ramp, axis.courses.curve]) - 1.0)
    return max(best, Finding(gain, Where(time=(0.0, length_s))), key=lambda one: one.gain)


def step_gains(seen: Sight) -> tuple[Floats, Floats]:
    """Gain of one step at each time, and the times in s: all by two transforms.

    The coefficients of a step at sample s are −√(2/n) sin(πks/n)/(2 sin(πk/2n)), so its squared length under weights W
    is Σ W_k (1 − cos(2πks/n))/(4n sin²(πk/2n)), one Fourier transform; its product with the data is a running sum.
    """
    axis = seen.axis
    n = axis.n
    weighted = series(seen.whitened * seen.weight)
    product = np.cumsum(weighted[::-1])[::-1]  # [n] of a step at each sample
    u = np.zeros(n)
    u[1:] = seen.weight**2 * axis.courses.steps
    cosines = rfft(u).real  # of s up to n/2; those beyond are the same, backwards
    length = u.sum() - np.concatenate([cosines, cosines[1 : n - cosines.size + 1][::-1]])
    margin = ceil(MARGIN * n)
    inside = slice(margin, n - margin)
    gains = 0.5 * product[inside] ** 2 / np.maximum(length[inside], 1e-300)
    return gains, np.arange(n)[inside] / axis.rate_hz


def course_gain(seen: Sight, columns: list[Floats]) -> float:
    """Gain of a course of free size on a sight."""
    stacked = np.stack([column * seen.weight for column in columns])
    normal, right = stacked @ stacked.T, stacked @ seen.whitened
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    solved, *_ = np.linalg.lstsq(normal / np.outer(scale, scale), right / scale, rcond=1e-9)
    return float(0.5 * solved @ (right / scale))


def autocorrelation(seen: Sight) -> Finding:
    """The whitened series against itself, a few samples later."""
    n = seen.white.size
    turned = rfft(seen.white, next_fast_len(n + LAGS, real=True))
    products = irfft(turned.real**2 + turned.imag**2, next_fast_len(n + LAGS, real=True))[1 : LAGS + 1]
    gains = 0.5 * (products / n) ** 2 * n
    at = int(np.argmax(gains))
    lag_s = (at + 1) / seen.axis.rate_hz
    return Finding(float(gains[at]), Where(tau=(lag_s, lag_s)))


def temperature(seen: Sight) -> Finding:
    """Level against temperature, at once and late."""
    warmth = seen.axis.temperature_c
    if warmth is None:
        return Finding(0.0, Where())
    reference = float(warmth.mean())
    place = Where(temperature=(float(warmth.min()), float(warmth.max())))
    best = course_gain(seen, seen.axis.columns(TemperatureBias(coefficient=1.0, reference=reference, quadratic=1.0)))
    best = max(best - 1.0, course_gain(seen, seen.axis.columns(TemperatureBias(coefficient=1.0, reference=reference))))
    for delay_s in DELAYS_S:
        lag = TemperatureLag(coefficient=1.0, reference=reference, time_constant=delay_s)
        best = max(best, course_gain(seen, seen.axis.columns(lag)))
    return Finding(best, place)


def other_axes(seen: Sight) -> Finding:
    """What another axis measures, in this one."""
    best = Finding(0.0, Where())
    for name, coefficients in seen.axis.others.items():
        gain = course_gain(seen, [coefficients])
        if gain > best.gain:
            best = Finding(gain, Where(source=name))
    return best


def variance(seen: Sight) -> Finding:
    """The variance of the noise over time: a step, a trend, a period, or any slow course."""
    found = seen.course
    gain = max(found.step.gain, found.trend, found.periodic.gain, found.wander)
    return Finding(gain, Where(time=(found.step.time.lo, found.step.time.hi)))


def spectrogram(seen: Sight) -> Finding:
    """Power over time and frequency: the rectangle, or the row, that is least steady."""
    found = unsteady(seen)
    if found.gain >= found.row_gain:
        return Finding(found.gain, Where(time=found.time, frequency=found.frequency))
    return Finding(found.row_gain, Where(frequency=found.row))


def unsteady(seen: Sight) -> Tiles:
    """The least steady places over time and frequency, beside the noise steps of the axis."""
    axis = seen.axis
    return tiles(seen.white / noise_course(seen.likely.effects, axis.n, axis.rate_hz), 1.0 / axis.rate_hz)


def tails(seen: Sight) -> Finding:
    """The distribution: samples far out."""
    found = seen.outliers
    return Finding(found.gain if found else 0.0, Where())


def values(seen: Sight) -> Finding:
    """The values as they were measured: steps, ends and repeats that the model has not."""
    have = {type(effect) for effect in seen.likely.effects}
    shown = seen.axis.shown
    best = Finding(0.0, Where())
    for kind, found in ((Resolution, shown.levels), (Saturation, shown.clipped), (SampleHold, shown.repeats)):
        if found is not None and kind not in have and found.gain > best.gain:
            best = Finding(found.gain, Where())
    if best.gain and shown.clipped is not None and best.gain == shown.clipped.gain:
        return Finding(best.gain, Where(value=(shown.clipped.limit.lo, shown.clipped.limit.hi)))
    return best


LENSES: Final[dict[str, Lens]] = {
    "values": values,
    "psd": psd,
    "lines": lines,
    "autocorrelation": autocorrelation,
    "level": level,
    "temperature": temperature,
    "other_axes": other_axes,
    "tails": tails,
    "variance": variance,
    "spectrogram": spectrogram,
}
