"""Base classes of the effects of a noise model.

An effect is a frozen dataclass of parameters with units. There are four kinds of effects:

- A ``Source`` adds to the rate of its axis. The spectrum and the Allan variance of a source describe the sampled series
  that the source simulates, so fit, simulation and comparison use the same physics.
- An ``AxisLeak`` adds the measurement of another axis times a coefficient.
- ``NoiseStep`` changes the size of white noise.
- A ``Transform`` acts on the sum of sources and leaks, in the order of ``monitor.noise.effects.TRANSFORM_ORDER``.

``start`` begins an endless series. A ``NoiseSeries`` adds samples to a block. A ``RunningTransform`` changes a block
in place. The samples depend only on the random generator and on the index of the sample, not on how the series is
divided into blocks. The memory of a series does not grow. No effect does I/O, reads a clock or keeps global random
state.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields
from math import ceil, inf, isfinite
from typing import Any, ClassVar, Final

import numpy as np

from drivers.data_types import AXES, Floats
from drivers.errors import ConfigError
from drivers.module_lookup import format_suggestion
from drivers.number_ranges import DELAY_S, EFFECT_FREQUENCY_HZ, PARAMETER, NumberRange
from monitor.noise.spectrum import Spectrum

QUANTITIES: Final = {"s": DELAY_S, "Hz": EFFECT_FREQUENCY_HZ, "1/s": EFFECT_FREQUENCY_HZ}
"""Unit of a parameter -> its quantity. All other parameters use PARAMETER."""
MAX_EVENTS_PER_SAMPLE: Final = 1000.0
"""Largest mean number of random events per sample. Each event takes time and memory."""
GYROS, ACCELEROMETERS = AXES[:3], AXES[3:]


@dataclass(slots=True)
class SampleBlockContext:
    """Context of the block of samples that is being simulated."""

    first: int  # index of the first sample, counted from the start of the stream
    temperature_c: Floats  # [n] °C; NaN if the model has no temperature
    scratch: Floats  # [n] work array, free for use during a call


class RunningEffect:
    """Effect that is being simulated on one axis."""

    def drawn_random_values(self) -> dict[str, Any]:
        """Return the random values drawn so far that the parameters do not contain."""
        return {}


class NoiseSeries(RunningEffect, ABC):
    """Endless time series of a source."""

    @abstractmethod
    def add_next_samples(self, values: Floats, block: SampleBlockContext) -> None:
        """Add the next ``values.size`` samples (at least one) to the values, in the unit of the axis.

        Parameters
        ----------
        values : ndarray, shape (n,), float64
            Sum of the sources of the axis. It is updated in place.
        block : SampleBlockContext
            Index, temperature and work array of the block.
        """

    def draw_samples(self, n: int, first_index: int = 0) -> Floats:
        """Return the next samples of this series alone, without a temperature.

        Parameters
        ----------
        n : int
            Number of samples.
        first_index : int
            Index of the first sample, counted from the start of the stream.
        """
        values = np.zeros(n)
        if n:
            self.add_next_samples(values, SampleBlockContext(first_index, np.full(n, np.nan), np.empty(n)))
        return values


class StatelessSeries(NoiseSeries):
    """Series without a state. A function adds the samples of a block."""

    def __init__(self, function: Callable[[Floats, SampleBlockContext], object]) -> None:
        self._function = function

    def add_next_samples(self, values: Floats, block: SampleBlockContext) -> None:
        """Call the function."""
        self._function(values, block)


class RunningTransform(RunningEffect, ABC):
    """Transform that runs on one axis."""

    @abstractmethod
    def transform_in_place(self, values: Floats) -> None:
        """Transform the next values [n] in place."""


class MemorylessTransform(RunningTransform):
    """Transform whose output depends only on the present sample. A function changes the values in place."""

    def __init__(self, function: Callable[[Floats], object]) -> None:
        self._function = function

    def transform_in_place(self, values: Floats) -> None:
        """Call the function."""
        self._function(values)


class ParameterTable:
    """Table of parameters in a model file. A subclass is a frozen dataclass with fields from ``parameter_field``.

    Raises
    ------
    ConfigError
        If a parameter is not a finite number, or lies outside the range of its field.
    """

    __slots__ = ()

    name: ClassVar[str]  # name in model files, which is the name of the module

    def __init_subclass__(cls) -> None:
        cls.name = cls.__module__.rpartition(".")[2]

    def __post_init__(self) -> None:
        for f in fields(self):  # type: ignore[arg-type]
            value = getattr(self, f.name)
            if mistake := _find_mistake(value, f.metadata):
                suggestion = format_suggestion(value, AXES) if f.metadata.get("axis") and isinstance(value, str) else ""
                raise ConfigError(f"{self.name}: {f.name} {mistake}, is {value!r}{suggestion}")


class Effect(ParameterTable, ABC):
    """Effect on one axis. The name of an effect is the name of its module."""

    __slots__ = ()

    description: ClassVar[str]  # one sentence that explains the effect to users

    @property
    def events_hz(self) -> float:
        """Return the mean number of random events per second."""
        return 0.0

    def check_axis(self, axis: str) -> None:
        """Raise ConfigError if the effect cannot be on this axis."""

    def check_rate(self, rate_hz: float) -> None:
        """Raise ConfigError if samples at ``rate_hz`` cannot show the effect."""
        for f in fields(self):  # type: ignore[arg-type]
            value = getattr(self, f.name)
            if f.metadata.get("below_nyquist") and not value < 0.5 * rate_hz:
                raise ConfigError(
                    f"{self.name}: {f.name} must be below {0.5 * rate_hz:g} Hz, half the sample rate, is {value!r}"
                )
        if self.events_hz > MAX_EVENTS_PER_SAMPLE * rate_hz:
            raise ConfigError(
                f"{self.name}: {self.events_hz:g} events a second at {rate_hz:g} Hz; "
                f"at most {MAX_EVENTS_PER_SAMPLE:g} per sample are possible"
            )


class Source(Effect):
    """Effect that adds to the rate."""

    __slots__ = ()

    uses_temperature: ClassVar[bool] = False

    @abstractmethod
    def spectrum(self, tau0_s: float) -> Spectrum:
        """Return spectral density, lines, slope and Allan variance of samples at intervals of ``tau0_s`` seconds.

        The spectrum is NaN if it depends on the temperature or on the length of the recording.
        """

    @abstractmethod
    def start_series(self, rate_hz: float, rng: np.random.Generator) -> NoiseSeries:
        """Return a new series.

        Parameters
        ----------
        rate_hz : float
            True sample rate, Hz.
        rng : numpy.random.Generator
            Generator of this effect alone.
        """

    def avar(self, tau_s: Floats, tau0_s: float) -> Floats:
        """Return the overlapping Allan variance in the squared unit of the axis.

        Parameters
        ----------
        tau_s : ndarray, float64
            Averaging times, s.
        tau0_s : float
            Sample interval, s.
        """
        return self.spectrum(tau0_s).avar(tau_s)

    def two_sided_psd(self, f_hz: Floats, tau0_s: float) -> Floats:
        """Return the two-sided spectral density in unit²/Hz. The density of a spectral line or a slope is zero.

        Parameters
        ----------
        f_hz : ndarray, float64
            Frequencies, 0 < f ≤ 1/(2 τ0), Hz.
        tau0_s : float
            Sample interval, s.
        """
        return self.spectrum(tau0_s).density(f_hz)


class AxisLeak(Effect):
    """Effect that adds ``coefficient`` times the measurement of the axis ``source``.

    Leaks into the source axis are left out of this measurement. Axes that leak into each other therefore need no order,
    and there is no circular dependence.
    """

    __slots__ = ()

    source: str
    coefficient: float


class Transform(Effect):
    """Effect that acts on the sum of all sources and leaks, after the transforms that precede it."""

    __slots__ = ()

    @abstractmethod
    def transform_spectrum(self, spectrum: Spectrum) -> Spectrum:
        """Return the spectrum after the transform. The spectrum is NaN if no formula for it is known."""

    @abstractmethod
    def start_transform(self, rate_hz: float, rng: np.random.Generator) -> RunningTransform:
        """Return a new running transform.

        Parameters
        ----------
        rate_hz : float
            True sample rate, Hz.
        rng : numpy.random.Generator
            Generator of this effect alone.
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
    """Return a dataclass field with its units and its allowed range. The default range is all numbers ≥ 0.

    Parameters
    ----------
    gyro_unit, accelerometer_unit : str
        SI units on the two kinds of axes. A dimensionless number has the unit "1". None means that the unit is the same
        on both kinds of axes.
    signed : bool
        True if negative values are allowed.
    positive : bool
        True if zero is not allowed.
    whole_number : bool
        True if only whole numbers are allowed.
    optional : bool
        True if the parameter may be absent (None).
    below_nyquist : bool
        True if the parameter is a frequency that must be below half the sample rate.
    maximum : float
        Largest allowed value.
    number_range : NumberRange or None
        NumberRange with the supported range. None selects the quantity by the unit.
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
    """Return a dataclass field that names another axis."""
    return field(metadata={"units": ("axis", "axis"), "axis": True})


def gyro_and_accel_units(table: type[ParameterTable]) -> Mapping[str, tuple[str, str]]:
    """Return the units of every parameter of an effect: first on a gyroscope, then on an accelerometer."""
    return {f.name: f.metadata["units"] for f in fields(table)}  # type: ignore[arg-type]


def required_parameters(table: type[ParameterTable]) -> tuple[str, ...]:
    """Return the parameters that a model file must give."""
    return tuple(f.name for f in fields(table) if f.default is MISSING)  # type: ignore[arg-type]


def first_sample_at_or_after(time_s: float, rate_hz: float) -> int:
    """Return the index of the first sample at or after a time. A millionth of a sample is allowed for rounding.

    Parameters
    ----------
    time_s : float
        Time since the start, s.
    rate_hz : float
        Sample rate, Hz.
    """
    return ceil(time_s * rate_hz - 1e-6)


def _find_mistake(value: Any, allows: Mapping[str, Any]) -> str:
    """Return a message if the value of a parameter is not allowed, else an empty text."""
    if allows.get("axis"):
        return "" if value in AXES else f"must be one of {', '.join(AXES)}"
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
