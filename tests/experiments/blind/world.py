"""A sensor: what its axes hold, how they are drawn, and the model file that tells of it.

Sources of an axis add; another axis, as it reads by itself, may leak in; transforms act on the sum in their order.
The series of one effect depends on the seed, its axis, its name and which of that name it is, so hidden effects
change nothing else. A clock error makes everything at its true rate and leaves only the stated one in the file.
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
    white,
)

AXES: Final = ("gx", "gy", "gz", "ax", "ay", "az")
LEAKS: Final = ("g_sensitivity", "cross_axis")
THERMOMETER_C: Final = 0.01  # white noise of the recorded temperature


@dataclass(frozen=True)
class Effect:
    """One effect on one axis; what it is called and how large it is."""

    axis: str
    name: str
    parameters: Mapping[str, Any]

    def sized(self, **parameters: Any) -> "Effect":
        """The same with other parameters."""
        return replace(self, parameters={**self.parameters, **parameters})


@dataclass(frozen=True)
class Foreign:
    """One effect outside the vocabulary; its size in units of the white noise of a sample."""

    axis: str
    name: str
    size: float = 1.0


@dataclass(frozen=True)
class Climate:
    """A temperature: a warm-up, a swing, and first-order wander."""

    warm_c: float
    warm_time_s: float
    swing_c: float
    period_s: float
    wander_c: float
    wander_time_s: float

    def draw(self, clock: Clock, rng: np.random.Generator) -> Floats:
        """[n] °C, as it is."""
        t = clock.t_s
        wander = SOURCES["exponentially_correlated"](clock, rng, self.wander_c, self.wander_time_s)
        swing = self.swing_c * np.sin(2.0 * np.pi * t / self.period_s + rng.uniform(0.0, 2.0 * np.pi))
        return 25.0 - self.warm_c * np.exp(-t / self.warm_time_s) + swing + wander


@dataclass
class World:
    """All that a recording is made of."""

    seed: int
    seconds: float
    rate_hz: float  # as stated
    axes: tuple[str, ...]
    baseline: tuple[Effect, ...]
    bias: Mapping[str, float]
    hidden: tuple[Effect, ...] = ()
    strangers: tuple[Foreign, ...] = ()
    climate: Climate | None = None
    _cache: dict[Any, Floats] = field(default_factory=dict, repr=False)

    @property
    def true_hz(self) -> float:
        """The rate at which samples are really taken."""
        ratios = [
            effect.parameters["ratio"]
            for effect in (*self.baseline, *self.hidden)
            if effect.name == "sample_rate_error"
        ]
        return self.rate_hz * (ratios[0] if ratios else 1.0)

    def clock(self) -> Clock:
        """Of the recording, with the temperature as it is."""
        bare = Clock(round(self.seconds * self.rate_hz), self.true_hz)
        if self.climate is None:
            return bare
        key = ("temperature", bare.rate_hz)
        if key not in self._cache:
            self._cache[key] = self.climate.draw(bare, generator(self.seed, "temperature"))
        return replace(bare, temperature_c=self._cache[key])

    def on(self, axis: str) -> list[Effect]:
        """Baseline and hidden effects of an axis."""
        return [effect for effect in (*self.baseline, *self.hidden) if effect.axis == axis]

    def with_hidden(self, *hidden: Effect) -> "World":
        """Another of the same draws."""
        return replace(self, hidden=hidden)

    def noise(self, axis: str) -> float:
        """Standard deviation of the white noise of a sample."""
        return float(self.term(axis, "angle_random_walk", "N")) * float(np.sqrt(self.rate_hz))

    def term(self, axis: str, name: str, parameter: str) -> float:
        """A size of the baseline or hidden; 0 without it."""
        sizes = [effect.parameters[parameter] for effect in self.on(axis) if effect.name == name]
        return float(sum(sizes))

    def series(self, effect: Effect, occurrence: int = 0) -> Floats:
        """[n] of one source; those of the baseline are kept."""
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

    def own(self, axis: str) -> Floats:
        """[n] sum of the axis' own sources."""
        values = np.full(self.clock().n, self.bias[axis])
        seen: Counter[str] = Counter()
        for effect in self.on(axis):
            if effect.name not in SOURCES:
                continue
            series = self.series(effect, seen[effect.name])
            seen[effect.name] += 1
            values += series * self._level(axis) if effect.name == "angle_random_walk" else series
        for one in self.strangers:
            if one.axis == axis and one.name in foreign.SERIES:
                rng = generator(self.seed, axis, one.name)
                values += foreign.SERIES[one.name](self.clock(), rng, one.size * self.noise(axis))
        return values

    def _level(self, axis: str) -> Floats | float:
        """What the white noise is multiplied by."""
        level: Floats | float = 1.0
        clock = self.clock()
        for effect in self.on(axis):
            if effect.name == "noise_step":
                level = level * np.where(clock.t_s >= effect.parameters["time"], effect.parameters["ratio"], 1.0)
            elif effect.name == "variance_modulation":
                level = level * np.sqrt(modulated(clock, **effect.parameters))
            elif effect.name == "heavy_tails":
                level = level * heavy_tails(clock, generator(self.seed, axis, effect.name), **effect.parameters)
        for one in self.strangers:
            if one.axis == axis and one.name in foreign.LEVELS:
                level = level * foreign.LEVELS[one.name](clock, generator(self.seed, axis, one.name))
        return level

    def _transformed(self, axis: str, values: Floats) -> Floats:
        chain = sorted(
            (effect for effect in self.on(axis) if effect.name in TRANSFORMS),
            key=lambda effect: list(TRANSFORMS).index(effect.name),
        )
        for effect in chain:
            rng = generator(self.seed, axis, effect.name)
            values = TRANSFORMS[effect.name](values, self.true_hz, rng, **effect.parameters)
        return values

    def alone(self, axis: str) -> Floats:
        """[n] of an axis without what leaks into it."""
        return self._transformed(axis, self.own(axis))

    def measured(self, axis: str) -> Floats:
        """[n] of an axis."""
        values = self.own(axis)
        for effect in self.on(axis):
            if effect.name in LEAKS:
                values = values + effect.parameters["coefficient"] * self.alone(effect.parameters["source"])
        return self._transformed(axis, values)

    def recording(self) -> dict[str, Floats]:
        """Columns as in the file."""
        columns = {axis: self.measured(axis) for axis in self.axes}
        clock = self.clock()
        if clock.temperature_c is not None:
            error = white(clock.n, generator(self.seed, "thermometer"))
            columns["temperature"] = clock.temperature_c + THERMOMETER_C * error
        return columns


def model_text(effects: tuple[Effect, ...], rate_hz: float) -> str:
    """A model file. Phases are left out: no data sheet knows them."""
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
