"""An effect of an IMU's noise, written once: its Allan variance, its spectrum and its time series.

A ``Source`` is a frozen dataclass of parameters with units. It answers for the sampled series it
simulates, so that fit, simulator and comparison share one physics: ``avar`` is the overlapping
Allan variance of samples ``tau0_s`` apart, ``psd`` their two-sided spectrum up to half the sample
rate. ``start`` begins an endless series drawn in blocks of any size; the series depends on the
random generator only, not on the blocks, and its memory does not grow.

No effect opens anything, reads a clock or keeps global random state.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import field, fields
from math import isfinite
from typing import Any, ClassVar, Protocol

import numpy as np

from drivers.errors import ConfigError
from drivers.sample import Floats


class Series(Protocol):
    """A time series that goes on for as long as it is asked."""

    def draw(self, n: int) -> Floats:
        """The next ``n`` samples, in the unit of the axis."""
        ...


class Source(ABC):
    """One additive effect on one axis."""

    name: ClassVar[str]
    means: ClassVar[str]  # one sentence for people

    @abstractmethod
    def avar(self, tau_s: Floats, tau0_s: float) -> Floats:
        """Allan variance (unit² of the axis) at averaging times ``tau_s`` of samples ``tau0_s`` apart."""

    @abstractmethod
    def psd(self, f_hz: Floats, tau0_s: float) -> Floats:
        """Two-sided spectral density, unit²/Hz, for 0 < f ≤ 1/(2 τ0)."""

    @abstractmethod
    def start(self, rate_hz: float, rng: np.random.Generator) -> Series:
        """Begin a series sampled at ``rate_hz``."""


def parameter(gyro_unit: str, accelerometer_unit: str, *, signed: bool = False) -> Any:
    """A dataclass field with its SI units on the two kinds of axes; ``signed`` allows negative values."""
    return field(metadata={"units": (gyro_unit, accelerometer_unit), "signed": signed})


def units(source: type[Source]) -> Mapping[str, tuple[str, str]]:
    """Unit of every parameter of an effect: on a gyroscope, on an accelerometer."""
    return {f.name: f.metadata["units"] for f in fields(source)}  # type: ignore[arg-type]


def check_parameters(source: Source) -> None:
    """ConfigError when a parameter is not a finite number, or negative where it is a size."""
    for f in fields(source):  # type: ignore[arg-type]
        value = getattr(source, f.name)
        if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
            raise ConfigError(f"{source.name}: {f.name} must be a finite number, is {value!r}")
        if value < 0.0 and not f.metadata["signed"]:
            raise ConfigError(f"{source.name}: {f.name} must not be negative, is {value!r}")
