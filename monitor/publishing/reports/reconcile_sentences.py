"""Sentences and formatted values for the results of ``reconcile``, used by the page, the viewer and the terminal.

Functions convert the types of ``monitor.reconcile.result`` (SI) into short text. The SI unit selects the unit of the
field. The size of the number is also considered if one SI unit serves for small and large quantities, such as rad/s
for a bias and for a range. A value has as many digits as its 95 % interval allows. This module does not depend on
HTML, Rerun or a terminal.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from math import floor, isfinite, log10
from typing import Any, Final

from drivers.quantities import HOUR_S
from drivers.sample import AXES
from drivers.units import G0
from monitor.common.units import (
    COEFFICIENT_UNITS,
    DEGREE,
    DEVIATION_UNITS,
    MICRO_G,
    SAMPLE_UNITS,
    Unit,
    format_number,
    sensor_kind,
)
from monitor.noise.effects import EFFECTS
from monitor.noise.model import NoiseModel
from monitor.reconcile.result import AxisResult, Location, ParameterInterval, Reconciliation, ReconciliationStep, Score

RESULT_TEXTS: Final = {
    "agrees": "agrees",
    "explained": "explained",
    "partly_explained": "partly explained",
    "unexplained": "unexplained",
}
"""Text of each result."""
DIAGNOSTIC_NAMES: Final = {"psd": "spectrum", "allan": "Allan deviation"}
"""Names of diagnostics that differ from their identifier."""
DEGREES_PER_HOUR: Final = DEGREE * HOUR_S  # °/h per rad/s
SMALL_UNIT_BELOW: Final = 0.1  # °/s or m/s²; below it, a rate or an acceleration is shown in °/h or µg
_GYRO, _ACCEL = COEFFICIENT_UNITS["gyro"], COEFFICIENT_UNITS["accel"]
FIELD_UNITS: Final = {
    "1": Unit(1.0, ""),
    "rad": _GYRO["Q"],
    "rad/√s": _GYRO["N"],
    "rad/s/√s": _GYRO["K"],
    "rad/s²": _GYRO["R"],
    "rad/s/°C": Unit(DEGREES_PER_HOUR, "°/h/°C"),
    "rad/s/°C²": Unit(DEGREES_PER_HOUR, "°/h/°C²"),
    "rad/s per m/s²": Unit(DEGREES_PER_HOUR * G0, "°/h/g"),
    "(rad/s)²/Hz": Unit(DEGREES_PER_HOUR**2, "(°/h)²/Hz"),
    "rad²/s²/Hz": Unit(DEGREES_PER_HOUR**2, "(°/h)²/Hz"),
    "rad/s/√Hz": Unit(DEGREES_PER_HOUR, "°/h/√Hz"),
    "(rad/s)²": Unit(DEGREES_PER_HOUR**2, "(°/h)²"),
    "rad²/s²": Unit(DEGREES_PER_HOUR**2, "(°/h)²"),
    "m/s": _ACCEL["Q"],
    "m/s/√s": _ACCEL["N"],
    "m/s²/√s": _ACCEL["K"],
    "m/s³": _ACCEL["R"],
    "m/s²/°C": Unit(MICRO_G, "µg/°C"),
    "m/s²/°C²": Unit(MICRO_G, "µg/°C²"),
    "(m/s²)²/Hz": Unit(MICRO_G**2, "µg²/Hz"),
    "m²/s⁴/Hz": Unit(MICRO_G**2, "µg²/Hz"),
    "m/s²/√Hz": Unit(MICRO_G, "µg/√Hz"),
    "(m/s²)²": Unit(MICRO_G**2, "µg²"),
    "m²/s⁴": Unit(MICRO_G**2, "µg²"),
}
"""Unit of the field for each SI unit; units that are absent (Hz, s, °C) are used as they are."""
UNITS_BY_NAME: Final = {"phase": Unit(DEGREE, "°"), "fraction": Unit(100.0, "%")}
"""Units of parameters that their SI unit does not determine."""
RANGE_FORMATS: Final = {
    "frequency": ("", "Hz"),
    "tau": ("τ = ", "s"),
    "time": ("t = ", "s"),
    "temperature": ("", "°C"),
}
"""Prefix and unit of each kind of range."""
MIN_RANGE_SHARE: Final = 1e-3  # a range narrower than this share of its position is written as one number
SYMMETRY_TOLERANCE: Final = 0.1  # sides of an interval that differ by less than this share are written as ±


@dataclass(frozen=True, slots=True)
class Parameter:
    """Text of one parameter; unknown parts are empty."""

    name: str
    value: str  # "30.94", "ax"
    interval: str  # "30.4 … 31.5", the 95 % interval
    short: str  # "30.94 ± 0.55 °/h", with its unit
    unit: str  # "°/h"
    given: str  # value in the model under test, if the model has the effect exactly once


def field_unit(si: str, size: float) -> Unit:
    """Return the unit of the field for a quantity of this size.

    >>> field_unit("rad/s", 1e-4).name, field_unit("rad/s", 5.0).name, field_unit("Hz", 17.0).name
    ('°/h', '°/s', 'Hz')

    Parameters
    ----------
    si
        SI unit.
    size
        Size of the quantity in the SI unit.
    """
    for kind, unit in (("gyro", "rad/s"), ("accel", "m/s²")):
        if si == unit:
            large = SAMPLE_UNITS[kind]  # type: ignore[index]
            return DEVIATION_UNITS[kind] if abs(size) * large.factor < SMALL_UNIT_BELOW else large  # type: ignore[index]
    return FIELD_UNITS.get(si, Unit(1.0, si))


def words_of(name: str) -> str:
    """Return the name of an effect or a parameter with spaces instead of underscores."""
    return name.replace("_", " ")


def diagnostic_name(lens: str) -> str:
    """Return the name of a diagnostic for the user."""
    return DIAGNOSTIC_NAMES.get(lens, words_of(lens))


def percent(share: float) -> str:
    """Format a probability; values near 0 and 1 are written as inequalities.

    >>> percent(0.998), percent(0.99999), percent(0.0002)
    ('99.8 %', '> 99.9 %', '< 0.1 %')
    """
    if not isfinite(share):
        return "—"
    if share > 0.999:
        return "> 99.9 %"
    return "< 0.1 %" if share < 0.001 else f"{100.0 * share:.1f} %"


def span(low: float, high: float, unit: str) -> str:
    """Format a range along one diagnostic.

    >>> span(17.1, 17.5, "Hz"), span(1800.0, 1800.5, "s")
    ('17.1 … 17.5 Hz', '1800 s')

    Parameters
    ----------
    low, high
        Ends of the range.
    unit
        Name of the unit.
    """
    if not abs(high - low) > MIN_RANGE_SHARE * max(abs(low), abs(high)):
        return f"{_short(0.5 * (low + high))} {unit}".rstrip()
    return f"{_short(low)} … {_short(high)} {unit}".rstrip()


def format_range(where: Location, axis: str) -> str:
    """Format the range in which a diagnostic found a gap; "everywhere" if no range is given.

    >>> format_range(Location(tau=(1.0, 4.0), source="ax"), "gz")
    'τ = 1 … 4 s, from ax'

    Parameters
    ----------
    where
        The range.
    axis
        Name of the axis, which selects the units.
    """
    found = []
    for name, at in where.found().items():
        if isinstance(at, str):
            found.append(f"from {at}")
        elif name == "value":
            unit = field_unit("rad/s" if sensor_kind(axis) == "gyro" else "m/s²", max(map(abs, at)))
            found.append(span(at[0] * unit.factor, at[1] * unit.factor, unit.name))
        else:
            sign, unit_name = RANGE_FORMATS[name]
            found.append(sign + span(*at, unit_name))
    return ", ".join(found) or "everywhere"


def score_line(one: Score, axis: str) -> str:
    """Return one line with the diagnostic, its range, its gap and its threshold.

    Parameters
    ----------
    one
        Gap of a diagnostic.
    axis
        Name of the axis, which selects the units.
    """
    gap = f"gap {format_gap(one.gap)}, threshold {format_gap(one.threshold)}"
    return f"{diagnostic_name(one.lens)}, {format_range(one.where, axis)}: {gap}"


def format_gap(size: float) -> str:
    """Format the size of a gap.

    >>> format_gap(0.6), format_gap(41.23), format_gap(12345.0)
    ('0.60', '41.2', '12300')
    """
    if not isfinite(size) or size >= 1000.0:
        return format_number(size)
    return f"{size:.2f}" if size < 10.0 else f"{size:.1f}"


def gap_ratio(one: Score) -> float:
    """Return gap divided by threshold; 0 if the ratio is not finite."""
    share = one.gap / one.threshold if one.threshold > 0.0 else 0.0
    return share if isfinite(share) else 0.0


def parameters(step: ReconciliationStep, axis: str, baseline: NoiseModel) -> tuple[Parameter, ...]:
    """Return the text of all parameters of a step; for a changed term, also its value in the model under test.

    Parameters
    ----------
    step
        Step of the reconciliation.
    axis
        Name of the axis.
    baseline
        Model under test.
    """
    known = [effect for effect in baseline.effects.get(axis, ()) if effect.name == step.effect]
    given = known[0] if len(known) == 1 and step.kind == "retuned" else None
    return tuple(
        _parameter(step.effect, name, bounds, axis, getattr(given, name, None))
        for name, bounds in step.parameters.items()
    )


def step_line(step: ReconciliationStep, axis: str, baseline: NoiseModel) -> str:
    """Return one line with an effect and its parameters.

    Example: "sinusoidal: amplitude 30.94 ± 0.55 °/h, frequency 17.30000 ± 0.00010 Hz".

    Parameters
    ----------
    step
        Step of the reconciliation.
    axis
        Name of the axis.
    baseline
        Model under test.
    """
    said = [f"{words_of(one.name)} {one.short}" for one in parameters(step, axis, baseline)]
    return f"{words_of(step.effect)}: {', '.join(said)}" if said else words_of(step.effect)


def summary(r: Reconciliation) -> str:
    """Return the result of the whole recording in one or two sentences."""
    differ = [axis for axis in AXES if axis in r.axes and r.axes[axis].verdict != "agrees"]
    open_axes = [axis for axis in differ if r.axes[axis].left_over]
    named = [step for axis in differ for step in r.axes[axis].steps]
    model = "The five classic terms, fitted first," if r.fitted_first else "The model"
    if r.verdict == "agrees":
        many = "one axis" if len(r.axes) == 1 else f"each of {len(r.axes)} axes"
        return f"{model} and the recording agree: on {many}, through every lens, they differ by no more than chance."
    head = f"{model} and the recording differ by more than chance on {_listed(differ)}."
    if r.verdict == "unexplained":
        return f"{head} No known effect closes the gap, so no name is given."
    if r.verdict == "partly_explained":
        tail = f"is explained in part; on {_listed(open_axes)} something is left that no known effect closes."
        return f"{head} With {_listed(_counted(named))}, it {tail}"
    return f"{head} With {_listed(_counted(named))}, nothing is left that chance would not make."


def verdict_line(result: AxisResult) -> str:
    """Return the result of one axis in a sentence."""
    match result.verdict:
        case "agrees":
            return "Model and measurement differ by no more than chance, through every lens."
        case "explained":
            return "After the last step nothing is left that chance would not make."
        case "partly_explained":
            return "The steps below are kept, and something is left that no known effect closes."
        case "unexplained":
            return "Model and measurement differ, and no known effect closes the gap: no name is given."


def alternatives_sentence(step: ReconciliationStep) -> str:
    """Return a sentence on the effects that were also tried, with their probabilities."""
    if not step.runners_up:
        return "No other effect came near."
    tried = [f"{words_of(one.effect)} ({percent(one.confidence)})" for one in step.runners_up]
    return f"Tried for the same gap and less likely: {_listed(tried)}."


def _parameter(effect: str, name: str, bounds: ParameterInterval, axis: str, given: Any) -> Parameter:
    """Return the text of one parameter."""
    if isinstance(bounds.value, str):
        return Parameter(name, bounds.value, "", bounds.value, "", "" if given is None else str(given))
    known = {f.name: f.metadata for f in fields(EFFECTS[effect])}[name]  # type: ignore[arg-type]
    unit = UNITS_BY_NAME.get(name) or field_unit(known["units"][0 if sensor_kind(axis) == "gyro" else 1], bounds.value)
    was = "" if given is None else f"{format_number(given * unit.factor)} {unit.name}".rstrip()
    value, lo, hi = (None if one is None else one * unit.factor for one in (bounds.value, bounds.lo, bounds.hi))
    assert value is not None
    if known["whole"]:
        return Parameter(name, f"{value:.0f}", "", f"{value:.0f} {unit.name}".rstrip(), unit.name, was)
    if lo is None or hi is None or not (isfinite(lo) and isfinite(hi)) or hi <= lo:
        return Parameter(name, format_number(value), "", f"{format_number(value)} {unit.name}".rstrip(), unit.name, was)
    texts = _with_interval(value, lo, hi)
    short, interval = _plus_minus(value, lo, hi, texts), f"{texts[1]} … {texts[2]}"
    return Parameter(name, texts[0], interval, f"{short} {unit.name}".rstrip(), unit.name, was)


def _plus_minus(value: float, lo: float, hi: float, texts: Sequence[str]) -> str:
    """Format a value with ±, or with both ends if its interval is asymmetric."""
    below, above = value - lo, hi - value
    if abs(above - below) > SYMMETRY_TOLERANCE * (above + below):
        return f"{texts[0]} ({texts[1]} … {texts[2]})"
    return f"{texts[0]} ± {texts[3]}"


def _with_interval(value: float, lo: float, hi: float) -> tuple[str, ...]:
    """Format value, lo, hi and half the width of the interval to the second digit of the half width."""
    half = 0.5 * (hi - lo)
    decimals = 1 - floor(log10(half))
    if 0 <= decimals <= 9 and max(map(abs, (value, lo, hi))) < 1e6:
        return tuple(f"{one:.{decimals}f}".replace("-", "−") for one in (value, lo, hi, half))
    digits = max(3, 2 + floor(log10(max(abs(value), half) / half)))
    ends = (format_number(one, digits).replace("-", "−") for one in (value, lo, hi))
    return (*ends, format_number(half, 2))


def _short(value: float) -> str:
    """Format a number with at most four digits and without trailing zeros."""
    text = f"{value:.4g}" if 1e-4 <= abs(value) < 1e5 or value == 0.0 else format_number(value)
    return text.replace("-", "−", 1) if value < 0.0 else text


def _counted(steps: Sequence[ReconciliationStep]) -> list[str]:
    """Return the numbers of added effects and of changed terms, with their names."""
    said = []
    for kind, one, many in (
        ("added", "effect added", "effects added"),
        ("retuned", "known term retuned", "known terms retuned"),
    ):
        names = [words_of(step.effect) for step in steps if step.kind == kind]
        if names:
            said.append(f"{len(names)} {one if len(names) == 1 else many} ({_listed(list(dict.fromkeys(names)))})")
    return said


def _listed(words: Sequence[str]) -> str:
    """Join words with commas and "and".

    >>> _listed(["gx"]), _listed(["gx", "gy", "gz"])
    ('gx', 'gx, gy and gz')
    """
    return " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else "".join(words)
