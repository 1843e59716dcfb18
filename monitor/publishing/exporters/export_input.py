"""Noise coefficients to export, and comments that all export formats share.

The coefficients come from a noise model or from the output of ``analyze --json``. A comment in the exported file lists
the noise effects that the file cannot represent, such as a spectral line.
"""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Final

import msgspec

from drivers.data_types import AXES
from drivers.errors import ConfigError, ImuError, NotReady
from drivers.validation.number_ranges import DURATION_S, RATE_HZ
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
    bound: bool = False  # True if the value is a one-sided 95 % upper bound
    interval: tuple[float, float] | None = None  # 95 % interval of the value, if it is known

    def format_value_or_bound(self) -> str:
        """Describe the value in ASCII, with its 95 % interval or as an upper bound.

        >>> AxisCoefficientOrBound(1.5e-4, interval=(1.4e-4, 1.6e-4)).format_value_or_bound()
        '0.00015 (95 % interval 0.00014 to 0.00016)'
        """
        if self.bound:
            return f"<= {self.value:.3g} (one-sided 95 % bound)"
        interval = self.interval and f" (95 % interval {self.interval[0]:.3g} to {self.interval[1]:.3g})"
        return f"{self.value:.3g}{interval or ''}"


@dataclass(frozen=True, slots=True)
class NoiseCoefficients:
    """Known noise coefficients by axis and symbol."""

    axes: Mapping[str, Mapping[str, AxisCoefficientOrBound]]
    sample_rate_hz: float | None
    source: str  # source of the coefficients, for the header of the file
    left_out: tuple[str, ...] = ()  # effects that no coefficient represents, such as "gz.sinusoidal"
    measured: bool = False  # True if the coefficients come from a recording
    remarks: tuple[str, ...] = ()  # ASCII remarks for the header of the file

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
    lo: float | None = None


_Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]


class _Temperature(msgspec.Struct):
    share: _Share


class _WithoutTemperature(msgspec.Struct):
    model: str
    coefficients: dict[str, _Coefficient]


class _Axis(msgspec.Struct):
    coefficients: dict[str, _Coefficient]
    temperature: _Temperature | None = None
    without_temperature: _WithoutTemperature | None = None


class _Schema(msgspec.Struct):
    schema: str


class _Analysis(msgspec.Struct):
    """Keys of the JSON output of ``analyze`` that an export needs."""

    axes: dict[str, _Axis]
    rate: float | None = None


class _CoefficientsMessage(msgspec.Struct):
    """Keys of the message ``imu/<device>/coefficients`` of a daemon that an export needs."""

    axes: dict[str, dict[str, _Coefficient]]
    rate: float | None = None
    temperature_shares: dict[str, _Share] = msgspec.field(default_factory=dict)

    def to_analysis(self) -> _Analysis:
        """Return the coefficients of each axis, with the share of temperature if its dependence is significant."""
        shares = {axis: share for axis, share in self.temperature_shares.items() if share > 0.0}
        temperature = {axis: _Temperature(share) for axis, share in shares.items()}
        return _Analysis({axis: _Axis(terms, temperature.get(axis)) for axis, terms in self.axes.items()}, self.rate)


