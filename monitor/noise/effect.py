"""Base classes of the effects in a noise model.

An effect is a frozen dataclass of parameters. There are five kinds of effects.

- A ``Source`` adds noise or a bias to an axis.
- An ``AxisLeak`` adds the measurement of another axis, multiplied by a coefficient.
- ``WhiteNoiseGain`` and ``HeavyTails`` multiply the white noise of an axis by a factor.
- An ``AxisPermutation`` replaces the output of an axis by the output of another axis.
- A ``Transform`` modifies the sum of the sources, before or after the leaks are added. The order of the transforms is
  ``monitor.noise.effects.TRANSFORM_ORDER``.

Simulated samples depend only on the random generator and the sample index, not on how the samples are divided into
blocks. Effects do not access files, clocks or global state.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields
from math import ceil, inf, isfinite
from typing import Any, ClassVar, Final

import numpy as np

from drivers.data_types import AXES, Floats
from drivers.errors import ConfigError
from drivers.validation.module_lookup import format_suggestion
from drivers.validation.number_ranges import DELAY_S, EFFECT_FREQUENCY_HZ, PARAMETER, NumberRange
from monitor.noise.spectrum import Spectrum, nan_spectrum

QUANTITIES: Final = {"s": DELAY_S, "Hz": EFFECT_FREQUENCY_HZ, "1/s": EFFECT_FREQUENCY_HZ}
"""Allowed number range by unit of the parameter. For other units, the range is ``PARAMETER``."""
MAX_EVENTS_PER_SAMPLE: Final = 1000.0
"""Maximum mean number of random events per sample. The limit bounds the computing time and the memory."""
GYROS, ACCELEROMETERS = AXES[:3], AXES[3:]


@dataclass(slots=True)
class SampleBlockContext:
    """Sample index, temperature and work array of a block of samples that is being simulated."""

    first: int  # index of the first sample, counted from the start of the simulation
    temperature_c: Floats  # [n] temperature, °C; NaN if there is none
    scratch: Floats  # [n] work array with arbitrary content


@dataclass(slots=True)
class RunningSource:
    """Time series of a source during a simulation."""

    add_next_samples: Callable[[Floats, SampleBlockContext], object]
    """Function that adds the next samples of the series to an array [n] with n > 0, in the unit of the axis."""
    drawn_random_values: Callable[[], dict[str, Any]] = dict
    """Function that returns the random values that have been drawn so far, such as phases and event times."""


@dataclass(slots=True)
class RunningTransform:
    """Transform of one axis during a simulation. A function that keeps state must be a method, so that its state is
    copied with it."""

    transform_in_place: Callable[[Floats], object]
    """Function that transforms the next samples [n] in place."""
    drawn_random_values: Callable[[], dict[str, Any]] = dict
    """Function that returns the random values that have been drawn so far."""


@dataclass(slots=True)
class RunningGain:
    """Simulated gain of the white noise of one axis."""

    compute_gain: Callable[[int, int], Floats]
    """Function that returns the gain [n] for the index of the first sample in the stream and the number n."""
    drawn_random_values: Callable[[], dict[str, Any]] = dict
    """Function that returns the random values that have been drawn so far."""


class ParameterTable:
    """Table of parameters in a model file.

    Subclasses are frozen dataclasses whose fields are defined by ``parameter_field``.

    Raises
    ------
    ConfigError
        If a parameter is not a finite number or is out of range.
    """

    __slots__ = ()

    name: ClassVar[str]  # name of the table in model files, equal to the module name

    def __init_subclass__(cls) -> None:
        cls.name = cls.__module__.rpartition(".")[2]

    def __post_init__(self) -> None:
        for f in fields(self):  # type: ignore[arg-type]
            value = getattr(self, f.name)
            if mistake := _find_mistake(value, f.metadata):
                suggestion = format_suggestion(value, AXES) if f.metadata.get("axis") and isinstance(value, str) else ""
                raise ConfigError(f"{self.name}: {f.name} {mistake}, is {value!r}{suggestion}")


class Effect(ParameterTable, ABC):
    """Effect of a noise model on one axis."""

    __slots__ = ()

    description: ClassVar[str]  # one sentence that describes the effect to users

    @property
    def events_hz(self) -> float:
        """Mean number of random events per second that the effect causes."""
        return 0.0

    def check_axis(self, axis: str) -> None:
        """Raise ConfigError if the effect cannot be applied to the given axis."""

    def check_rate(self, rate_hz: float) -> None:
        """Raise ConfigError if the effect cannot be simulated at the given sample rate."""
        for f in fields(self):  # type: ignore[arg-type]
            value = getattr(self, f.name)
            if f.metadata.get("below_nyquist") and not (value or 0.0) < 0.5 * rate_hz:
                raise ConfigError(
                    f"{self.name}: {f.name} must be below {0.5 * rate_hz:g} Hz, half the sample rate, is {value!r}"
                )
        if self.events_hz > MAX_EVENTS_PER_SAMPLE * rate_hz:
            raise ConfigError(
                f"{self.name}: {self.events_hz:g} events a second at {rate_hz:g} Hz; "
                f"at most {MAX_EVENTS_PER_SAMPLE:g} per sample are possible"
            )


class Source(Effect):
    """Effect that adds noise or a bias to an axis."""

    __slots__ = ()

    uses_temperature: ClassVar[bool] = False

    @abstractmethod
    def spectrum(self, tau0_s: float) -> Spectrum:
        """Return the spectrum of samples at intervals of ``tau0_s`` seconds.

        The spectrum is NaN if it depends on the temperature or on the length of the recording.
        """

    @abstractmethod
    def start_series(self, rate_hz: float, rng: np.random.Generator) -> RunningSource:
        """Start a time series for a simulation.

        Parameters
        ----------
        rate_hz : float
            True sample rate, Hz.
        rng : numpy.random.Generator
            Random generator of the effect.
        """

    def avar(self, tau_s: Floats, tau0_s: float) -> Floats:
        """Return the overlapping Allan variance in squared units of the axis.

        Parameters
        ----------
        tau_s : ndarray, float64
            Averaging times, s.
        tau0_s : float
            Sample interval, s.
        """
        return self.spectrum(tau0_s).avar(tau_s)

    def two_sided_psd(self, f_hz: Floats, tau0_s: float) -> Floats:
        """Return the two-sided power spectral density in unit²/Hz, excluding spectral lines and slopes.

        Parameters
        ----------
        f_hz : ndarray, float64
            Frequencies with 0 < f ≤ 1/(2 τ0), Hz.
        tau0_s : float
            Sample interval, s.
        """
        return self.spectrum(tau0_s).density(f_hz)


class BiasWithoutSpectrum(Source):
    """Bias whose spectrum is not defined, because it depends on the temperature or on the length of the recording."""

    __slots__ = ()

    def spectrum(self, tau0_s: float) -> Spectrum:
        """Return NaN for all frequencies, because the bias has no spectrum of its own."""
        return nan_spectrum(tau0_s)


class AxisLeak(Effect):
    """Effect that adds the measurement of the axis ``source``, multiplied by ``coefficient``.

    The added measurement does not include leaks into the axis ``source``, so two axes can leak into each other.
    """

    __slots__ = ()

    source: str
    coefficient: float


class WhiteNoiseGain(Effect):
    """Effect that multiplies the white noise of an axis by a gain that changes in time."""

    __slots__ = ()

    @abstractmethod
    def start_gain(self, rate_hz: float, rng: np.random.Generator) -> RunningGain:
        """Start a simulated gain.

        Parameters
        ----------
        rate_hz : float
            True sample rate, Hz.
        rng : numpy.random.Generator
            Random generator of the effect.
        """


class Transform(Effect):
    """Effect that modifies the sum of the sources of an axis, before or after the leaks are added."""

    __slots__ = ()

    precedes_leaks: ClassVar[bool] = False
    """True if the effect acts before leaks from other axes are added."""

    @abstractmethod
    def transform_spectrum(self, spectrum: Spectrum) -> Spectrum:
        """Return the spectrum after the transform, or NaN if no formula is known."""

    @abstractmethod
    def start_transform(self, rate_hz: float, rng: np.random.Generator) -> RunningTransform:
        """Start a transform for a simulation.

        Parameters
        ----------
        rate_hz : float
            True sample rate, Hz.
        rng : numpy.random.Generator
            Random generator of the effect.
        """


def parameter_field(
    gyro_unit: str,
    accelerometer_unit: str | None = None,
    *,
    signed: bool = False,
    positive: bool = False,
    whole_number: bool = False,
    optional: bool = False,
    below_nyquist: bool = False,
    maximum: float = inf,
    number_range: NumberRange | None = None,
) -> Any:
    """Return a dataclass field for a parameter with a unit and a range. By default, all numbers ≥ 0 are allowed.

    Parameters
    ----------
    gyro_unit, accelerometer_unit : str
        SI units for gyroscopes and accelerometers, or "1" for dimensionless parameters. If ``accelerometer_unit`` is
        None, both units are the same.
    signed : bool
        True to allow negative values.
    positive : bool
        True to exclude zero.
    whole_number : bool
        True to allow only whole numbers.
    optional : bool
        True to allow None.
    below_nyquist : bool
        True if the parameter is a frequency that must be below half the sample rate.
    maximum : float
        Maximum value.
    number_range : NumberRange or None
        Allowed range. None means that the unit determines the range.
    """
    metadata = {
        "units": (gyro_unit, accelerometer_unit or gyro_unit),
        "signed": signed,
        "positive": positive,
        "whole": whole_number,
        "optional": optional,
        "below_nyquist": below_nyquist,
        "most": maximum,
        "quantity": number_range or QUANTITIES.get(gyro_unit, PARAMETER),
    }
    return field(default=None, metadata=metadata) if optional else field(metadata=metadata)


def source_axis_field() -> Any:
    """Return a dataclass field for the name of another axis."""
    return field(metadata={"units": ("axis", "axis"), "axis": True})


def choice_field(*choices: str) -> Any:
    """Return an optional dataclass field whose value is one of the given words."""
    return field(default=None, metadata={"units": ("text", "text"), "choices": choices, "optional": True})


def gyro_and_accel_units(table: type[ParameterTable]) -> Mapping[str, tuple[str, str]]:
    """Return the units of each parameter for gyroscopes and for accelerometers."""
    return {f.name: f.metadata["units"] for f in fields(table)}  # type: ignore[arg-type]


def required_parameters(table: type[ParameterTable]) -> tuple[str, ...]:
    """Return the names of all parameters that have no default value."""
    return tuple(f.name for f in fields(table) if f.default is MISSING)  # type: ignore[arg-type]


def first_sample_at_or_after(time_s: float, rate_hz: float) -> int:
    """Return the index of the first sample at or after a time, with a tolerance of 1e-6 samples.

    Parameters
    ----------
    time_s : float
        Time since the start of the simulation, s.
    rate_hz : float
        Sample rate, Hz.
    """
    return ceil(time_s * rate_hz - 1e-6)


def _find_mistake(value: Any, allows: Mapping[str, Any]) -> str:
    """Return an error message if a parameter value is not allowed, otherwise an empty string."""
    if allows.get("axis"):
        return "" if value in AXES else f"must be one of {', '.join(AXES)}"
    if choices := allows.get("choices"):
        return "" if value is None or value in choices else f"must be one of {', '.join(choices)}"
    if value is None and allows["optional"]:
        return ""
    if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
        return "must be a finite number"
    if value < 0.0 and not allows["signed"]:
        return "must not be negative"
    if value == 0.0 and allows["positive"]:
        return "must be above zero"
    if not allows["quantity"].supports(value):
        return f"must be {allows['quantity'].format_range()}"
    if value > allows["most"]:
        return f"must be at most {allows['most']:g}"
    return "must be a whole number" if allows["whole"] and value != int(value) else ""
