"""A model's time series: endless, in blocks of any size, the same however it is cut.

Blocks are made in pieces that fit the processor's cache. Within a piece every axis sums its own sources (white noise
first, so that a noise step multiplies nothing else), then each axis that leaks into others is transformed by itself,
then leaks are added, and the sums are transformed. Everything is simulated at the true sample rate.

Every effect of every axis draws from its own random generator, seeded by the stream's seed, the names of axis and
effect, and which of its name on the axis it is: adding or leaving out an effect changes no other series.
"""

import copy
from collections import Counter
from dataclasses import dataclass
from typing import Any, Final
from zlib import crc32

import numpy as np

from drivers.discovery import nearest
from drivers.errors import ConfigError
from drivers.sample import AXES, Floats
from monitor.noise.effect import Block, Effect, Leak, Running, Series, Source, Transform, first_sample
from monitor.noise.effects import ORDER
from monitor.noise.effects.angle_random_walk import AngleRandomWalk
from monitor.noise.effects.noise_step import NoiseStep
from monitor.noise.effects.sample_rate_error import SampleRateError
from monitor.noise.model import NoiseModel
from monitor.noise.model_file import placed
from monitor.noise.temperature import Recorded

PIECE: Final = 2048
"""Samples made at once: six axes of them and what they are made of stay in a core's own cache."""


@dataclass(frozen=True, slots=True)
class Drawn:
    """Simulated samples."""

    values: Floats  # [n, 6] in AXES order, rad/s and m/s²
    temperature_c: Floats  # [n] °C; NaN where the model has none


class ModelStream:
    """A model's series from its first sample on; axes without effects are zero.

    Args:
        model, rate_hz, seed, temperature_c: as of ``NoiseModel.stream``
    Raises:
        ConfigError: the model cannot be simulated at that rate
    """

    def __init__(self, model: NoiseModel, rate_hz: float, seed: int, temperature_c: Floats | None = None) -> None:
        model.check(rate_hz, temperature=temperature_c is not None or model.temperature is not None)
        self._model = model
        self._rate_hz = rate_hz
        self._true_hz = rate_hz * model.rate_ratio
        self._seed = seed
        self._count = 0  # samples drawn so far
        self._occurrences: Counter[tuple[str, str]] = Counter()
        self._truths: list[tuple[str, Effect, Series | Running]] = []
        self._temperature = self._warmth(temperature_c)
        self._axes = {axis: _Axis() for axis in AXES}
        for axis, effect in model:
            self._begin(axis, effect)

    def draw(self, n: int) -> Floats:
        """The next ``n`` samples [n, 6] in rad/s and m/s²."""
        return self.draw_all(n).values

    def draw_all(self, n: int) -> Drawn:
        """The next ``n`` samples with their temperature."""
        drawn = Drawn(np.empty((n, len(AXES))), np.full(n, np.nan))
        for begin in range(0, n, PIECE):
            piece = slice(begin, min(begin + PIECE, n))
            self._advance(drawn.values[piece], drawn.temperature_c[piece])
        return drawn

    def add(self, axis: str, effect: Effect) -> None:
        """Add an effect from the next sample on, at no cost that grows with what was drawn.

        A ``time`` still counts from the stream's first sample; what begins of itself (a walk, a ramp, a transient)
        begins now.

        Raises:
            ConfigError: the effect cannot be on that axis, at that rate, or in a stream that runs (a sample rate error)
        """
        if axis not in AXES:
            raise ConfigError(f'unknown axis "{axis}"{nearest(axis, AXES)}')
        if isinstance(effect, SampleRateError):
            raise ConfigError(f"{axis}.{effect.name}: the clock of a stream that runs cannot change")
        model = self._model + NoiseModel({axis: (effect,)})
        model.check(self._rate_hz, temperature=self._temperature is not None)
        self._model = model
        self._begin(axis, effect)

    def truth(self) -> dict[str, dict[str, list[dict[str, Any]]]]:
        """Axis -> effect -> what was drawn so far, for each of that name: phases, counts, times in s from the start.

        Effects of which the parameters say all are left out. Ready for JSON.
        """
        told: dict[str, dict[str, list[dict[str, Any]]]] = {}
        for axis, effect, one in self._truths:
            truth = one.truth()
            if truth:
                told.setdefault(axis, {}).setdefault(effect.name, []).append(truth)
        return told

    def _warmth(self, recorded_c: Floats | None) -> Series | None:
        if recorded_c is not None:
            return Recorded(recorded_c)
        generator = self._model.temperature
        return None if generator is None else generator.start(self._true_hz, self._rng("temperature", "", 0))

    def _begin(self, axis: str, effect: Effect) -> None:
        occurrence = self._occurrences[axis, effect.name]
        self._occurrences[axis, effect.name] += 1
        line = self._axes[axis]
        if isinstance(effect, Source):
            series = effect.start(self._true_hz, self._rng(axis, effect.name, occurrence))
            (line.white if isinstance(effect, AngleRandomWalk) else line.others).append(series)
            self._truths.append((axis, effect, series))
        elif isinstance(effect, NoiseStep):
            line.steps.append((first_sample(effect.time, self._true_hz), effect.ratio))
        elif isinstance(effect, Leak):
            line.leak(effect)
            self._axes[effect.source].leaks_out = True
        elif isinstance(effect, Transform):
            with placed(f"{axis}.{effect.name}"):
                running = effect.start(self._true_hz, self._rng(axis, effect.name, occurrence))
            line.insert(ORDER.index(type(effect)), running)
            self._truths.append((axis, effect, running))
        else:
            raise TypeError(f"{effect.name} is no source, leak, noise step or transform")

    def _rng(self, axis: str, effect: str, occurrence: int) -> np.random.Generator:
        key = (crc32(axis.encode()), crc32(effect.encode()), occurrence)
        return np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=key))

    def _advance(self, values: Floats, temperature_c: Floats) -> None:
        n = temperature_c.size
        block = Block(self._count, temperature_c, np.empty(n))
        if self._temperature is not None:
            temperature_c[:] = 0.0
            self._temperature.add(temperature_c, block)
        sums = {axis: line.sum(block, n) for axis, line in self._axes.items()}
        alone = {axis: line.measure_alone(sums[axis]) for axis, line in self._axes.items() if line.alone}
        for column, (axis, line) in enumerate(self._axes.items()):
            values[:, column] = line.measure(sums[axis], alone)
        self._count += n


