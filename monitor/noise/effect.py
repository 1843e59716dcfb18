"""Base classes of the effects of a noise model: frozen dataclasses of parameters with units, with the physics in one
place.

There are four kinds of effects. A ``Source`` adds to the rate of its axis. Its ``avar`` and ``psd`` describe the
sampled series that it simulates, so that fit, simulation and comparison use the same physics. ``avar`` is the
overlapping Allan variance of samples ``tau0_s`` apart, and ``psd`` is their two-sided spectrum up to half the sample
rate. A ``Leak`` adds a share of the measurement of another axis. ``NoiseStep`` changes the size of white noise. A
``Transform`` acts on the sum, in the order of ``monitor.noise.effects.TRANSFORM_ORDER``.

``start`` begins an endless series. A ``NoiseSeries`` adds its next samples to a block, and a ``RunningTransform``
transform changes a block in place. Both depend only on their random generator and on the index of the sample, not on
how the series is divided into blocks. Their memory does not grow. ``truth`` returns the randomly drawn values that the
parameters do not contain.

If a variance depends on more than the model, such as the length of the recording or the temperature, it is NaN. No
effect does I/O, reads a clock or keeps global random state.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from math import ceil, inf, isfinite
from typing import Any, ClassVar, Final

import numpy as np

from drivers.discovery import format_suggestion
from drivers.errors import ConfigError
from drivers.quantities import DELAY_S, EFFECT_FREQUENCY_HZ, PARAMETER
from drivers.sample import AXES, Floats
from monitor.noise.spectrum import Spectrum

QUANTITIES: Final = {"s": DELAY_S, "Hz": EFFECT_FREQUENCY_HZ, "1/s": EFFECT_FREQUENCY_HZ}
"""Unit of a parameter -> its quantity. All other parameters use PARAMETER."""
MAX_EVENTS_PER_SAMPLE: Final = 1000.0
"""Largest mean number of random events per sample. Each event takes time and memory."""
GYROS, ACCELEROMETERS = AXES[:3], AXES[3:]


@dataclass(slots=True)
class SampleBlockContext:
    """Block of samples that is being simulated."""

    first: int  # index of the first sample, counted from the start of the stream
    temperature_c: Floats  # [n] °C; NaN if the model has no temperature
    scratch: Floats  # [n] work array, free for use during a call


class NoiseSeries(ABC):
    """Endless time series of a source."""

    @abstractmethod
    def add(self, values: Floats, block: SampleBlockContext) -> None:
        """Add the next ``values.size`` samples (at least one) to the values, in the unit of the axis.

        Parameters
        ----------
        values : ndarray, shape (n,), float64
            Sum of the sources of the axis. It is updated in place.
        block : Block
            Index, temperature and work array of the block.
        """

    def draw(self, n: int, first: int = 0) -> Floats:
        """Return the next samples of this series alone, without a temperature.

        Parameters
        ----------
        n : int
            Number of samples.
        first : int
            Index of the first sample, counted from the start of the stream.
        """
        values = np.zeros(n)
        if n:
            self.add(values, SampleBlockContext(first, np.full(n, np.nan), np.empty(n)))
        return values

    def truth(self) -> dict[str, Any]:
        """Return the randomly drawn values so far that the parameters do not contain; empty for plain noise."""
        return {}


class RunningTransform(ABC):
    """Transform that runs on one axis."""

    @abstractmethod
    def apply(self, values: Floats) -> None:
        """Transform the next values [n] in place."""

    def truth(self) -> dict[str, Any]:
        """Return the randomly drawn values so far that the parameters do not contain."""
        return {}


class Effect(ABC):
    """Named effect on one axis.

    Raises
    ------
    ConfigError
        If a parameter is not a finite number, or outside the range of its field.
    """

    __slots__ = ()

    name: ClassVar[str]
    description: ClassVar[str]  # one sentence that explains the effect to users

    def __post_init__(self) -> None:
        for f in fields(self):  # type: ignore[arg-type]
            _check_parameter(self.name, f.name, getattr(self, f.name), f.metadata)

    def check_axis(self, axis: str) -> None:  # noqa: B027 - most effects may be on any axis
        """Raise ConfigError if the effect cannot be on that axis."""

    def check_rate(self, rate_hz: float) -> None:  # noqa: B027 - most effects have no frequency
        """Raise ConfigError if samples at ``rate_hz`` cannot show the effect."""


class Source(Effect):
    """Effect that adds to the rate."""

    __slots__ = ()

    uses_temperature: ClassVar[bool] = False

    @abstractmethod
    def avar(self, tau_s: Floats, tau0_s: float) -> Floats:
        """Return the overlapping Allan variance in the squared unit of the axis.

        Parameters
        ----------
        tau_s : ndarray, float64
            Averaging times, s.
        tau0_s : float
            Sample interval, s.
        """

    @abstractmethod
    def psd(self, f_hz: Floats, tau0_s: float) -> Floats:
        """Return the two-sided spectral density in unit²/Hz; zero for a spectral line or a slope.

        Parameters
        ----------
        f_hz : ndarray, float64
            Frequencies, 0 < f ≤ 1/(2 τ0), Hz.
        tau0_s : float
            Sample interval, s.
        """

    @abstractmethod
    def start(self, rate_hz: float, rng: np.random.Generator) -> NoiseSeries:
        """Return a new series.

        Parameters
        ----------
        rate_hz : float
            True sample rate, Hz.
        rng : numpy.random.Generator
            Generator of this effect alone.
        """

    def spectrum(self, tau0_s: float) -> Spectrum:
        """Return density, lines and slope in the form that transforms use; ``tau0_s`` is the sample interval in
        seconds."""
        return Spectrum(lambda f: self.psd(f, tau0_s), lambda tau: self.avar(tau, tau0_s), tau0_s)


class Leak(Effect):
    """Effect that adds ``coefficient`` times the measurement of the axis ``source``.

    The measurement of the source axis consists of its own sources through its own transforms, without leaks into it.
    Axes that leak into each other therefore need no order, and there is no circular dependence.
    """

    __slots__ = ()

    source: str
    coefficient: float


class Transform(Effect):
    """Effect that acts on the sum of all sources and leaks, after the transforms that precede it."""

    __slots__ = ()

    @abstractmethod
    def transform_spectrum(self, spectrum: Spectrum) -> Spectrum:
        """Return the spectrum and Allan variance after the transform; NaN if there is neither a closed form nor an
        integral."""

    @abstractmethod
    def start(self, rate_hz: float, rng: np.random.Generator) -> RunningTransform:
        """Return a new running transform.

        Parameters
        ----------
        rate_hz : float
            True sample rate, Hz.
        rng : numpy.random.Generator
            Generator of this effect alone.
        """


def parameter(
    gyro_unit: str,
    accelerometer_unit: str,
    *,
    signed: bool = False,
    positive: bool = False,
    whole: bool = False,
    optional: bool = False,
    most: float = inf,
) -> Any:
    """Return a dataclass field with its units and its allowed range. The default range is all numbers ≥ 0.

    Parameters
    ----------
    gyro_unit, accelerometer_unit : str
        SI units on the two kinds of axes; "1" for a dimensionless number.
    signed : bool
        True if negative values are allowed.
    positive : bool
        True if zero is not allowed.
    whole : bool
        True if only whole numbers are allowed.
    optional : bool
        True if the parameter may be absent (None).
    most : float
        Largest allowed value.
    """
    metadata = {
        "units": (gyro_unit, accelerometer_unit),
        "signed": signed,
        "positive": positive,
        "whole": whole,
        "optional": optional,
        "most": most,
    }
    return field(default=None, metadata=metadata) if optional else field(metadata=metadata)


def source_axis() -> Any:
    """Return a dataclass field that names another axis."""
    return field(metadata={"units": ("axis", "axis"), "axis": True})


def parameter_units(effect: type[Effect]) -> Mapping[str, tuple[str, str]]:
    """Return the units of every parameter of an effect: on a gyroscope, and on an accelerometer."""
    return {f.name: f.metadata["units"] for f in fields(effect)}  # type: ignore[arg-type]


def required_parameters(effect: type[Effect]) -> tuple[str, ...]:
    """Return the parameters that a model file must give."""
    return tuple(f.name for f in fields(effect) if f.default is MISSING)  # type: ignore[arg-type]


def check_below_nyquist(effect: Effect, parameter: str, rate_hz: float) -> None:
    """Check that a frequency is below half the sample rate.

    Parameters
    ----------
    effect : Effect
        Effect to check.
    parameter : str
        Name of the parameter, in Hz.
    rate_hz : float
        Sample rate, Hz.

    Raises
    ------
    ConfigError
        If the frequency is not below half the sample rate.
    """
    value = getattr(effect, parameter)
    if not value < 0.5 * rate_hz:
        raise ConfigError(
            f"{effect.name}: {parameter} must be below {0.5 * rate_hz:g} Hz, half the sample rate, is {value!r}"
        )


def check_event_rate(effect: Effect, events_hz: float, rate_hz: float) -> None:
    """Check that random events are rare enough for a simulation.

    Parameters
    ----------
    effect : Effect
        Effect to check.
    events_hz : float
        Mean number of events per second.
    rate_hz : float
        Sample rate, Hz.

    Raises
    ------
    ConfigError
        If there are more than MAX_EVENTS_PER_SAMPLE events per sample.
    """
    if events_hz > MAX_EVENTS_PER_SAMPLE * rate_hz:
        raise ConfigError(
            f"{effect.name}: {events_hz:g} events a second at {rate_hz:g} Hz; "
            f"at most {MAX_EVENTS_PER_SAMPLE:g} in a sample are possible"
        )


def first_sample(time_s: float, rate_hz: float) -> int:
    """Return the index of the first sample at or after a time, with a tolerance of a millionth of a sample for
    rounding.

    Parameters
    ----------
    time_s : float
        Time since the start, s.
    rate_hz : float
        Sample rate, Hz.
    """
    return ceil(time_s * rate_hz - 1e-6)


def _check_parameter(effect: str, name: str, value: Any, allows: Mapping[str, Any]) -> None:
    """Raise ConfigError if a value is not allowed for a parameter."""
    if allows.get("axis"):
        if value not in AXES:
            raise ConfigError(f"{effect}: {name} must be one of {', '.join(AXES)}, is {value!r}{_suggestion(value)}")
        return
    if value is None and allows["optional"]:
        return
    if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
        raise ConfigError(f"{effect}: {name} must be a finite number, is {value!r}")
    if value < 0.0 and not allows["signed"]:
        raise ConfigError(f"{effect}: {name} must not be negative, is {value!r}")
    if value == 0.0 and allows["positive"]:
        raise ConfigError(f"{effect}: {name} must be above zero, is {value!r}")
    quantity = QUANTITIES.get(allows["units"][0], PARAMETER)
    if not quantity.supports(value):
        raise ConfigError(f"{effect}: {name} must be {quantity.range_text()}, is {value!r}")
    if value > allows["most"]:
        raise ConfigError(f"{effect}: {name} must be at most {allows['most']:g}, is {value!r}")
    if allows["whole"] and value != int(value):
        raise ConfigError(f"{effect}: {name} must be a whole number, is {value!r}")


def _suggestion(value: Any) -> str:
    """Return the hint with the nearest axis name, if the value is a string."""
    return format_suggestion(value, AXES) if isinstance(value, str) else ""
