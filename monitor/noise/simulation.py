"""Simulation of the time series of a noise model: endless, in blocks of any size, independent of the division into
blocks.

Blocks are simulated in pieces that fit the processor's cache. For each piece, the sources of every axis are added.
White noise is added first, because a noise step multiplies only white noise. Next, the transforms are applied to each
axis that leaks into other axes. The results are added to the other axes, and the transforms are applied to the sums.
All effects are simulated at the true sample rate.

Every effect of every axis has its own random generator. Its seed is formed from the seed of the stream, the names of
axis and effect, and the number of earlier effects of the same name on the axis. Adding or removing an effect therefore
changes no other series.
"""

import copy
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final
from zlib import crc32

import numpy as np

from drivers.data_types import AXES, Floats
from drivers.errors import ConfigError
from drivers.module_lookup import format_suggestion
from monitor.noise.effect import (
    AxisLeak,
    Effect,
    NoiseSeries,
    RunningEffect,
    RunningTransform,
    SampleBlockContext,
    Source,
    Transform,
    first_sample_at_or_after,
)
from monitor.noise.effects import TRANSFORM_ORDER
from monitor.noise.effects.disturbances.noise_step import NoiseStep
from monitor.noise.effects.ieee952.angle_random_walk import AngleRandomWalk
from monitor.noise.effects.signal_chain.sample_rate_error import SampleRateError
from monitor.noise.model_toml import prefix_config_errors
from monitor.noise.temperature import Temperature, recorded_temperature

PIECE_SAMPLES: Final = 2048
"""Samples simulated at once. Six axes of them, with their work arrays, stay in the cache of a processor core."""


@dataclass(frozen=True, slots=True)
class SimulatedSamples:
    """Simulated samples with their temperature."""

    values: Floats  # [n, 6] in AXES order, rad/s and m/s²
    temperature_c: Floats  # [n] °C; NaN if the model has no temperature


def check_effects_can_be_simulated(
    axis_effects: Mapping[str, tuple[Effect, ...]], true_rate_hz: float, has_temperature: bool
) -> None:
    """Check that effects can be simulated together.

    Parameters
    ----------
    axis_effects : mapping of str to tuple of Effect
        Axis -> its effects.
    true_rate_hz : float
        True sample rate, Hz.
    has_temperature : bool
        True if a temperature is available, from the model or from a recording.

    Raises
    ------
    ConfigError
        If a frequency is at or above half the sample rate, the axis of a leak has no effects, a noise step has no white
        noise, or a required temperature is missing.
    """
    for axis in AXES:
        effects = axis_effects.get(axis, ())
        for effect in effects:
            with prefix_config_errors(f"{axis}.{effect.name}"):
                effect.check_rate(true_rate_hz)
                if isinstance(effect, AxisLeak) and not axis_effects.get(effect.source):
                    raise ConfigError(f"the model has no effect on its source {effect.source}")
                if isinstance(effect, NoiseStep) and not any(isinstance(one, AngleRandomWalk) for one in effects):
                    raise ConfigError(f"{axis} has no angle_random_walk to multiply")
                if isinstance(effect, Source) and effect.uses_temperature and not has_temperature:
                    raise ConfigError(
                        "no temperature: the model has no table [temperature], and no recording provides one"
                    )


