"""Noise coefficients to export, and comments that all export formats share.

The coefficients come from a noise model or from the output of ``analyze --json``. A comment in the exported file lists
the noise effects that the file cannot represent, such as a spectral line.
"""

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Final

import msgspec

from drivers.data_types import AXES
from drivers.errors import ConfigError, ImuError, NotReady
from drivers.number_ranges import RATE_HZ
from monitor.common.unit_formatting import KINDS, Kind, axes_of
from monitor.noise.effect import Source, gyro_and_accel_units
from monitor.noise.effects import AngleRandomWalk, BiasInstability, QuantizationNoise, RateRamp, RateRandomWalk
from monitor.noise.model import NoiseModel

COEFFICIENT_EFFECTS: Final[dict[str, type[Source]]] = {
    "Q": QuantizationNoise,
    "N": AngleRandomWalk,
    "B": BiasInstability,
    "K": RateRandomWalk,
    "R": RateRamp,
}
"""Class of the noise effect that each coefficient describes."""


def ascii_unit(letter: str, kind: Kind) -> str:
    """Return the SI unit of a noise coefficient in ASCII.

    >>> ascii_unit("K", "gyro"), ascii_unit("R", "accel")
    ('rad/s/sqrt(s)', 'm/s^3')

    Parameters
    ----------
        letter
        Symbol of the coefficient: Q, N, B, K or R.
    kind
        Kind of sensor: gyro or accel.
    """
    unit = gyro_and_accel_units(COEFFICIENT_EFFECTS[letter])[letter][KINDS.index(kind)]
    return unit.replace("√s", "sqrt(s)").replace("²", "^2").replace("³", "^3")


@dataclass(frozen=True, slots=True)
class AxisCoefficientOrBound:
    """Noise coefficient of one axis in SI units, as a value or an upper bound."""

    value: float
    bound: bool = False  # True if the value is an upper bound


@dataclass(frozen=True, slots=True)
class NoiseCoefficients:
    """Known noise coefficients by axis and symbol."""

    axes: Mapping[str, Mapping[str, AxisCoefficientOrBound]]
    sample_rate_hz: float | None
    source: str  # source of the coefficients, for the header of the file
    left_out: tuple[str, ...] = ()  # effects that no coefficient represents, such as "gz.sinusoidal"
    measured: bool = False  # True if the coefficients come from a recording
    warnings: tuple[str, ...] = ()  # ASCII warnings for the header of the file

    def coefficient_by_axis(self, kind: Kind, letter: str) -> dict[str, AxisCoefficientOrBound]:
        """Return the noise coefficient with the given symbol for each axis on which it is known.

        Parameters
        ----------
        kind
            Kind of sensor: gyro or accel.
        letter
            Symbol of the coefficient: Q, N, B, K or R.
        """
        return {axis: self.axes[axis][letter] for axis in axes_of(kind) if letter in self.axes.get(axis, {})}


def from_model(model: NoiseModel, source: str = "noise model") -> NoiseCoefficients:
    """Return the coefficients of a noise model. The variances of equal effects on one axis are added.

    >>> model = NoiseModel.from_toml('sample_rate = 100.0\\n["g*".angle_random_walk]\\nN = 1.5e-4')
    >>> from_model(model).axes["gz"]["N"].value
    0.00015

    Parameters
    ----------
        model
        Noise model with the effects of each axis.
    source
        Source of the coefficients, for the header of the file.
    """
    letters = {effect.name: letter for letter, effect in COEFFICIENT_EFFECTS.items()}
    axes: dict[str, dict[str, AxisCoefficientOrBound]] = {}
    left_out = []
    for axis, effects in model.effects.items():
        sizes: dict[str, float] = {}
        for one in effects:
            letter = letters.get(one.name)
            if letter is None:
                left_out.append(f"{axis}.{one.name}")
            else:
                sizes[letter] = math.hypot(sizes.get(letter, 0.0), getattr(one, letter))
        axes[axis] = {letter: AxisCoefficientOrBound(size) for letter, size in sizes.items() if size > 0.0}
    known = {axis: axes[axis] for axis in AXES if axes.get(axis)}
    return NoiseCoefficients(known, model.sample_rate_hz, source, tuple(left_out))


class _Coefficient(msgspec.Struct):
    value: float | None
    hi: float | None
    status: str


class _Temperature(msgspec.Struct):
    share: float