def from_analysis_json(json_text: bytes | str, source: str = "analysis of a recording") -> NoiseCoefficients:
    """Read noise coefficients from the output of ``imu-monitor analyze --json`` or from a message of a daemon.

    Parameters
    ----------
    json_text
        Output of ``imu-monitor analyze --json``, or message ``imu/<device>/coefficients``.
    source
        Source of the coefficients, for the header of the file.

    Raises
    ------
    ConfigError
        If the text is neither of these, or if the sample rate is outside the supported range.
    """
    try:
        schema = msgspec.json.decode(json_text, type=_Schema).schema
        if schema.startswith("imu-monitor/coefficients/"):
            message = msgspec.json.decode(json_text, type=_CoefficientsMessage)
            found, checked = message.to_analysis(), set(message.temperature_shares)
        elif schema.startswith("imu-monitor/analyze/"):
            found = msgspec.json.decode(json_text, type=_Analysis)
            checked = set(found.axes)
        else:
            raise ConfigError(
                f'schema "{schema}"; an export needs "imu-monitor/analyze/1" or "imu-monitor/coefficients/1"'
            )
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"not the JSON of an analysis: {error}") from error
    try:
        if found.rate is not None:
            RATE_HZ.check(found.rate)
    except ConfigError as error:
        raise ConfigError(f"rate: {error}") from None
    axes: dict[str, dict[str, AxisCoefficientOrBound]] = {}
    remarks: list[str] = []
    for axis in (axis for axis in AXES if axis in found.axes):
        one = found.axes[axis]
        terms, without = _known_coefficients(one.coefficients), one.without_temperature
        corrected = {} if without is None else _known_coefficients(without.coefficients)
        if terms or corrected:
            axes[axis] = terms | corrected
        if without is not None and corrected:
            remarks.append(
                f"{axis} follows its temperature: {_join_letters(corrected)} of {axis} without its effect "
                f"({without.model})"
            )
        affected = [letter for letter in "BK" if letter in terms and letter not in corrected]
        if one.temperature is not None and affected:
            share = math.floor(100.0 * one.temperature.share)
            remarks.append(
                f"WARNING: {axis} follows its temperature, which explains {share:d} % of its slow variance and is part "
                f"of {_join_letters(affected)} of {axis}"
            )
    unchecked = [axis for axis, terms in axes.items() if axis not in checked and terms.keys() & {"B", "K"}]
    if unchecked:
        remarks.append(f"not checked for temperature: B and K of {', '.join(unchecked)}; no live thermal model")
    return NoiseCoefficients(axes, found.rate, source, measured=True, remarks=tuple(remarks))


def join_sources(sources: Sequence[NoiseCoefficients]) -> NoiseCoefficients:
    """Join the coefficients of different axes, such as those of a gyroscope and an accelerometer recorded separately.

    Parameters
    ----------
    sources
        Coefficients of one or several results or models. The first one determines the sample rate.

    Raises
    ------
    ConfigError
        If two of them contain the same axis.
    """
    first, *others = sources
    axes = dict(first.axes)
    for one in others:
        if both := [axis for axis in AXES if axis in axes and axis in one.axes]:
            raise ConfigError(f"{one.source}: {', '.join(both)} in another source too; each axis may be in one only")
        axes |= one.axes
    remarks = [remark for one in sources for remark in one.remarks]
    if len({one.sample_rate_hz for one in sources}) > 1:
        rates = ", ".join(f"{one.source} {one.sample_rate_hz or math.nan:g} Hz" for one in sources)
        remarks.append(f"the sample rates differ ({rates}); that of the first is used")
    return NoiseCoefficients(
        {axis: axes[axis] for axis in AXES if axis in axes},
        first.sample_rate_hz,
        " and ".join(one.source for one in sources),
        tuple(dict.fromkeys(effect for one in sources for effect in one.left_out)),
        all(one.measured for one in sources),
        tuple(remarks),
    )


def describe_weak_points(noise: NoiseCoefficients) -> list[str]:
    """Return sentences about axes that were not measured, and about upper bounds that stand for values.

    The bound of K is inversely proportional to the length of a recording of white noise, and the bound of B to its
    square root.
    """
    if not noise.measured:
        return []
    found = []
    if absent := [axis for axis in AXES if "N" not in noise.axes.get(axis, {})]:
        found.append(f"not measured: {', '.join(absent)}")
    bounds = [
        f"{letter} ({', '.join(those)})"
        for letter in "NBK"
        if (those := [axis for axis in noise.axes if letter in noise.axes[axis] and noise.axes[axis][letter].bound])
    ]
    if bounds:
        found.append(
            f"upper bounds instead of values: {', '.join(bounds)}; a recording 4 times as long would lower those of K "
            "up to 4 times and those of B up to 2 times"
        )
    return found


def _known_coefficients(coefficients: Mapping[str, _Coefficient]) -> dict[str, AxisCoefficientOrBound]:
    """Return the coefficients that are estimated or bounded."""
    known = {}
    for letter, one in coefficients.items():
        if one.status == "estimated" and one.value is not None:
            interval = None if one.lo is None or one.hi is None else (one.lo, one.hi)
            known[letter] = AxisCoefficientOrBound(one.value, interval=interval)
        elif one.status == "upper_bound" and one.hi is not None:
            known[letter] = AxisCoefficientOrBound(one.hi, bound=True)
    return known