class _Axis:
    """What runs on one axis."""

    def __init__(self) -> None:
        self.white: list[Series] = []
        self.others: list[Series] = []
        self.steps: list[tuple[int, float]] = []  # first sample, ratio
        self.leaks: list[Leak] = []
        self.leaks_out = False
        self._chain: list[tuple[int, Running]] = []  # (place in ORDER, transform), sorted
        self._alone: list[tuple[int, Running]] = []  # the same on the axis' own sources; used where leaks come in

    @property
    def alone(self) -> bool:
        """Whether the axis by itself is needed, or may come to be needed while its transforms carry on a state."""
        return self.leaks_out or bool(self.leaks)

    def insert(self, place: int, running: Running) -> None:
        """Put a transform behind those of its place."""
        if self.leaks:
            self._alone.append((place, copy.deepcopy(running)))
            self._alone.sort(key=lambda one: one[0])
        self._chain.append((place, running))
        self._chain.sort(key=lambda one: one[0])

    def leak(self, leak: Leak) -> None:
        """From here on the axis as measured is no longer the axis by itself."""
        if not self.leaks:
            self._alone = copy.deepcopy(self._chain)
        self.leaks.append(leak)

    def sum(self, block: Block, n: int) -> Floats:
        """The axis' own sources."""
        values = np.zeros(n)
        for series in self.white:
            series.add(values, block)
        for first, ratio in self.steps:
            values[max(0, first - block.first) :] *= ratio
        for series in self.others:
            series.add(values, block)
        return values

    def measure_alone(self, own: Floats) -> Floats:
        """What the axis reads by itself: transformed in place where nothing leaks in, else a copy."""
        if not self.leaks:
            return _through(self._chain, own)
        return _through(self._alone, own.copy())

    def measure(self, own: Floats, alone: dict[str, Floats]) -> Floats:
        """What the axis reads."""
        if self.leaks:
            for leak in self.leaks:
                own += leak.coefficient * alone[leak.source]
        elif self.leaks_out:
            return own  # transformed already
        return _through(self._chain, own)


def _through(chain: list[tuple[int, Running]], values: Floats) -> Floats:
    for _, running in chain:
        running.apply(values)
    return values