class ModelStream:
    """Endless simulated series of six axes. Axes without effects are zero.

    Parameters
    ----------
    axis_effects : mapping of str to tuple of Effect
        Axis -> its effects.
    temperature : Temperature or None
        Simulated temperature.
    rate_hz : float
        Stated sample rate, Hz.
    true_to_stated_rate_ratio : float
        True sample rate divided by the stated one.
    seed : int
        Seed of the random generators.
    temperature_c : ndarray, shape (n,), or None
        Temperature of a recording in °C, used instead of the simulated temperature.

    Raises
    ------
    ConfigError
        If the effects cannot be simulated at this rate.
    """

    def __init__(
        self,
        axis_effects: Mapping[str, tuple[Effect, ...]],
        temperature: Temperature | None,
        rate_hz: float,
        true_to_stated_rate_ratio: float,
        seed: int,
        temperature_c: Floats | None = None,
    ) -> None:
        check_effects_can_be_simulated(
            axis_effects, rate_hz * true_to_stated_rate_ratio, temperature_c is not None or temperature is not None
        )
        self._effects = {axis: axis_effects.get(axis, ()) for axis in AXES}
        self._true_hz = rate_hz * true_to_stated_rate_ratio
        self._seed = seed
        self._count = 0  # number of samples drawn so far
        self._occurrences: Counter[tuple[str, str]] = Counter()
        self._truths: list[tuple[str, Effect, RunningEffect]] = []
        self._temperature: NoiseSeries | None = None
        if temperature_c is not None:
            self._temperature = recorded_temperature(temperature_c)
        elif temperature is not None:
            self._temperature = temperature.start_series(self._true_hz, self._rng("temperature", "", 0))
        self._axes = {axis: _AxisSimulator() for axis in AXES}
        for axis, effects in self._effects.items():
            for effect in effects:
                self._begin(axis, effect)

    def draw_samples(self, n: int) -> Floats:
        """Return the next ``n`` samples [n, 6] in rad/s and m/s²."""
        return self.draw_samples_with_temperature(n).values

    def draw_samples_with_temperature(self, n: int) -> SimulatedSamples:
        """Return the next ``n`` samples with their temperature."""
        drawn = SimulatedSamples(np.empty((n, len(AXES))), np.full(n, np.nan))
        for begin in range(0, n, PIECE_SAMPLES):
            piece = slice(begin, min(begin + PIECE_SAMPLES, n))
            self._advance(drawn.values[piece], drawn.temperature_c[piece])
        return drawn

    def add_effect(self, axis: str, effect: Effect) -> None:
        """Add an effect that begins at the next sample.

        A parameter ``time`` counts from the first sample of the stream. A random walk, a ramp or a transient begins at
        zero.

        Parameters
        ----------
        axis : str
            Name of the axis.
        effect : Effect
            Effect to add.

        Raises
        ------
        ConfigError
            If the effect cannot be on that axis, at that rate, or in a running stream (a sample rate error).
        """
        if axis not in AXES:
            raise ConfigError(f'unknown axis "{axis}"{format_suggestion(axis, AXES)}')
        if isinstance(effect, SampleRateError):
            raise ConfigError(f"{axis}.{effect.name}: the sample rate error of a running stream cannot change")
        with prefix_config_errors(f"{axis}.{effect.name}"):
            effect.check_axis(axis)
        effects = self._effects | {axis: (*self._effects[axis], effect)}
        check_effects_can_be_simulated(effects, self._true_hz, self._temperature is not None)
        self._effects = effects
        self._begin(axis, effect)

    def drawn_random_values(self) -> dict[str, dict[str, list[dict[str, Any]]]]:
        """Return the values that have been drawn at random so far, by axis and name of the effect.

        The list of an effect has one dictionary for each occurrence of the effect on the axis. The values are phases,
        numbers of events, and times in seconds from the start, ready for JSON. Effects that their parameters describe
        completely are left out.
        """
        truths: dict[str, dict[str, list[dict[str, Any]]]] = {}
        for axis, effect, running in self._truths:
            if truth := running.drawn_random_values():
                truths.setdefault(axis, {}).setdefault(effect.name, []).append(truth)
        return truths

    def _begin(self, axis: str, effect: Effect) -> None:
        """Start an effect on an axis."""
        occurrence = self._occurrences[axis, effect.name]
        self._occurrences[axis, effect.name] += 1
        line = self._axes[axis]
        if isinstance(effect, Source):
            series = effect.start_series(self._true_hz, self._rng(axis, effect.name, occurrence))
            (line.white if isinstance(effect, AngleRandomWalk) else line.others).append(series)
            self._truths.append((axis, effect, series))
        elif isinstance(effect, NoiseStep):
            line.steps.append((first_sample_at_or_after(effect.time, self._true_hz), effect.ratio))
        elif isinstance(effect, AxisLeak):
            line.add_leak(effect)
            self._axes[effect.source].leaks_out = True
        elif isinstance(effect, Transform):
            with prefix_config_errors(f"{axis}.{effect.name}"):
                running = effect.start_transform(self._true_hz, self._rng(axis, effect.name, occurrence))
            line.insert_transform(TRANSFORM_ORDER.index(type(effect)), running)
            self._truths.append((axis, effect, running))
        else:
            raise TypeError(f"{effect.name} is not a source, leak, noise step or transform")

    def _rng(self, axis: str, effect: str, occurrence: int) -> np.random.Generator:
        """Return the random generator of one effect."""
        key = (crc32(axis.encode()), crc32(effect.encode()), occurrence)
        return np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=key))

    def _advance(self, values: Floats, temperature_c: Floats) -> None:
        """Simulate the next piece of all axes into ``values`` [n, 6] and ``temperature_c`` [n]."""
        n = temperature_c.size
        block = SampleBlockContext(self._count, temperature_c, np.empty(n))
        if self._temperature is not None:
            temperature_c[:] = 0.0
            self._temperature.add_next_samples(temperature_c, block)
        sums = {axis: line.sum_own_sources(block, n) for axis, line in self._axes.items()}
        alone = {
            axis: line.transform_without_leaks(sums[axis])
            for axis, line in self._axes.items()
            if line.needs_leak_free_measurement
        }
        for column, (axis, line) in enumerate(self._axes.items()):
            values[:, column] = line.add_leaks_and_transform(sums[axis], alone)
        self._count += n


