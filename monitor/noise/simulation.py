"""Simulate samples according to a noise model.

Samples can be simulated in blocks of any size, and the block sizes do not affect the samples. For each axis, the
sources are added first, and low-pass filters are applied to the sum. The leaks from other axes, which are already
filtered, are then added, and the other transforms are applied. All effects are simulated at the true sample rate.

Each effect has a separate random generator, so adding or removing an effect does not change the random numbers of other
effects. The seed of a generator is derived from the seed of the simulation, the axis, the effect name, and the number
of preceding effects of that name. Common vibrations with the same source number have the same seed on all axes.
"""

import copy
from bisect import insort
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, Final
from zlib import crc32

import numpy as np

from drivers.data_types import AXES, Floats
from drivers.errors import ConfigError
from drivers.validation.module_lookup import format_suggestion
from monitor.noise.effect import (
    AxisLeak,
    Effect,
    RunningGain,
    RunningSource,
    RunningTransform,
    SampleBlockContext,
    Source,
    Transform,
    WhiteNoiseGain,
)
from monitor.noise.effects import TRANSFORM_ORDER
from monitor.noise.effects.coupling.axis_permutation import AxisPermutation
from monitor.noise.effects.disturbances.common_vibration import CommonVibration
from monitor.noise.effects.disturbances.heavy_tails import HeavyTails
from monitor.noise.effects.ieee952.angle_random_walk import AngleRandomWalk
from monitor.noise.effects.signal_chain.sample_rate_error import SampleRateError
from monitor.noise.model_toml import prefix_config_errors
from monitor.noise.temperature import Temperature, recorded_temperature

PIECE_SAMPLES: Final = 2048
"""Number of samples that are simulated at a time. The arrays of six axes then fit into the processor cache."""


@dataclass(frozen=True, slots=True)
class SimulatedSamples:
    """Simulated samples and temperatures."""

    values: Floats  # [n, 6] samples in the order of AXES, rad/s and m/s²
    temperature_c: Floats  # [n] temperature, °C; NaN if there is none


def check_effects_can_be_simulated(
    axis_effects: Mapping[str, tuple[Effect, ...]], true_rate_hz: float, has_temperature: bool
) -> None:
    """Check that the effects of a noise model can be simulated.

    Parameters
    ----------
    axis_effects : mapping of str to tuple of Effect
        Effects of each axis.
    true_rate_hz : float
        True sample rate, Hz.
    has_temperature : bool
        True if the model or a recording provides a temperature.

    Raises
    ------
    ConfigError
        If a frequency is too high for the sample rate, or if an effect requires a temperature or another effect that is
        missing.
    """
    for axis in AXES:
        effects = axis_effects.get(axis, ())
        for effect in effects:
            with prefix_config_errors(f"{axis}.{effect.name}"):
                effect.check_rate(true_rate_hz)
                if isinstance(effect, AxisLeak) and not axis_effects.get(effect.source):
                    raise ConfigError(f"the model has no effect on its source {effect.source}")
                if isinstance(effect, WhiteNoiseGain | HeavyTails) and not any(
                    isinstance(one, AngleRandomWalk) for one in effects
                ):
                    raise ConfigError(f"{axis} has no angle_random_walk to multiply")
                if isinstance(effect, Source) and effect.uses_temperature and not has_temperature:
                    raise ConfigError(
                        "no temperature: the model has no table [temperature], and no recording provides one"
                    )


