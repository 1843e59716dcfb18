"""NoiseModel: the effects of each axis, added; from TOML and back, and as an endless simulated series.

A model file has ``sample_rate`` (Hz) and one table an axis, in it one table an effect, or an array of
tables where an effect occurs twice; ``g*`` and ``a*`` stand for all axes of a kind. What is wrong in
it is a ConfigError of one line that names the place and the nearest known word.

Every effect of every axis draws from its own random generator, seeded by the model's seed and the
names of axis and effect: adding or leaving out an effect changes no other series.
"""

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from itertools import count
from typing import Any, Final
from zlib import crc32

import numpy as np

from drivers.errors import ConfigError
from drivers.plugin import nearest
from drivers.sample import AXES, Floats
from monitor.noise.effect import Series, Source
from monitor.noise.effects import EFFECTS

WILDCARDS: Final = {"g*": AXES[:3], "a*": AXES[3:]}


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Sources that add, per axis; an axis that is not named has none.

    >>> from monitor.noise.effects import AngleRandomWalk, Bias
    >>> model = NoiseModel({"gz": (AngleRandomWalk(N=1e-4),)}) + NoiseModel({"gz": (Bias(value=0.1),)})
    >>> [source.name for source in model.sources["gz"]]
    ['angle_random_walk', 'bias']
    >>> float(model.avar("gz", np.array([4.0]), 0.01)[0])
    2.5e-09
    """

    sources: Mapping[str, tuple[Source, ...]] = field(default_factory=dict)
    sample_rate_hz: float | None = None

    def __post_init__(self) -> None:
        for axis in self.sources:
            if axis not in AXES:
                raise ConfigError(f'unknown axis "{axis}"{nearest(axis, AXES)}')

    def __add__(self, other: "NoiseModel") -> "NoiseModel":
        """All sources of both; the sample rate of the first that has one."""
        if not isinstance(other, NoiseModel):
            return NotImplemented
        added = {
            axis: self.sources.get(axis, ()) + other.sources.get(axis, ())
            for axis in AXES
            if axis in self.sources or axis in other.sources
        }
        return NoiseModel(added, self.sample_rate_hz or other.sample_rate_hz)

    def avar(self, axis: str, tau_s: Floats, tau0_s: float) -> Floats:
        """Allan variance of one axis, unit², of samples ``tau0_s`` apart."""
        parts = [source.avar(tau_s, tau0_s) for source in self.sources.get(axis, ())]
        return np.asarray(sum(parts, np.zeros_like(tau_s)))

    def psd(self, axis: str, f_hz: Floats, tau0_s: float) -> Floats:
        """Two-sided spectrum of one axis, unit²/Hz, up to half the sample rate."""
        parts = [source.psd(f_hz, tau0_s) for source in self.sources.get(axis, ())]
        return np.asarray(sum(parts, np.zeros_like(f_hz)))

    def stream(self, rate_hz: float, seed: int) -> "ModelStream":
        """Begin an endless series of six axes; the same for the same rate and seed."""
        return ModelStream(self, rate_hz, seed)

    def simulate(self, n: int, rate_hz: float, seed: int) -> Floats:
        """The first ``n`` samples [n, 6] of ``stream``."""
        return self.stream(rate_hz, seed).draw(n)

    @classmethod
    def from_toml(cls, text: str) -> "NoiseModel":
        """Read a model file's text; ConfigError says in one line what is wrong with it."""
        try:
            tables = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise ConfigError(f"not TOML: {error}") from error
        rate_hz = tables.pop("sample_rate", None)
        if rate_hz is not None and (
            isinstance(rate_hz, bool) or not isinstance(rate_hz, int | float) or not 0.0 < rate_hz < np.inf
        ):
            raise ConfigError(f"sample_rate must be a positive number of Hz, is {rate_hz!r}")
        model = cls(sample_rate_hz=None if rate_hz is None else float(rate_hz))
        for key, effects in tables.items():
            sources = tuple(_sources(key, effects))
            model += cls(dict.fromkeys(WILDCARDS.get(key, (key,)), sources))
        return model

    def to_toml(self) -> str:
        """The model as text that ``from_toml`` reads back to an equal model."""
        lines = [] if self.sample_rate_hz is None else [f"sample_rate = {self.sample_rate_hz!r}"]
        for axis, sources in self.sources.items():
            names = [source.name for source in sources]
            if not sources:
                lines += ["", f"[{axis}]"]
            for source in sources:
                bracket = "[[{}]]" if names.count(source.name) > 1 else "[{}]"
                lines += ["", bracket.format(f"{axis}.{source.name}")]
                lines += [f"{name} = {value!r}" for name, value in _parameters(source)]
        return "\n".join(lines).lstrip() + "\n"


class ModelStream:
    """A model's series, drawn in blocks of any size; axes without sources are zero."""

    def __init__(self, model: NoiseModel, rate_hz: float, seed: int) -> None:
        self._series = {
            AXES.index(axis): list(_start(axis, sources, rate_hz, seed)) for axis, sources in model.sources.items()
        }

    def draw(self, n: int) -> Floats:
        """The next ``n`` samples [n, 6] in rad/s and m/s²."""
        values = np.zeros((n, len(AXES)))
        for column, series in self._series.items():
            for one in series:
                values[:, column] += one.draw(n)
        return values


def _start(axis: str, sources: tuple[Source, ...], rate_hz: float, seed: int) -> Iterator[Series]:
    occurrences = {source.name: count() for source in sources}
    for source in sources:
        key = (crc32(axis.encode()), crc32(source.name.encode()), next(occurrences[source.name]))
        yield source.start(rate_hz, np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key)))


def _parameters(source: Source) -> Iterator[tuple[str, float]]:
    for f in fields(source):  # type: ignore[arg-type]
        yield f.name, float(getattr(source, f.name))


def _sources(axis: str, effects: Any) -> Iterator[Source]:
    known = (*AXES, *WILDCARDS)
    if axis not in known:
        raise ConfigError(f'unknown axis "{axis}"{nearest(axis, known)}')
    if not isinstance(effects, dict):
        raise ConfigError(f"{axis} must be a table of effects, such as [{axis}.angle_random_walk]")
    for name, given in effects.items():
        if name not in EFFECTS:
            raise ConfigError(f'{axis}: unknown effect "{name}"{nearest(name, tuple(EFFECTS))}')
        for parameters in given if isinstance(given, list) else [given]:
            yield _source(f"{axis}.{name}", EFFECTS[name], parameters)


def _source(place: str, effect: type[Source], parameters: Any) -> Source:
    known = tuple(f.name for f in fields(effect))  # type: ignore[arg-type]
    if not isinstance(parameters, dict):
        raise ConfigError(f"{place} must be a table with {', '.join(known)}")
    for name in parameters:
        if name not in known:
            raise ConfigError(f'{place}: unknown parameter "{name}"{nearest(name, known)}')
    for name in known:
        if name not in parameters:
            raise ConfigError(f"{place}: {name} is missing")
    try:
        return effect(**parameters)
    except ConfigError as error:
        raise ConfigError(f"{place}: {str(error).removeprefix(effect.name + ': ')}") from error