def _join_letters(letters: Collection[str]) -> str:
    return " and ".join(", ".join(letters).rsplit(", ", 1))


def missing_coefficient_error(noise: NoiseCoefficients, message: str) -> ImuError:
    """Return the exception for a missing coefficient: NotReady for a recording, ConfigError for a noise model.

    Parameters
    ----------
    noise
        Coefficients of the recording or the noise model.
    message
        Text of the exception.
    """
    if noise.measured:
        return NotReady(f"{message}: a longer recording is needed")
    return ConfigError(f"{message}, and the model has none; add it to the model, or export the JSON of analyze")


def choose_time_step_s(noise: NoiseCoefficients, dt_s: float | None, format_name: str) -> float:
    """Return the time step of the target program [s].

    Parameters
    ----------
    noise
        Noise coefficients, whose sample period is the default.
    dt_s
        Time step that the user has given, or None.
    format_name
        Name of the export format, for error messages.

    Raises
    ------
    ConfigError
        If the time step is unknown or outside the supported range.
    """
    step_s = 1.0 / noise.sample_rate_hz if dt_s is None and noise.sample_rate_hz else dt_s
    if step_s is None or not DURATION_S.supports(step_s):
        raise ConfigError(
            f"{format_name} needs a time step of {DURATION_S.format_range()}: the model's sample_rate, or one that is "
            "given"
        )
    return step_s


def find_worst_axis(
    noise: NoiseCoefficients, kind: Kind, letter: str, format_name: str
) -> tuple[AxisCoefficientOrBound, str]:
    """Return the largest coefficient of the three axes, and a comment that names the axis and its 95 % interval.

    An estimate takes precedence over an upper bound. If no axis has an estimate, the largest bound is returned.

    Parameters
    ----------
    noise
        Noise coefficients to export.
    kind
        Kind of sensor: gyro or accel.
    letter
        Symbol of the coefficient: N or K.
    format_name
        Name of the file format, for the error message.

    Raises
    ------
    ConfigError
        If the noise model has no such coefficient.
    NotReady
        If the recording is too short to determine the coefficient.
    """
    known = noise.coefficient_by_axis(kind, letter)
    if not known:
        raise missing_coefficient_error(
            noise, f"{format_name} needs {letter} ({COEFFICIENT_EFFECTS[letter].name}) above 0 on the {kind} axes"
        )
    rank = {axis: (not term.bound, term.value) for axis, term in known.items()}
    axis = max(rank, key=lambda one: rank[one])
    listed = ", ".join(f"{one} {'<= ' if term.bound else ''}{term.value:.3g}" for one, term in known.items())
    only = ", UPPER BOUND instead of a value" if known[axis].bound else ""
    alike = len(known) > 1 and len(set(rank.values())) == 1
    return known[
        axis
    ], f"{'all axes alike' if alike else f'worst axis {axis}'}{only} ({listed}): {known[axis].format_value_or_bound()}"


def describe_coefficients(terms: Mapping[str, AxisCoefficientOrBound], letters: str) -> str:
    """Describe the coefficients of one axis in ASCII, with their 95 % intervals.

    >>> describe_coefficients({"N": AxisCoefficientOrBound(2e-4), "K": AxisCoefficientOrBound(9e-6, bound=True)}, "NBK")
    'N 0.0002, B unknown, K <= 9e-06 (one-sided 95 % bound)'

    Parameters
    ----------
    terms
        Coefficients of the axis by symbol.
    letters
        Symbols to describe.
    """
    return ", ".join(f"{one} {terms[one].format_value_or_bound() if one in terms else 'unknown'}" for one in letters)


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
    source = " ".join(noise.source.encode("ascii", "replace").decode().split())  # a line break would end the comment
    done = "none" if inflation == 1.0 else f"N, B and K are {inflation:g} times the values of the source"
    return [
        f"{comment_sign} source: {source}",
        f"{comment_sign} inflation: {done}",
        *(f"{comment_sign} {one}" for one in noise.remarks),
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