class ModelStream:
    """Endless simulation of six axes, in which axes without effects are zero.

    Parameters
    ----------
    axis_effects : mapping of str to tuple of Effect
        Effects of each axis.
    temperature : Temperature or None
        Simulated temperature.
    rate_hz : float
        Stated sample rate, Hz.
    true_to_stated_rate_ratio : float
        Ratio of the true sample rate to the stated sample rate.
    seed : int
        Seed of the random generators.
    temperature_c : ndarray, shape (n,), or None
        Temperature of a recording in °C, which replaces the simulated temperature.

    Raises
    ------
    ConfigError
        If the effects cannot be simulated at the sample rate.
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
        self._count = 0  # number of samples that have been simulated so far
        self._occurrences: Counter[tuple[str, str]] = Counter()
        self._truths: list[tuple[str, Effect, Callable[[], dict[str, Any]]]] = []
        self._temperature: RunningSource | None = None
        if temperature_c is not None:
            self._temperature = recorded_temperature(temperature_c)
        elif temperature is not None:
            self._temperature = temperature.start_series(self._true_hz, self._rng("temperature", "", 0))
        self._columns = list(range(len(AXES)))  # for each axis of the output, the index of the measured axis
        self._axes = {axis: _AxisSimulator() for axis in AXES}
        for axis, effects in self._effects.items():
            for effect in effects:
                self._begin(axis, effect)

    def draw_next_samples(self, n: int) -> Floats:
        """Return the next n samples [n, 6] in rad/s and m/s²."""
        return self.draw_samples_with_temperature(n).values

    def draw_samples_with_temperature(self, n: int) -> SimulatedSamples:
        """Return the next n samples and temperatures."""
        drawn = SimulatedSamples(np.empty((n, len(AXES))), np.full(n, np.nan))
        for begin in range(0, n, PIECE_SAMPLES):
            piece = slice(begin, min(begin + PIECE_SAMPLES, n))
            self._advance(drawn.values[piece], drawn.temperature_c[piece])
        return drawn

    def add_effect(self, axis: str, effect: Effect) -> None:
        """Add an effect that starts with the next sample.

        Random walks, ramps and transients also start with the next sample. The parameter ``time`` of an effect is
        measured from the first sample of the simulation.

        Parameters
        ----------
        axis : str
            Name of the axis.
        effect : Effect
            Effect to add.

        Raises
        ------
        ConfigError
            If the effect cannot be applied to the axis, at the sample rate, or during a simulation.
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
        """Return the random values that have been drawn so far, by axis and name of the effect.

        For each occurrence of an effect, a dictionary contains phases, numbers of events and event times in seconds.
        All values can be converted to JSON. Effects without random values are omitted.
        """
        truths: dict[str, dict[str, list[dict[str, Any]]]] = {}
        for axis, effect, drawn_random_values in self._truths:
            if truth := drawn_random_values():
                truths.setdefault(axis, {}).setdefault(effect.name, []).append(truth)
        return truths

    def _begin(self, axis: str, effect: Effect) -> None:
        occurrence = self._occurrences[axis, effect.name]
        self._occurrences[axis, effect.name] += 1
        line = self._axes[axis]
        if isinstance(effect, Source):
            key = axis, occurrence
            if isinstance(effect, CommonVibration):
                key = "", int(effect.source_number)
            series = effect.start_series(self._true_hz, self._rng(key[0], effect.name, key[1]))
            (line.white if isinstance(effect, AngleRandomWalk) else line.others).append(series)
            self._truths.append((axis, effect, series.drawn_random_values))
        elif isinstance(effect, WhiteNoiseGain | HeavyTails):
            gain = effect.start_gain(self._true_hz, self._rng(axis, effect.name, occurrence))
            line.gains.append(gain)
            self._truths.append((axis, effect, gain.drawn_random_values))
        elif isinstance(effect, AxisPermutation):
            self._columns[AXES.index(axis)] = AXES.index(effect.source)
        elif isinstance(effect, AxisLeak):
            line.add_leak(effect)
            self._axes[effect.source].leaks_out = True
        elif isinstance(effect, Transform):
            with prefix_config_errors(f"{axis}.{effect.name}"):
                running = effect.start_transform(self._true_hz, self._rng(axis, effect.name, occurrence))
            if effect.precedes_leaks:
                line.filters.append(running)
            else:
                line.insert_transform(TRANSFORM_ORDER.index(type(effect)), running)
            self._truths.append((axis, effect, running.drawn_random_values))
        else:
            raise TypeError(f"{effect.name} is not a source, leak, transform, permutation or change of the white noise")

    def _rng(self, axis: str, effect: str, occurrence: int) -> np.random.Generator:
        key = (crc32(axis.encode()), crc32(effect.encode()), occurrence)
        return np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=key))

    def _advance(self, values: Floats, temperature_c: Floats) -> None:
        """Simulate the next samples, and write them to ``values`` [n, 6] and ``temperature_c`` [n]."""
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
        if self._columns != list(range(len(AXES))):
            values[:] = values[:, self._columns]
        self._count += n


class _AxisSimulator:
    """Simulates the effects on one axis."""

    def __init__(self) -> None:
        self.white: list[RunningSource] = []
        self.others: list[RunningSource] = []
        self.gains: list[RunningGain] = []  # gains of the white noise
        self.filters: list[RunningTransform] = []  # low-pass filters, in the order of the model
        self.leaks: list[AxisLeak] = []
        self.leaks_out = False
        # These are the other transforms and their positions in TRANSFORM_ORDER, sorted by position.
        self._chain: list[tuple[int, RunningTransform]] = []
        # Copies of the transforms are needed to compute the measurement without leaks.
        self._alone: list[tuple[int, RunningTransform]] = []

    @property
    def needs_leak_free_measurement(self) -> bool:
        """True if the measurement without leaks must be computed.

        If a transform has memory, the measurement without leaks must be computed for every block.
        """
        return self.leaks_out or bool(self.leaks)

    def insert_transform(self, order: int, transform: RunningTransform) -> None:
        """Insert a transform that has the position ``order`` in TRANSFORM_ORDER."""
        if self.leaks:
            insort(self._alone, (order, copy.deepcopy(transform)), key=itemgetter(0))
        insort(self._chain, (order, transform), key=itemgetter(0))

    def add_leak(self, leak: AxisLeak) -> None:
        """Add a leak from another axis."""
        if not self.leaks:
            self._alone = copy.deepcopy(self._chain)
        self.leaks.append(leak)

    def sum_own_sources(self, block: SampleBlockContext, n: int) -> Floats:
        """Return the filtered sum [n] of the sources of the axis.

        White noise is added first, because gains multiply only the white noise.
        """
        values = np.zeros(n)
        for series in self.white:
            series.add_next_samples(values, block)
        for gain in self.gains:
            values *= gain.compute_gain(block.first, n)
        for series in self.others:
            series.add_next_samples(values, block)
        for running in self.filters:
            running.transform_in_place(values)
        return values

    def transform_without_leaks(self, own_sum: Floats) -> Floats:
        """Return the measurement without leaks. If the axis has no leaks, ``own_sum`` is modified in place."""
        if not self.leaks:
            return _apply_transforms(self._chain, own_sum)
        return _apply_transforms(self._alone, own_sum.copy())

    def add_leaks_and_transform(self, own_sum: Floats, leak_free: dict[str, Floats]) -> Floats:
        """Return the measurement of the axis, including leaks from other axes."""
        if self.leaks:
            for leak in self.leaks:
                own_sum += leak.coefficient * leak_free[leak.source]
        elif self.leaks_out:
            return own_sum  # ``transform_without_leaks`` has already transformed the sum
        return _apply_transforms(self._chain, own_sum)


def _apply_transforms(chain: list[tuple[int, RunningTransform]], values: Floats) -> Floats:
    """Apply all transforms to the values in place, and return the values."""
    for _, running in chain:
        running.transform_in_place(values)
    return values
