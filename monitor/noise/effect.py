"""What an effect of an IMU's noise is: a frozen dataclass of parameters with units, and the physics in one place.

Four kinds. A ``Source`` adds to the rate of its axis; it answers for the sampled series it simulates, so that fit,
simulator and comparison share one physics: ``avar`` is the overlapping Allan variance of samples ``tau0_s`` apart,
``psd`` their two-sided spectrum up to half the sample rate. A ``Leak`` adds what another axis measures. ``NoiseStep``
changes the size of white noise. A ``Transform`` acts on the sum; ``monitor.noise.effects.ORDER`` says in which order.

``start`` begins an endless series: a ``Series`` adds its next samples to a block, a ``Running`` transform changes a
block in place. Both depend on their random generator and on the index of the sample only, never on how the series is
cut into blocks, and their memory does not grow. ``truth`` says what was drawn that the parameters do not say.

Where a variance depends on more than the model (the length of the recording, the temperature) it is NaN, not a guess.
No effect opens anything, reads a clock or keeps global random state.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from math import ceil, inf, isfinite
from typing import Any, ClassVar, Final

import numpy as np

from drivers.discovery import nearest
from drivers.errors import ConfigError
from drivers.quantities import DELAY_S, EFFECT_FREQUENCY_HZ, PARAMETER
from drivers.sample import AXES, Floats
from monitor.noise.spectrum import Spectrum

QUANTITIES: Final = {"s": DELAY_S, "Hz": EFFECT_FREQUENCY_HZ, "1/s": EFFECT_FREQUENCY_HZ}
"""Unit of a parameter -> its quantity; PARAMETER for all others."""
MOST_EVENTS: Final = 1000.0
"""Random events in a sample at the most, on average; each takes time and memory."""
GYROS, ACCELEROMETERS = AXES[:3], AXES[3:]


@dataclass(slots=True)
class Block:
    """The samples that are being made."""

    first: int  # index of the first sample since the stream began
    temperature_c: Floats  # [n] °C; NaN = the model has none
    scratch: Floats  # [n] anyone's, until their call returns


class Series(ABC):
    """A time series that goes on for as long as it is asked."""

    @abstractmethod
    def add(self, values: Floats, block: Block) -> None:
        """Add the next ``values.size`` samples (at least one), in the unit of the axis."""

    def draw(self, n: int, first: int = 0) -> Floats:
        """The next ``n`` samples by themselves, the first of them the stream's sample ``first``; no temperature."""
        values = np.zeros(n)
        if n:
            self.add(values, Block(first, np.full(n, np.nan), np.empty(n)))
        return values

    def truth(self) -> dict[str, Any]:
        """What was drawn from the seed so far and the parameters do not say; nothing for plain noise."""
        return {}


class Running(ABC):
    """A transform at work on one axis."""

    @abstractmethod
    def apply(self, values: Floats) -> None:
        """Transform the next ``values.size`` samples in place."""

    def truth(self) -> dict[str, Any]:
        """What was drawn from the seed so far and the parameters do not say."""
        return {}


class Effect(ABC):
    """One named effect on one axis.

    Raises:
        ConfigError: a parameter is no finite number or outside what its field allows
    """

    __slots__ = ()

    name: ClassVar[str]
    means: ClassVar[str]  # one sentence for people

    def __post_init__(self) -> None:
        for f in fields(self):  # type: ignore[arg-type]
            _check(self.name, f.name, getattr(self, f.name), f.metadata)

    def check_axis(self, axis: str) -> None:  # noqa: B027 - most effects may be on any axis
        """ConfigError when the effect cannot be on that axis."""

    def check_rate(self, rate_hz: float) -> None:  # noqa: B027 - most effects have no frequency
        """ConfigError when samples at that rate cannot show the effect."""


