"""One axis of a recording, ready to be asked how well a model describes it.

In come samples without holes; the transforms of all axes, for what leaks; the temperature. ``fit`` takes the effects of
an axis, and the sizes of noises that are held, and gives the maximum of the likelihood. Regressors are made once and
kept: the same ramp, line or delayed temperature is asked for again at every trial.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Final, TypeGuard

import numpy as np

from drivers.sample import Floats
from monitor.noise.effect import Effect, Leak, Transform
from monitor.noise.effects import (
    ORDER,
    AngleRandomWalk,
    BandwidthLimit,
    Bias,
    NoiseStep,
    Resolution,
    SampleHold,
    Saturation,
)
from monitor.noise.spectrum import Spectrum, white
from monitor.reconcile.likelihood.effect_terms import COURSE, NOISE, basis, columns, resized, size, sized
from monitor.reconcile.likelihood.whittle import Fitted, Sums, maximise
from monitor.reconcile.preparation.cosine_bins import Bins, transform
from monitor.reconcile.preparation.value_statistics import Clipped, Levels, Repeats

DEEP: Final = 1e-4
"""Of the power in the median bin: below that, in a filter's stop band, the ends of a recording are all there is."""
SLOW: Final = 0.02
"""Of the rate: no stop band begins below, but bins of one coefficient may be that low by chance."""
KEPT_BYTES: Final = 1 << 28
FEWEST_KEPT: Final = 16
"""Series that are kept however long they are: as many as the lenses ask for."""
PRODUCTS: Final = 4096
"""Sums over bins that an axis keeps."""
Effects = tuple[Effect, ...]
CURVE: Final = Bias(value=1.0)
"""Stands for t² among regressors: as an effect it would be none."""


@dataclass(frozen=True, slots=True)
class Likely:
    """Effects of an axis at the maximum of the likelihood."""

    effects: Effects  # with fitted sizes
    held: frozenset[int]  # indices of effects whose size was not fitted
    log_likelihood: float
    fitted: Fitted
    noises: tuple[int, ...]  # index in ``effects`` of each fitted θ
    courses: tuple[tuple[int, slice], ...]  # index in ``effects`` and place in β of each course
    behind: float = 0.0  # variance of a coefficient, of the white noise behind a low-pass

    def error(self, at: int) -> float:
        """Standard error of the size of an effect; NaN where it was held."""
        if at in self.noises:
            noise = self.noises.index(at)
            covariance = np.linalg.pinv(self.fitted.theta_information)
            theta = float(self.fitted.theta[noise])
            return 0.5 * float(np.sqrt(covariance[noise, noise] / theta)) if theta > 0.0 else float("nan")
        for index, place in self.courses:
            if index == at:  # two columns of one course err alike: a sine and its cosine
                return float(np.sqrt(np.diag(self.fitted.beta_covariance)[place].mean()))
        return float("nan")


@dataclass(frozen=True, slots=True)
class Shown:
    """What the samples of an axis show as they were measured."""

    levels: Levels | None
    clipped: Clipped | None
    repeats: Repeats | None


