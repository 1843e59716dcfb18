"""Noise model of an IMU, which consists of effects on each axis.

The same model is used for simulations, for the comparison with measurements and by the command ``reconcile``. The Allan
variance and the power spectral density include linear transforms and leaks between axes. They are NaN if they depend on
the temperature or on the length of the recording.
"""

import html
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drivers.data_types import AXES, Floats
from drivers.errors import ConfigError
from drivers.validation.module_lookup import format_suggestion
from monitor.noise.effect import AxisLeak, Effect, Source, Transform
from monitor.noise.effects import TRANSFORM_ORDER
from monitor.noise.effects.coupling.axis_permutation import AxisPermutation
from monitor.noise.effects.disturbances.noise_step import NoiseStep
from monitor.noise.effects.ieee952.angle_random_walk import AngleRandomWalk
from monitor.noise.effects.signal_chain.sample_rate_error import SampleRateError
from monitor.noise.model_toml import (
    format_model_as_text_table,
    format_model_toml,
    parse_model_toml,
    prefix_config_errors,
)
from monitor.noise.simulation import ModelStream, check_effects_can_be_simulated
from monitor.noise.spectrum import Spectrum, nan_spectrum, zero_spectrum
from monitor.noise.temperature import Temperature


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Noise model of an IMU, in which axes without effects have no noise.

    Parameters
    ----------
    effects : mapping of str to tuple of Effect
        Effects of each axis.
    sample_rate_hz : float or None
        Default sample rate of simulations in Hz.
    temperature : Temperature or None
        Simulated temperature, which is used unless a recording provides the temperature.

    Raises
    ------
    ConfigError
        If an axis is unknown, if an effect cannot be applied to an axis, or if two sample rate errors differ.

    Examples
    --------
    >>> from monitor.noise.effects import AngleRandomWalk, ConstantBias
    >>> model = NoiseModel({"gz": (AngleRandomWalk(N=1e-4),)}) + NoiseModel({"gz": (ConstantBias(value=0.1),)})
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
                raise ConfigError(f'unknown axis "{axis}"{format_suggestion(axis, AXES)}')
            for effect in effects:
                with prefix_config_errors(f"{axis}.{effect.name}"):
                    effect.check_axis(axis)
        ratios = sorted({effect.ratio for _, effect in self if isinstance(effect, SampleRateError)})
        if len(ratios) > 1:
            given = " and ".join(f"{ratio:g}" for ratio in ratios)
            raise ConfigError(f"sample_rate_error: a recording has one clock, but ratio is {given}")

    def __iter__(self) -> Iterator[tuple[str, Effect]]:
        """Yield pairs of axis name and effect in the order of the axes."""
        for axis in AXES:
            for effect in self.effects.get(axis, ()):
                yield axis, effect

    def __add__(self, other: "NoiseModel") -> "NoiseModel":
        """Return a noise model that combines the effects of two models.

        The sample rate and the temperature of the left model take precedence.
        """
        if not isinstance(other, NoiseModel):
            return NotImplemented
        added = {
            axis: self.effects.get(axis, ()) + other.effects.get(axis, ())
            for axis in AXES
            if axis in self.effects or axis in other.effects
        }
        return NoiseModel(added, self.sample_rate_hz or other.sample_rate_hz, self.temperature or other.temperature)

    def __str__(self) -> str:
        return format_model_as_text_table(self.effects, self.sample_rate_hz, self.temperature)

    @property
    def true_to_stated_rate_ratio(self) -> float:
        """Ratio of the true sample rate to the stated sample rate."""
        return self._clock.ratio

    @property
    def _clock(self) -> SampleRateError:
        """Sample rate error of the model, with a ratio of 1 if the model has no such effect."""
        return next((e for _, e in self if isinstance(e, SampleRateError)), SampleRateError(ratio=1.0))

    # --- second moments

    def avar(self, axis: str, tau_s: Floats, tau0_s: float) -> Floats:
        """Return the overlapping Allan variance of one axis in unit², or NaN if it is unknown.

        Parameters
        ----------
        axis : str
            Name of the axis.
        tau_s : ndarray, float64
            Averaging times, s.
        tau0_s : float
            Stated sample interval, s.
        """
        return self.spectrum(axis, tau0_s).avar(np.asarray(tau_s, np.float64))

    def two_sided_psd(self, axis: str, f_hz: Floats, tau0_s: float) -> Floats:
        """Return the two-sided power spectral density of one axis in unit²/Hz, excluding spectral lines and slopes.

        Parameters
        ----------
        axis : str
            Name of the axis.
        f_hz : ndarray, float64
            Frequencies, Hz.
        tau0_s : float
            Stated sample interval, s.
        """
        return self.spectrum(axis, tau0_s).density(np.asarray(f_hz, np.float64))

    def spectrum(self, axis: str, tau0_s: float) -> Spectrum:
        """Return the spectrum of one axis, including leaks and transforms.

        Parameters
        ----------
        axis : str
            Name of the axis.
        tau0_s : float
            Stated sample interval, s.
        """
        axis = next((e.source for e in self.effects.get(axis, ()) if isinstance(e, AxisPermutation)), axis)
        true_s = tau0_s / self.true_to_stated_rate_ratio
        leaking: dict[str, float] = {}
        for effect in self.effects.get(axis, ()):
            if isinstance(effect, AxisLeak):
                leaking[effect.source] = leaking.get(effect.source, 0.0) + effect.coefficient
        total = self._own(axis, true_s)
        for source, coefficient in leaking.items():
            total += self._measured(source, self._own(source, true_s)).scaled_by_amplitude(coefficient)
        return self._clock.convert_to_stated_rate(self._measured(axis, total))

    def _own(self, axis: str, tau0_s: float) -> Spectrum:
        """Return the spectrum of the filtered sources of an axis, excluding leaks."""
        effects = self.effects.get(axis, ())
        stepped = any(isinstance(effect, NoiseStep) for effect in effects)
        total = zero_spectrum(tau0_s)
        for effect in effects:
            if isinstance(effect, Source):
                once = stepped and isinstance(effect, AngleRandomWalk)
                total += nan_spectrum(tau0_s) if once else effect.spectrum(tau0_s)
        return self._transformed(axis, total, before_leaks=True)

    def _measured(self, axis: str, spectrum: Spectrum) -> Spectrum:
        """Return the spectrum of the measurement, given the spectrum of the filtered sources and leaks."""
        return self._transformed(axis, spectrum, before_leaks=False)

    def _transformed(self, axis: str, spectrum: Spectrum, before_leaks: bool) -> Spectrum:
        found = [effect for effect in self.effects.get(axis, ()) if isinstance(effect, Transform)]
        for transform in sorted(found, key=lambda one: TRANSFORM_ORDER.index(type(one))):
            if transform.precedes_leaks == before_leaks:
                spectrum = transform.transform_spectrum(spectrum)
        return spectrum

    # --- time series

    def start_stream(self, rate_hz: float, seed: int, temperature_c: Floats | None = None) -> ModelStream:
        """Start an endless simulation of six axes, which is reproducible for the same rate and seed.

        Parameters
        ----------
        rate_hz : float
            Stated sample rate, Hz.
        seed : int
            Seed of the random generators.
        temperature_c : ndarray, shape (n,), or None
            Temperature of a recording in °C, which replaces the simulated temperature. After its end, the last value is
            repeated.

        Raises
        ------
        ConfigError
            If the model cannot be simulated at the sample rate.
        """
        return ModelStream(self.effects, self.temperature, rate_hz, self.true_to_stated_rate_ratio, seed, temperature_c)

    def simulate(self, n: int, rate_hz: float, seed: int, temperature_c: Floats | None = None) -> Floats:
        """Simulate n samples [n, 6] in rad/s and m/s².

        Parameters
        ----------
        n : int
            Number of samples.
        rate_hz, seed, temperature_c
            See ``start_stream``.
        """
        return self.start_stream(rate_hz, seed, temperature_c).draw_next_samples(n)

    # --- text

    @classmethod
    def from_toml(cls, text: str) -> "NoiseModel":
        """Read a noise model from the text of a model file.

        Raises
        ------
        ConfigError
            If the text is not a valid noise model. Each line of the message names a table in the text.
        """
        effects, rate_hz, temperature = parse_model_toml(text)
        model = cls(sample_rate_hz=rate_hz, temperature=temperature)
        for axes, given in effects:
            model += cls(dict.fromkeys(axes, given))
        if rate_hz is not None:
            # a recording may provide the temperature
            check_effects_can_be_simulated(
                model.effects, rate_hz * model.true_to_stated_rate_ratio, has_temperature=True
            )
        return model

    def to_toml(self) -> str:
        """Return the noise model as the text of a model file, from which ``from_toml`` creates an equal model."""
        return format_model_toml(self.effects, self.sample_rate_hz, self.temperature)

    def to_dict(self) -> dict[str, Any]:
        """Return the tables and values of the model file as a dictionary."""
        return tomllib.loads(self.to_toml())

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(str(self))}</pre>"