class _AxisSimulator:
    """Running effects of one axis."""

    def __init__(self) -> None:
        self.white: list[NoiseSeries] = []
        self.others: list[NoiseSeries] = []
        self.steps: list[tuple[int, float]] = []  # (index of the first sample, ratio)
        self.leaks: list[AxisLeak] = []
        self.leaks_out = False
        # Transforms with their positions in TRANSFORM_ORDER, sorted.
        self._chain: list[tuple[int, RunningTransform]] = []
        # Copies of the transforms for the measurement without leaks, if other axes leak into this axis.
        self._alone: list[tuple[int, RunningTransform]] = []

    @property
    def needs_leak_free_measurement(self) -> bool:
        """True if the measurement without leaks is needed. Transforms with a memory need the measurement in every
        piece."""
        return self.leaks_out or bool(self.leaks)

    def insert_transform(self, order: int, transform: RunningTransform) -> None:
        """Insert a transform after the others at its position in TRANSFORM_ORDER."""
        if self.leaks:
            self._alone.append((order, copy.deepcopy(transform)))
            self._alone.sort(key=lambda one: one[0])
        self._chain.append((order, transform))
        self._chain.sort(key=lambda one: one[0])

    def add_leak(self, leak: AxisLeak) -> None:
        """Add a leak into this axis. From the next sample, the measurements with and without leaks differ."""
        if not self.leaks:
            self._alone = copy.deepcopy(self._chain)
        self.leaks.append(leak)

    def sum_own_sources(self, block: SampleBlockContext, n: int) -> Floats:
        """Return the sum [n] of the axis' own sources."""
        values = np.zeros(n)
        for series in self.white:
            series.add_next_samples(values, block)
        for first, ratio in self.steps:
            values[max(0, first - block.first) :] *= ratio
        for series in self.others:
            series.add_next_samples(values, block)
        return values

    def transform_without_leaks(self, own_sum: Floats) -> Floats:
        """Return the measurement without leaks. If nothing leaks into the axis, ``own_sum`` is changed in place."""
        if not self.leaks:
            return _apply_transforms(self._chain, own_sum)
        return _apply_transforms(self._alone, own_sum.copy())

    def add_leaks_and_transform(self, own_sum: Floats, leak_free: dict[str, Floats]) -> Floats:
        """Return the measurement of the axis with the leaks from other axes."""
        if self.leaks:
            for leak in self.leaks:
                own_sum += leak.coefficient * leak_free[leak.source]
        elif self.leaks_out:
            return own_sum  # already transformed by ``transform_without_leaks``
        return _apply_transforms(self._chain, own_sum)


def _apply_transforms(chain: list[tuple[int, RunningTransform]], values: Floats) -> Floats:
    """Apply all transforms to the values in place, and return the values."""
    for _, running in chain:
        running.transform_in_place(values)
    return values