class Source(Effect):
    """Adds to the rate."""

    __slots__ = ()

    uses_temperature: ClassVar[bool] = False

    @abstractmethod
    def avar(self, tau_s: Floats, tau0_s: float) -> Floats:
        """Allan variance (unit² of the axis) at averaging times ``tau_s`` of samples ``tau0_s`` apart."""

    @abstractmethod
    def psd(self, f_hz: Floats, tau0_s: float) -> Floats:
        """Two-sided spectral density, unit²/Hz, for 0 < f ≤ 1/(2 τ0); a line or a slope has none."""

    @abstractmethod
    def start(self, rate_hz: float, rng: np.random.Generator) -> Series:
        """Begin a series sampled at ``rate_hz``."""

    def spectrum(self, tau0_s: float) -> Spectrum:
        """Density, lines and slope together, as transforms take them."""
        return Spectrum(lambda f: self.psd(f, tau0_s), lambda tau: self.avar(tau, tau0_s), tau0_s)


class Leak(Effect):
    """Adds ``coefficient`` times what the axis ``source`` measures.

    What leaks is the source axis as it would read by itself: its own sources through its own transforms, before
    anything leaked into it. Axes that leak into each other therefore need no order, and nothing goes round in circles.
    """

    __slots__ = ()

    source: str
    coefficient: float


class Transform(Effect):
    """Acts on all that stands before it."""

    __slots__ = ()

    @abstractmethod
    def reshape(self, spectrum: Spectrum) -> Spectrum:
        """Spectrum and Allan variance after it; NaN where there is no closed form and no integral."""

    @abstractmethod
    def start(self, rate_hz: float, rng: np.random.Generator) -> Running:
        """Begin to act on samples at ``rate_hz``."""


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
    """A dataclass field with its units on the two kinds of axes, and what it may be: by default a number ≥ 0.

    Args:
        gyro_unit, accelerometer_unit: SI; "1" for a bare number
        signed: negative values too
        positive: not zero
        whole: no fraction
        optional: may be absent (None)
        most: not above this
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
    """A dataclass field that names another axis."""
    return field(metadata={"units": ("axis", "axis"), "axis": True})


def units(effect: type[Effect]) -> Mapping[str, tuple[str, str]]:
    """Unit of every parameter of an effect: on a gyroscope, on an accelerometer."""
    return {f.name: f.metadata["units"] for f in fields(effect)}  # type: ignore[arg-type]


def required(effect: type[Effect]) -> tuple[str, ...]:
    """Parameters that a model file must give."""
    return tuple(f.name for f in fields(effect) if f.default is MISSING)  # type: ignore[arg-type]


def below_nyquist(effect: Effect, parameter: str, rate_hz: float) -> None:
    """ConfigError when a frequency is not below half the sample rate."""
    value = getattr(effect, parameter)
    if not value < 0.5 * rate_hz:
        raise ConfigError(
            f"{effect.name}: {parameter} must be below {0.5 * rate_hz:g} Hz, half the sample rate, is {value!r}"
        )


def check_event_rate(effect: Effect, events_hz: float, rate_hz: float) -> None:
    """ConfigError when random events come more often than can be simulated."""
    if events_hz > MOST_EVENTS * rate_hz:
        raise ConfigError(
            f"{effect.name}: {events_hz:g} events a second at {rate_hz:g} Hz; at most {MOST_EVENTS:g} in a sample are "
            "possible"
        )


def first_sample(time_s: float, rate_hz: float) -> int:
    """Index of the first sample at or after a time; a millionth of a sample is rounding."""
    return ceil(time_s * rate_hz - 1e-6)


def _check(effect: str, name: str, value: Any, allows: Mapping[str, Any]) -> None:
    if allows.get("axis"):
        if value not in AXES:
            raise ConfigError(f"{effect}: {name} must be one of {', '.join(AXES)}, is {value!r}{_near(value)}")
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


def _near(value: Any) -> str:
    return nearest(value, AXES) if isinstance(value, str) else ""
