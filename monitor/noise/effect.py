"""Base classes of the effects of a noise model.

An effect is a frozen dataclass of parameters. There are four kinds of effects:

- A ``Source`` adds noise or a bias to an axis.
- An ``AxisLeak`` adds the measurement of another axis times a coefficient.
- ``NoiseStep`` multiplies the white noise of an axis.
- A ``Transform`` modifies the sum of sources and leaks, in the order of ``monitor.noise.effects.TRANSFORM_ORDER``.

Simulated samples depend only on the random generator and the sample index, not on the division into blocks. Effects do
not read files or clocks, and have no global state.
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
"""Number range of the parameters with a given unit. Parameters with other units use ``PARAMETER``."""
MAX_EVENTS_PER_SAMPLE: Final = 1000.0
"""Maximum mean number of random events per sample, which limits time and memory."""
GYROS, ACCELEROMETERS = AXES[:3], AXES[3:]


@dataclass(slots=True)
class SampleBlockContext:
    """Sample index, temperature and work array of the simulated block."""

    first: int  # index of the first sample, counted from the start of the stream
    temperature_c: Floats  # [n] °C; NaN without a temperature
    scratch: Floats  # [n] work array with arbitrary content


class RunningEffect:
    """Simulated effect of one axis."""

    def drawn_random_values(self) -> dict[str, Any]:
        """Return the random values drawn so far, such as phases and event times."""
        return {}


class NoiseSeries(RunningEffect, ABC):
    """Simulated time series of a source."""

    @abstractmethod
    def add_next_samples(self, values: Floats, block: SampleBlockContext) -> None:
        """Add the next samples of the series to ``values``, in the unit of the axis.

        Parameters
        ----------
        values : ndarray of float64, shape (n,)
            Sum of the sources of the axis, updated in place. The array must not be empty.
        block : SampleBlockContext
            Index, temperature and work array of the block.
        """

    def draw_samples(self, n: int, first_index: int = 0) -> Floats:
        """Return the next samples of the series.

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
    """Time series that a function of the block computes."""

    def __init__(self, function: Callable[[Floats, SampleBlockContext], object]) -> None:
        self._function = function

    def add_next_samples(self, values: Floats, block: SampleBlockContext) -> None:
        """Call the function with ``values`` and ``block``."""
        self._function(values, block)


class RunningTransform(RunningEffect, ABC):
    """Simulated transform of one axis."""

    @abstractmethod
    def transform_in_place(self, values: Floats) -> None:
        """Transform the next samples [n] in place."""


class MemorylessTransform(RunningTransform):
    """Transform whose output depends only on the current sample."""

    def __init__(self, function: Callable[[Floats], object]) -> None:
        self._function = function

    def transform_in_place(self, values: Floats) -> None:
        """Call the function with ``values``."""
        self._function(values)


class ParameterTable:
    """Table of parameters in a model file. Subclasses are frozen dataclasses with ``parameter_field`` fields.

    Raises
    ------
    ConfigError
    If a parameter is not a finite number or is outside the allowed range.
    """

    __slots__ = ()

    name: ClassVar[str]  # name in model files, equal to the module name

    def __init_subclass__(cls) -> None:
        cls.name = cls.__module__.rpartition(".")[2]

    def __post_init__(self) -> None:
        for f in fields(self):  # type: ignore[arg-type]
            value = getattr(self, f.name)
            if mistake := _find_mistake(value, f.metadata):
                suggestion = format_suggestion(value, AXES) if f.metadata.get("axis") and isinstance(value, str) else ""
                raise ConfigError(f"{self.name}: {f.name} {mistake}, is {value!r}{suggestion}")


class Effect(ParameterTable, ABC):
    """Effect on one axis."""

    __slots__ = ()

    description: ClassVar[str]  # description of the effect for users, one sentence

    @property
    def events_hz(self) -> float:
        """Mean number of random events per second."""
        return 0.0

    def check_axis(self, axis: str) -> None:
        """Raise ConfigError if the effect is not possible on the given axis."""

    def check_rate(self, rate_hz: float) -> None:
        """Raise ConfigError if the effect cannot be simulated at the given sample rate."""
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
    """Effect that adds noise or a bias to an axis."""

    __slots__ = ()

    uses_temperature: ClassVar[bool] = False

    @abstractmethod
    def spectrum(self, tau0_s: float) -> Spectrum:
        """Return the spectrum of samples with the interval ``tau0_s`` in seconds.

        The spectrum is NaN if the temperature or the length of the recording determines the spectrum.
        """

    @abstractmethod
    def start_series(self, rate_hz: float, rng: np.random.Generator) -> NoiseSeries:
        """Start a simulated time series.

        Parameters
        ----------
        rate_hz : float
            True sample rate, Hz.
        rng : numpy.random.Generator
            Random generator of the effect.
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
        """Return the two-sided power spectral density in unit²/Hz, without spectral lines and slopes.

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

    The added measurement does not contain leaks into the source axis, so axes can leak into each other.
    """

    __slots__ = ()

    source: str
    coefficient: float


class Transform(Effect):
    """Effect that modifies the sum of all sources and leaks of an axis."""

    __slots__ = ()

    @abstractmethod
    def transform_spectrum(self, spectrum: Spectrum) -> Spectrum:
        """Return the spectrum after the transform, or a spectrum of NaN if no formula is known."""

    @abstractmethod
    def start_transform(self, rate_hz: float, rng: np.random.Generator) -> RunningTransform:
        """Start a simulated transform.

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
    """Return a dataclass field with units and an allowed range. By default, all numbers ≥ 0 are allowed.

    Parameters
    ----------
    gyro_unit, accelerometer_unit : str
        SI units for gyroscopes and accelerometers. The unit of dimensionless parameters is "1". With None,
        accelerometers have the unit of gyroscopes.
    signed : bool
        True if negative values are allowed.
    positive : bool
        True if zero is not allowed.
    whole_number : bool
        True if only whole numbers are allowed.
    optional : bool
        True if the parameter may be None.
    below_nyquist : bool
        True if the parameter is a frequency that must be below half the sample rate.
    maximum : float
        Largest allowed value.
    number_range : NumberRange or None
        Supported range. With None, the unit determines the range.
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


def gyro_and_accel_units(table: type[ParameterTable]) -> Mapping[str, tuple[str, str]]:
    """Return the units of every parameter of an effect, for gyroscopes and accelerometers."""
    return {f.name: f.metadata["units"] for f in fields(table)}  # type: ignore[arg-type]


def required_parameters(table: type[ParameterTable]) -> tuple[str, ...]:
    """Return the names of the parameters without a default value."""
    return tuple(f.name for f in fields(table) if f.default is MISSING)  # type: ignore[arg-type]


def first_sample_at_or_after(time_s: float, rate_hz: float) -> int:
    """Return the index of the first sample at or after a time. Rounding errors of 1e-6 samples are allowed.

    Parameters
    ----------
    time_s : float
        Time since the start, s.
    rate_hz : float
        Sample rate, Hz.
    """
    return ceil(time_s * rate_hz - 1e-6)


def _find_mistake(value: Any, allows: Mapping[str, Any]) -> str:
    """Return an error message if the value is not allowed, otherwise an empty string."""
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