class Courses:
    """Transforms of what follows time and temperature, made once: the same are asked for again at every trial.

    Args:
        n, rate_hz: of the series
        temperature_c: [n] °C, or None
    """

    def __init__(self, n: int, rate_hz: float, temperature_c: Floats | None) -> None:
        def make(effect: Effect) -> list[Floats]:
            return [transform(one) for one in columns(effect, n, rate_hz, temperature_c)]

        self.curve = transform(np.linspace(-1.0, 1.0, n) ** 2)
        """[n − 1] of t², for which there is no name."""
        self.steps = 0.25 / n / np.sin(0.5 * np.pi * np.arange(1, n) / n) ** 2
        """[n − 1] mean squares, over all times, of the coefficients of a step of one."""
        self._make = lru_cache(max(FEWEST_KEPT, KEPT_BYTES // (8 * n)))(make)

    def columns(self, effect: Effect) -> list[Floats]:
        """Transforms [n − 1] of the series of a course with size one."""
        return self._make(sized(effect, np.ones(2)))


@dataclass(slots=True)
class Axis:
    """One axis of one recording."""

    name: str
    raw: Floats  # [n] as measured; NaN = missing
    y: Floats  # [n] rad/s or m/s², mended
    coefficients: Floats  # [n − 1] its transform
    bins: Bins
    others: Mapping[str, Floats]  # [n − 1] transforms of the axes that may leak into it
    temperature_c: Floats | None  # [n]
    shown: Shown
    courses: "Courses"  # shared by all axes of a recording, and of those simulated after it
    heard: Floats = field(init=False)  # [m] 1, or 0 for bins so deep in a stop band that they are asked for nothing
    _products: dict[tuple[object, ...], Floats] = field(default_factory=dict)

    def __post_init__(self) -> None:
        power = self.bins.sums(self.coefficients**2) / self.bins.count
        slow = self.bins.f_hz < SLOW * self.bins.rate_hz
        self.heard = ((power > DEEP * np.median(power)) | slow).astype(np.float64)

    @property
    def n(self) -> int:
        """Samples."""
        return self.y.size

    @property
    def rate_hz(self) -> float:
        """Samples a second, as stated."""
        return self.bins.rate_hz

    def rebinned(self, bins: Bins) -> "Axis":
        """The same with other bins."""
        return Axis(
            self.name,
            self.raw,
            self.y,
            self.coefficients,
            bins,
            self.others,
            self.temperature_c,
            self.shown,
            self.courses,
        )

    def columns(self, effect: Effect) -> list[Floats]:
        """Transforms [n − 1] of the series of a course with size one."""
        return [self.others[effect.source]] if isinstance(effect, Leak) else self.courses.columns(effect)

    def fit(
        self,
        effects: Sequence[Effect],
        held: frozenset[int] = frozenset(),
        extra: Floats | None = None,
        curved: bool = False,
        floor: bool = True,
    ) -> Likely:
        """The maximum over all sizes that are not held.

        Args:
            effects: of the axis; shapes stay, sizes are where the search begins
            held: indices of noises whose size stays
            extra: [r, m] nameless bases besides, of variance for θ = 1
            curved: t² besides, nameless too
            floor: where there is a low-pass, white noise behind it: a real sensor aliases, its converter is noisy, and
                the null that a digital filter has at half the rate is never seen
        """
        f_hz, tau0_s = self.bins.f_hz, 1.0 / self.rate_hz
        transforms = sorted((e for e in effects if self._shapes(e)), key=lambda e: ORDER.index(type(e)))
        constant = reshaped(transforms, Spectrum(np.zeros_like, np.zeros_like, tau0_s), f_hz) / tau0_s
        noises, bases, start = [], [], []
        for at, effect in enumerate(effects):
            if type(effect) not in NOISE:
                continue
            made = self._basis(effect, effects, transforms)
            if at in held:
                constant = constant + size(effect) ** 2 * made
            else:
                noises.append(at)
                bases.append(made)
                start.append(min(size(effect) ** 2, self._whole(made)))
        floor = floor and any(isinstance(one, BandwidthLimit) for one in transforms)
        if floor:
            bases.append(np.ones_like(f_hz))
            start.append(1e-3 * self._whole(bases[-1]))
        for row in extra if extra is not None else ():
            bases.append(row)
            start.append(1e-2 * self._whole(row))
        courses: list[tuple[int, slice]] = []
        regressors: list[tuple[Effect, int]] = []
        for at, effect in enumerate(effects):
            if type(effect) in COURSE:
                made_columns = self.columns(effect)
                courses.append((at, slice(len(regressors), len(regressors) + len(made_columns))))
                regressors += [(effect, i) for i in range(len(made_columns))]
        if curved:
            regressors.append((CURVE, 0))
        found = self._sums(regressors)
        stacked = np.asarray(bases).reshape(len(bases), f_hz.size)
        fitted = maximise(self.bins.count * self.heard, found, stacked, constant, np.asarray(start, np.float64))
        return Likely(
            self._resized(effects, noises, courses, fitted),
            held,
            fitted.log_likelihood,
            fitted,
            tuple(noises),
            tuple(courses),
            float(fitted.theta[len(noises)]) if floor else 0.0,
        )

    def at(self, likely: Likely, beta: Floats) -> Likely:
        """The same noise with courses of given sizes."""
        fitted = likely.fitted
        regressors = [(likely.effects[at], i) for at, place in likely.courses for i in range(place.stop - place.start)]
        found = self._sums(regressors)
        residual = found.power - 2.0 * beta @ found.cross + np.einsum("i,j,ijb->b", beta, beta, found.gram)
        count = self.bins.count * self.heard
        value = -0.5 * float((count * np.log(fitted.variance) + residual / fitted.variance).sum())
        changed = replace(fitted, beta=beta, residual=np.maximum(residual, 0.0), log_likelihood=value)
        return replace(likely, fitted=changed, log_likelihood=value)

    def residual(self, likely: Likely) -> Floats:
        """Coefficients [n − 1] with all courses taken out."""
        left = self.coefficients.copy()
        for at, place in likely.courses:
            for factor, column in zip(likely.fitted.beta[place], self.columns(likely.effects[at]), strict=True):
                left -= factor * column
        return left

    def _shapes(self, effect: Effect) -> TypeGuard[Transform]:
        """Whether a transform shows in the spectrum: repeats that are known one by one were mended."""
        mended = isinstance(effect, SampleHold) and self.shown.repeats is not None and self.shown.repeats.mask.any()
        return isinstance(effect, Transform) and not mended

    def _basis(self, effect: Effect, effects: Sequence[Effect], transforms: Sequence[Transform]) -> Floats:
        tau0_s = 1.0 / self.rate_hz
        share = 1.0
        if isinstance(effect, AngleRandomWalk):
            for other in effects:
                if isinstance(other, NoiseStep):
                    later = 1.0 - min(other.time * self.rate_hz / self.n, 1.0)
                    share *= 1.0 + later * (other.ratio**2 - 1.0)  # its mean over the recording
        raw = Spectrum(lambda f: share * basis(effect, f, tau0_s), None, tau0_s)
        empty = Spectrum(np.zeros_like, np.zeros_like, tau0_s)
        with_it = reshaped(transforms, raw, self.bins.f_hz)
        return np.asarray((with_it - reshaped(transforms, empty, self.bins.f_hz)) / tau0_s)

    def _whole(self, made: Floats) -> float:
        """The θ of which a basis would have all power of the axis."""
        return float(self._product(None, None).sum() / max((self.bins.count * self.heard * made).sum(), 1e-300))

    def _sums(self, regressors: Sequence[tuple[Effect, int]]) -> Sums:
        q, m = len(regressors), self.bins.count.size
        cross, gram = np.empty((q, m)), np.empty((q, q, m))
        for i, one in enumerate(regressors):
            cross[i] = self._product(one, None)
            for j in range(i + 1):
                gram[i, j] = gram[j, i] = self._product(one, regressors[j])
        return Sums(self._product(None, None), cross, gram)

    def _product(self, one: tuple[Effect, int] | None, other: tuple[Effect, int] | None) -> Floats:
        """Sums over bins of the product of two columns; None is the axis itself."""
        key = (_key(one), _key(other))
        if key not in self._products:
            a, b = (self._column(x) for x in (one, other))
            if len(self._products) > PRODUCTS:
                self._products.clear()
            self._products[key] = self.bins.sums(a * b) * self.heard
        return self._products[key]

    def _column(self, one: tuple[Effect, int] | None) -> Floats:
        if one is None:
            return self.coefficients
        return self.courses.curve if one[0] is CURVE else self.columns(one[0])[one[1]]

    @staticmethod
    def _resized(
        effects: Sequence[Effect], noises: Sequence[int], courses: Sequence[tuple[int, slice]], fitted: Fitted
    ) -> Effects:
        found = list(effects)
        for theta, at in zip(fitted.theta, noises, strict=False):  # nameless bases come last
            found[at] = resized(found[at], float(theta) ** 0.5)
        for at, place in courses:
            found[at] = sized(found[at], fitted.beta[place])
        return tuple(found)


def reshaped(transforms: Sequence[Transform], spectrum: Spectrum, f_hz: Floats) -> Floats:
    """Spectrum [m] behind the transforms; rounding adds white noise, also where its steps are coarse."""
    for one in transforms:
        if isinstance(one, Saturation):
            continue  # what is clipped was put back before
        if isinstance(one, Resolution):
            spectrum = spectrum + white(one.step**2 / 12.0, spectrum.tau0_s)
        else:
            spectrum = one.reshape(spectrum)
    return spectrum.density(f_hz)


def _key(one: tuple[Effect, int] | None) -> tuple[object, int] | None:
    if one is None:
        return None
    effect, at = one
    if effect is CURVE:
        return effect, at
    return (resized(effect, 1.0) if isinstance(effect, Leak) else sized(effect, np.ones(2)), at)
