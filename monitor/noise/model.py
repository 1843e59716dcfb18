"""NoiseModel: the effects of each axis, as one object that is fitted, simulated and compared.

Sources and leaks of an axis add; its transforms act on the sum in the order of ``ORDER``. ``avar`` and ``psd`` are
those of the whole axis: linear transforms and leaks included, closed forms where they exist and one integral where a
filter came in between. Where they depend on what a model does not hold (temperature, the length of a recording, where
between two steps a rate lies) they are NaN.

Text and back is in ``model_file``, time series are in ``stream``.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from drivers.discovery import nearest
from drivers.errors import ConfigError
from drivers.sample import AXES, Floats
from monitor.noise import model_file
from monitor.noise.effect import Effect, Leak, Source, Transform
from monitor.noise.effects import ORDER
from monitor.noise.effects.angle_random_walk import AngleRandomWalk
from monitor.noise.effects.noise_step import NoiseStep
from monitor.noise.effects.sample_rate_error import SampleRateError
from monitor.noise.spectrum import Spectrum, nothing, unknown
from monitor.noise.temperature import Temperature

if TYPE_CHECKING:
    from monitor.noise.simulation import ModelStream


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Effects of each axis; an axis that is not named has none.

    Args:
        effects: axis -> its effects
        sample_rate_hz: the rate to simulate at where nobody says another
        temperature: to simulate where no recording gives one
    Raises:
        ConfigError: unknown axis, an effect that cannot be on its axis, two different sample rate errors

    >>> from monitor.noise.effects import AngleRandomWalk, Bias
    >>> model = NoiseModel({"gz": (AngleRandomWalk(N=1e-4),)}) + NoiseModel({"gz": (Bias(value=0.1),)})
    >>> print(model)
    axis  effect             parameters
    gz    angle_random_walk  N = 0.0001 rad/√s
    gz    bias               value = 0.1 rad/s
    >>> float(model.avar("gz", np.array([4.0]), 0.01)[0])
    2.5e-09
    """

    effects: Mapping[str, tuple[Effect, ...]] = field(default_factory=dict)
    sample_rate_hz: float | None = None
    temperature: Temperature | None = None

    def __post_init__(self) -> None:
        for axis, effects in self.effects.items():
            if axis not in AXES:
                raise ConfigError(f'unknown axis "{axis}"{nearest(axis, AXES)}')
            for effect in effects:
                with model_file.placed(f"{axis}.{effect.name}"):
                    effect.check_axis(axis)
        ratios = sorted({effect.ratio for _, effect in self if isinstance(effect, SampleRateError)})
        if len(ratios) > 1:
            given = " and ".join(f"{ratio:g}" for ratio in ratios)
            raise ConfigError(f"sample_rate_error: a recording has one clock, but ratio is {given}")

    def __iter__(self) -> Iterator[tuple[str, Effect]]:
        """(axis, effect) of each effect, in the order of the axes."""
        for axis in AXES:
            for effect in self.effects.get(axis, ()):
                yield axis, effect

    def __add__(self, other: "NoiseModel") -> "NoiseModel":
        """All effects of both; sample rate and temperature of the first that has one."""
        if not isinstance(other, NoiseModel):
            return NotImplemented
        added = {
            axis: self.effects.get(axis, ()) + other.effects.get(axis, ())
            for axis in AXES
            if axis in self.effects or axis in other.effects
        }
        return NoiseModel(added, self.sample_rate_hz or other.sample_rate_hz, self.temperature or other.temperature)

    def __str__(self) -> str:
        return model_file.table(self)

    @property
    def sources(self) -> Mapping[str, tuple[Source, ...]]:
        """Of each axis the effects that add."""
        return {axis: tuple(e for e in effects if isinstance(e, Source)) for axis, effects in self.effects.items()}

    @property
    def rate_ratio(self) -> float:
        """True sample rate over the stated one."""
        return self._clock.ratio

    @property
    def _clock(self) -> SampleRateError:
        return next((e for _, e in self if isinstance(e, SampleRateError)), SampleRateError(ratio=1.0))

    # --- second moments

    def avar(self, axis: str, tau_s: Floats, tau0_s: float) -> Floats:
        """Overlapping Allan variance of one axis, unit², of samples stated to be ``tau0_s`` apart; NaN: not known."""
        return self.spectrum(axis, tau0_s).allan(np.asarray(tau_s, np.float64))

    def psd(self, axis: str, f_hz: Floats, tau0_s: float) -> Floats:
        """Two-sided spectrum of one axis, unit²/Hz, up to half the sample rate; lines and slopes have no density."""
        return self.spectrum(axis, tau0_s).density(np.asarray(f_hz, np.float64))

    def spectrum(self, axis: str, tau0_s: float) -> Spectrum:
        """Density, lines and slope of one axis as measured."""
        true_s = tau0_s / self.rate_ratio
        leaking: dict[str, float] = {}
        for effect in self.effects.get(axis, ()):
            if isinstance(effect, Leak):
                leaking[effect.source] = leaking.get(effect.source, 0.0) + effect.coefficient
        total = self._own(axis, true_s)
        for source, coefficient in leaking.items():
            total += self._measured(source, self._own(source, true_s)).scaled(coefficient)
        return self._clock.restated(self._measured(axis, total))

    def _own(self, axis: str, tau0_s: float) -> Spectrum:
        """Of the axis' own sources."""
        effects = self.effects.get(axis, ())
        stepped = any(isinstance(effect, NoiseStep) for effect in effects)
        total = nothing(tau0_s)
        for effect in effects:
            if isinstance(effect, Source):
                once = stepped and isinstance(effect, AngleRandomWalk)
                total += unknown(tau0_s) if once else effect.spectrum(tau0_s)
        return total

    def _measured(self, axis: str, spectrum: Spectrum) -> Spectrum:
        for transform in self.transforms(axis):
            spectrum = transform.reshape(spectrum)
        return spectrum

    def transforms(self, axis: str) -> list[Transform]:
        """The transforms of an axis in the order in which they act."""
        found = [effect for effect in self.effects.get(axis, ()) if isinstance(effect, Transform)]
        return sorted(found, key=lambda transform: ORDER.index(type(transform)))

    # --- time series

    def check(self, rate_hz: float, *, temperature: bool = True) -> None:
        """ConfigError when the model cannot be simulated at a stated rate.

        Args:
            rate_hz: stated sample rate
            temperature: whether a temperature is at hand, from the model or from a recording
        """
        for axis, effect in self:
            with model_file.placed(f"{axis}.{effect.name}"):
                effect.check_rate(rate_hz * self.rate_ratio)
                if isinstance(effect, Leak) and not self.effects.get(effect.source):
                    raise ConfigError(f"the model has no effect on its source {effect.source}")
                if isinstance(effect, NoiseStep) and not any(
                    isinstance(other, AngleRandomWalk) for other in self.effects[axis]
                ):
                    raise ConfigError(f"{axis} has no angle_random_walk to multiply")
                if isinstance(effect, Source) and effect.uses_temperature and not temperature:
                    raise ConfigError("no temperature: the model has no [temperature], and no recording gives one")

    def stream(self, rate_hz: float, seed: int, temperature_c: Floats | None = None) -> "ModelStream":
        """Begin an endless series of six axes; the same for the same rate and seed.

        Args:
            rate_hz: sample rate as the recording will state it
            seed: any whole number
            temperature_c: [n] a recording's temperature, instead of the model's; held at its last value beyond its end
        Raises:
            ConfigError: a frequency at or above half the sample rate, a source axis without effects, a noise step
                without noise, no temperature where one is needed
        """
        from monitor.noise.simulation import ModelStream

        return ModelStream(self, rate_hz, seed, temperature_c)

    def simulate(self, n: int, rate_hz: float, seed: int, temperature_c: Floats | None = None) -> Floats:
        """The first ``n`` samples [n, 6] of ``stream``, rad/s and m/s²."""
        return self.stream(rate_hz, seed, temperature_c).draw(n)

    # --- text

    @classmethod
    def from_toml(cls, text: str) -> "NoiseModel":
        """Read a model file's text; ConfigError says in one line what is wrong with it."""
        effects, rate_hz, temperature = model_file.read(text)
        model = cls(sample_rate_hz=rate_hz, temperature=temperature)
        for axes, given in effects:
            model += cls(dict.fromkeys(axes, given))
        if rate_hz is not None:
            model.check(rate_hz)
        return model

    def to_toml(self) -> str:
        """The model as text that ``from_toml`` reads back to an equal model."""
        return model_file.write(self)
