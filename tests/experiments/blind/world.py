"""Simulated sensor of a blind trial: its effects, its recording and its model file.

The series of all sources of an axis are added. The measurement of another axis may leak into the sum. The transforms
then act on the sum in a fixed order. The series of an effect depends on the seed, the axis, the name and the occurrence
of the name, so a hidden effect does not change other series. With a clock error, the samples are simulated at the true
rate, and the file contains only the stated rate.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from tests.experiments.blind import foreign
from tests.experiments.blind.processes import (
    SOURCES,
    TRANSFORMS,
    Clock,
    Floats,
    generator,
    heavy_tails,
    modulated,
    wandering_gain,
    white,
)

AXES: Final = ("gx", "gy", "gz", "ax", "ay", "az")
LEAKS: Final = ("g_sensitivity", "cross_axis")
THERMOMETER_NOISE_C: Final = 0.01  # white noise of the recorded temperature


@dataclass(frozen=True)
class Effect:
    """Effect on one axis, with its name and parameters."""

    axis: str
    name: str
    parameters: Mapping[str, Any]

    def sized(self, **parameters: Any) -> "Effect":
        """Return the effect with other values of some parameters."""
        return replace(self, parameters={**self.parameters, **parameters})


@dataclass(frozen=True)
class ForeignEffect:
    """Effect that no name stands for. Its size is in units of the white noise of a sample."""

    axis: str
    name: str
    size: float = 1.0


@dataclass(frozen=True)
class TemperatureProfile:
    """Temperature that consists of a warm-up, a sine and exponentially correlated noise."""

    warm_up_c: float
    warm_up_time_s: float
    swing_c: float
    period_s: float
    wander_c: float
    wander_time_s: float

    def draw(self, clock: Clock, rng: np.random.Generator) -> Floats:
        """Return the true temperature [n] in °C."""
        t = clock.t_s
        wander = SOURCES["exponentially_correlated"](clock, rng, self.wander_c, self.wander_time_s)
        swing = self.swing_c * np.sin(2.0 * np.pi * t / self.period_s + rng.uniform(0.0, 2.0 * np.pi))
        return 25.0 - self.warm_up_c * np.exp(-t / self.warm_up_time_s) + swing + wander


@dataclass
class World:
    """Simulated sensor with its rate, axes, effects and temperature."""

    seed: int
    seconds: float
    rate_hz: float  # stated rate
    axes: tuple[str, ...]
    baseline: tuple[Effect, ...]
    bias: Mapping[str, float]
    hidden: tuple[Effect, ...] = ()
    foreign_effects: tuple[ForeignEffect, ...] = ()
    temperature_profile: TemperatureProfile | None = None
    _cache: dict[Any, Floats] = field(default_factory=dict, repr=False)

    @property
    def true_hz(self) -> float:
        """True sample rate in Hz."""
        ratios = [
            effect.parameters["ratio"]
            for effect in (*self.baseline, *self.hidden)
            if effect.name == "sample_rate_error"
        ]
        return self.rate_hz * (ratios[0] if ratios else 1.0)

    def clock(self) -> Clock:
        """Return the clock of the recording with the true temperature."""
        clock = Clock(round(self.seconds * self.rate_hz), self.true_hz)
        if self.temperature_profile is None:
            return clock
        key = ("temperature", clock.rate_hz)
        if key not in self._cache:
            self._cache[key] = self.temperature_profile.draw(clock, generator(self.seed, "temperature"))
        return replace(clock, temperature_c=self._cache[key])

    def effects_on(self, axis: str) -> list[Effect]:
        """Return the baseline effects and hidden effects of an axis."""
        return [effect for effect in (*self.baseline, *self.hidden) if effect.axis == axis]

    def with_hidden(self, *hidden: Effect) -> "World":
        """Return the sensor with other hidden effects and the same random numbers."""
        return replace(self, hidden=hidden)

    def noise(self, axis: str) -> float:
        """Return the standard deviation of the white noise of a sample."""
        return float(self.term(axis, "angle_random_walk", "N")) * float(np.sqrt(self.rate_hz))

    def term(self, axis: str, name: str, parameter: str) -> float:
        """Return a parameter of an effect on an axis, or 0 without such an effect."""
        sizes = [effect.parameters[parameter] for effect in self.effects_on(axis) if effect.name == name]
        return float(sum(sizes))

    def series(self, effect: Effect, occurrence: int = 0) -> Floats:
        """Return the series [n] of one source. Series of the baseline are cached."""
        clock = self.clock()
        key = (effect.axis, effect.name, occurrence, tuple(sorted(effect.parameters.items())), clock.rate_hz)
        if key in self._cache:
            return self._cache[key]
        values = SOURCES[effect.name](
            clock, generator(self.seed, effect.axis, effect.name, occurrence), **effect.parameters
        )
        if effect in self.baseline:
            self._cache[key] = values
        return values

    def sum_sources(self, axis: str) -> Floats:
        """Return the sum [n] of the sources of an axis."""
        values = np.full(self.clock().n, self.bias[axis])
        occurrences: Counter[str] = Counter()
        for effect in self.effects_on(axis):
            if effect.name not in SOURCES:
                continue
            series = self.series(effect, occurrences[effect.name])
            occurrences[effect.name] += 1
            values += series * self._noise_factor(axis) if effect.name == "angle_random_walk" else series
        for unnamed in self.foreign_effects:
            if unnamed.axis == axis and unnamed.name in foreign.SERIES:
                rng = generator(self.seed, axis, unnamed.name)
                values += foreign.SERIES[unnamed.name](self.clock(), rng, unnamed.size * self.noise(axis))
        return values

    def _noise_factor(self, axis: str) -> Floats | float:
        """Return the factor on the white noise of an axis, as a series [n] or a constant."""
        level: Floats | float = 1.0
        clock = self.clock()
        for effect in self.effects_on(axis):
            if effect.name == "noise_step":
                level = level * np.where(clock.t_s >= effect.parameters["time"], effect.parameters["ratio"], 1.0)
            elif effect.name == "variance_modulation":
                level = level * np.sqrt(modulated(clock, **effect.parameters))
            elif effect.name == "wandering_variance":
                level = level * wandering_gain(clock, generator(self.seed, axis, effect.name), **effect.parameters)
            elif effect.name == "heavy_tails":
                level = level * heavy_tails(clock, generator(self.seed, axis, effect.name), **effect.parameters)
        for unnamed in self.foreign_effects:
            if unnamed.axis == axis and unnamed.name in foreign.LEVELS:
                level = level * foreign.LEVELS[unnamed.name](clock, generator(self.seed, axis, unnamed.name))
        return level

    def _transformed(self, axis: str, values: Floats) -> Floats:
        chain = sorted(
            (effect for effect in self.effects_on(axis) if effect.name in TRANSFORMS),
            key=lambda effect: list(TRANSFORMS).index(effect.name),
        )
        for effect in chain:
            rng = generator(self.seed, axis, effect.name)
            values = TRANSFORMS[effect.name](values, self.true_hz, rng, **effect.parameters)
        return values

    def alone(self, axis: str) -> Floats:
        """Return the measurement [n] of an axis without leaks from other axes."""
        return self._transformed(axis, self.sum_sources(axis))

    def measured(self, axis: str) -> Floats:
        """Return the measurement [n] of an axis."""
        values = self.sum_sources(axis)
        for effect in self.effects_on(axis):
            if effect.name in LEAKS:
                values = values + effect.parameters["coefficient"] * self.alone(effect.parameters["source"])
        return self._transformed(axis, values)

    def recording(self) -> dict[str, Floats]:
        """Return the columns of the recording."""
        columns = {axis: self.measured(axis) for axis in self.axes}
        clock = self.clock()
        if clock.temperature_c is not None:
            error = white(clock.n, generator(self.seed, "thermometer"))
            columns["temperature"] = clock.temperature_c + THERMOMETER_NOISE_C * error
        return columns


def model_text(effects: tuple[Effect, ...], rate_hz: float) -> str:
    """Return the text of a model file. It contains no phases and delays, which no data sheet lists."""
    tables = [f"sample_rate = {rate_hz!r}\n"]
    times = Counter((effect.axis, effect.name) for effect in effects)
    for effect in effects:
        head = f"{effect.axis}.{effect.name}"
        lines = [f"[[{head}]]" if times[effect.axis, effect.name] > 1 else f"[{head}]"]
        for name, value in effect.parameters.items():
            if name not in ("phase", "delay"):
                lines.append(f'{name} = "{value}"' if isinstance(value, str) else f"{name} = {value!r}")
        tables.append("\n".join(lines) + "\n")
    return "\n".join(tables)