class _Axis(msgspec.Struct):
    coefficients: dict[str, _Coefficient]
    temperature: _Temperature | None = None


class _Analysis(msgspec.Struct):
    """Keys of the JSON output of ``analyze`` that an export needs."""

    schema: str
    axes: dict[str, _Axis]
    rate: float | None = None


def from_analysis_json(json_text: bytes | str, source: str = "analysis of a recording") -> NoiseCoefficients:
    """Read noise coefficients from the output of ``imu-monitor analyze --json``.

    Parameters
    ----------
        json_text
        Output of ``imu-monitor analyze --json``.
    source
        Source of the coefficients, for the header of the file.

    Raises
    ------
    ConfigError
        If the text is not the output of ``analyze --json``, or if the sample rate is outside the supported range.
    """
    try:
        found = msgspec.json.decode(json_text, type=_Analysis)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"not the JSON of an analysis: {error}") from error
    if not found.schema.startswith("imu-monitor/analyze/"):
        raise ConfigError(f'schema "{found.schema}"; an export needs "imu-monitor/analyze/1"')
    try:
        if found.rate is not None:
            RATE_HZ.check(found.rate)
    except ConfigError as error:
        raise ConfigError(f"rate: {error}") from None
    axes: dict[str, dict[str, AxisCoefficientOrBound]] = {}
    for axis in (axis for axis in AXES if axis in found.axes):
        for letter, one in found.axes[axis].coefficients.items():
            if one.status == "estimated" and one.value is not None:
                axes.setdefault(axis, {})[letter] = AxisCoefficientOrBound(one.value)
            elif one.status == "upper_bound" and one.hi is not None:
                axes.setdefault(axis, {})[letter] = AxisCoefficientOrBound(one.hi, bound=True)
    warnings = tuple(
        f"{axis} follows its temperature, which explains {math.floor(100.0 * mark.share):d} % of its slow variance: "
        f"B and K of {axis} describe temperature as well as noise"
        for axis in axes
        if (mark := found.axes[axis].temperature) is not None
    )
    return NoiseCoefficients(axes, found.rate, source, measured=True, warnings=warnings)


def missing_coefficient_error(noise: NoiseCoefficients, message: str) -> ImuError:
    """Return the exception for a missing coefficient: NotReady for a recording, ConfigError for a noise model.

    Parameters
    ----------
    noise
        Coefficients of the recording or the noise model.
    message
        Text of the exception.
    """
    return NotReady(f"{message}: a longer recording is needed") if noise.measured else ConfigError(message)


def header_comments(noise: NoiseCoefficients, inflation: float, comment_sign: str) -> list[str]:
    """Return comment lines that state the source of the coefficients, the inflation factor and warnings.

    Parameters
    ----------
    noise
        Noise coefficients to export.
    inflation
        Factor that multiplies N, B and K.
    comment_sign
        Characters that begin a comment in the file.
    """
    source = noise.source.encode("ascii", "replace").decode()
    done = "none" if inflation == 1.0 else f"N, B and K are {inflation:g} times the values of the source"
    return [
        f"{comment_sign} source: {source}",
        f"{comment_sign} inflation: {done}",
        *(f"{comment_sign} WARNING: {one}" for one in noise.warnings),
    ]


def comment_on_omitted_terms(
    noise: NoiseCoefficients, represented_letters: Collection[str], comment_sign: str
) -> list[str]:
    """Return comment lines that list the noise terms that the export format cannot represent.

    Parameters
    ----------
    noise
        Noise coefficients to export.
    represented_letters
        Symbols of the coefficients that the export format represents.
    comment_sign
        Characters that begin a comment in the file.
    """
    letters = {letter for terms in noise.axes.values() for letter, term in terms.items() if not term.bound}
    unused = [letter for letter in COEFFICIENT_EFFECTS if letter in letters and letter not in represented_letters]
    return (
        [f"{comment_sign} not in this file: {', '.join([*unused, *noise.left_out])}"]
        if unused or noise.left_out
        else []
    )


def format_float(value: float) -> str:
    """Format a number with seven digits, so that YAML 1.1, TOML and MATLAB read it as a float.

    >>> format_float(1.5e-4)
    '1.500000e-04'
    """
    return f"{value:.6e}"


def join_lines(lines: Iterable[str]) -> str:
    """Join lines with newline characters, and end the text with a newline character."""
    return "\n".join(lines) + "\n"
