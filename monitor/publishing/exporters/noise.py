"""What there is to export, and what every format says about it in its comments.

A ``Noise`` holds Q N B K R of each axis in SI. From a model file all of them are values; from ``analyze --json`` those
with status ``estimated`` are values, those with ``upper_bound`` are marked as bounds, the others are absent. Effects
that have no letter (a line, a bias, …) are kept by name, so that a format can say that it leaves them out.
"""

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Final

import msgspec

from drivers.errors import ConfigError, ImuError, NotReady
from drivers.quantities import RATE_HZ
from drivers.sample import AXES
from monitor.noise.model import NoiseModel

EFFECT_OF: Final = {
    "Q": "quantization_noise",
    "N": "angle_random_walk",
    "B": "bias_instability",
    "K": "rate_random_walk",
    "R": "rate_ramp",
}
AXES_OF: Final = {"gyro": AXES[:3], "accel": AXES[3:]}


@dataclass(frozen=True, slots=True)
class Term:
    """One coefficient of one axis, SI."""

    value: float
    bound: bool = False  # the data show no more than that it is below this value


@dataclass(frozen=True, slots=True)
class Noise:
    """Axis -> letter -> term; axes and letters of which nothing is known are absent."""

    axes: Mapping[str, Mapping[str, Term]]
    sample_rate_hz: float | None
    source: str  # where the numbers come from, for the head of the file
    left_out: tuple[str, ...] = ()  # effects without a letter, "gz.sinusoidal"
    measured: bool = False  # from a recording: what is absent was not seen
    warnings: tuple[str, ...] = ()  # sentences for the head of the file, ASCII

    def of(self, kind: str, letter: str) -> dict[str, Term]:
        """One letter on the axes of a kind that have it."""
        return {axis: self.axes[axis][letter] for axis in AXES_OF[kind] if letter in self.axes.get(axis, {})}


def from_model(model: NoiseModel, source: str = "noise model") -> Noise:
    """The coefficients of a model; effects of one name on one axis add as variances.

    >>> model = NoiseModel.from_toml('sample_rate = 100.0\\n["g*".angle_random_walk]\\nN = 1.5e-4')
    >>> from_model(model).axes["gz"]["N"].value
    0.00015
    """
    letters = {effect: letter for letter, effect in EFFECT_OF.items()}
    axes: dict[str, dict[str, Term]] = {}
    left_out = []
    for axis, effects in model.effects.items():
        sizes: dict[str, float] = {}
        for one in effects:
            letter = letters.get(one.name)
            if letter is None:
                left_out.append(f"{axis}.{one.name}")
            else:
                sizes[letter] = math.hypot(sizes.get(letter, 0.0), getattr(one, letter))
        axes[axis] = {letter: Term(size) for letter, size in sizes.items() if size > 0.0}
    known = {axis: axes[axis] for axis in AXES if axes.get(axis)}
    return Noise(known, model.sample_rate_hz, source, tuple(left_out))


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
    schema: str
    axes: dict[str, _Axis]
    rate: float | None = None


def from_analysis(text: bytes | str, source: str = "analysis of a recording") -> Noise:
    """The coefficients that ``imu-monitor analyze --json`` wrote.

    Raises:
        ConfigError: not such a file
    """
    try:
        found = msgspec.json.decode(text, type=_Analysis)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"not the JSON of an analysis: {error}") from error
    if not found.schema.startswith("imu-monitor/analyze/"):
        raise ConfigError(f'schema "{found.schema}"; an export needs "imu-monitor/analyze/1"')
    try:
        if found.rate is not None:
            RATE_HZ.check(found.rate)
    except ConfigError as error:
        raise ConfigError(f"rate: {error}") from None
    axes: dict[str, dict[str, Term]] = {}
    for axis in (axis for axis in AXES if axis in found.axes):
        for letter, one in found.axes[axis].coefficients.items():
            if one.status == "estimated" and one.value is not None:
                axes.setdefault(axis, {})[letter] = Term(one.value)
            elif one.status == "upper_bound" and one.hi is not None:
                axes.setdefault(axis, {})[letter] = Term(one.hi, bound=True)
    warnings = tuple(
        f"{axis} follows its temperature, which explains {math.floor(100.0 * mark.share):d} % of its slow variance: "
        f"B and K of {axis} describe temperature as well as noise"
        for axis in axes
        if (mark := found.axes[axis].temperature) is not None
    )
    return Noise(axes, found.rate, source, measured=True, warnings=warnings)


def lacking(noise: Noise, text: str) -> ImuError:
    """The error to raise where the source does not say what a format needs."""
    return NotReady(f"{text}: a longer recording is needed") if noise.measured else ConfigError(text)


def head(noise: Noise, inflation: float, mark: str) -> list[str]:
    """Comments: where the numbers come from, and what was done to them."""
    source = noise.source.encode("ascii", "replace").decode()
    done = "none" if inflation == 1.0 else f"N, B and K are {inflation:g} times those of the source"
    return [
        f"{mark} source: {source}",
        f"{mark} inflation: {done}",
        *(f"{mark} WARNING: {one}" for one in noise.warnings),
    ]


def tail(noise: Noise, used: Collection[str], mark: str) -> list[str]:
    """Comment: what of the source has no place in the format."""
    letters = {letter for terms in noise.axes.values() for letter, term in terms.items() if not term.bound}
    unused = [letter for letter in EFFECT_OF if letter in letters and letter not in used]
    return [f"{mark} not in this file: {', '.join([*unused, *noise.left_out])}"] if unused or noise.left_out else []


def number(value: float) -> str:
    """Seven digits, in a form that YAML 1.1, TOML and MATLAB all read as a float.

    >>> number(1.5e-4)
    '1.500000e-04'
    """
    return f"{value:.6e}"


def text(lines: Iterable[str]) -> str:
    """The lines as a file."""
    return "\n".join(lines) + "\n"
