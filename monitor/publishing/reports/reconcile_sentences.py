"""What ``reconcile`` found, in words and in the field's units: page, viewer and terminal take their sentences here.

In come the types of ``monitor.reconcile.result`` (SI), out go short texts. A unit is chosen by the SI unit and,
where one SI unit serves for small and large things (rad/s: a bias and a range), by the size of the number. A value is
written with as many digits as its 95 % interval allows. Nothing here knows HTML, Rerun or a terminal.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from math import floor, isfinite, log10
from typing import Any, Final

from drivers.sample import AXES
from monitor.noise.effects import EFFECTS
from monitor.noise.model import NoiseModel
from monitor.publishing.coefficient_cells import (
    COEFFICIENT_UNITS,
    DEGREE,
    DEVIATION_UNITS,
    HOUR,
    MICRO_G,
    SAMPLE_UNITS,
    Unit,
    kind_of,
    number,
)
from monitor.reconcile.result import AxisResult, Bounds, Reconciliation, Score, Step, Where

VERDICTS: Final = {
    "agrees": "agrees",
    "explained": "explained",
    "partly_explained": "partly explained",
    "unexplained": "unexplained",
}
LENSES: Final = {"psd": "spectrum", "allan": "Allan deviation"}
"""Lenses whose name is not a word."""
GRAVITY: Final = 9.80665  # m/s², standard (CGPM 1901)
TURN_H: Final = DEGREE * HOUR  # °/h in a rad/s
SMALL: Final = 0.1  # of a °/s or m/s²: below, sizes of a rate or an acceleration stand in °/h or µg
_GYRO, _ACCEL = COEFFICIENT_UNITS["gyro"], COEFFICIENT_UNITS["accel"]
UNITS: Final = {
    "1": Unit(1.0, ""),
    "rad": _GYRO["Q"],
    "rad/√s": _GYRO["N"],
    "rad/s/√s": _GYRO["K"],
    "rad/s²": _GYRO["R"],
    "rad/s/°C": Unit(TURN_H, "°/h/°C"),
    "rad/s/°C²": Unit(TURN_H, "°/h/°C²"),
    "rad/s per m/s²": Unit(TURN_H * GRAVITY, "°/h/g"),
    "(rad/s)²/Hz": Unit(TURN_H**2, "(°/h)²/Hz"),
    "rad²/s²/Hz": Unit(TURN_H**2, "(°/h)²/Hz"),
    "rad/s/√Hz": Unit(TURN_H, "°/h/√Hz"),
    "(rad/s)²": Unit(TURN_H**2, "(°/h)²"),
    "rad²/s²": Unit(TURN_H**2, "(°/h)²"),
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
"""SI unit -> field unit; what is not here (Hz, s, °C) is the field's own."""
BY_NAME: Final = {"phase": Unit(DEGREE, "°"), "fraction": Unit(100.0, "%")}
"""Parameters whose unit their SI unit alone does not tell."""
PLACES: Final = {
    "frequency": ("", "Hz"),
    "tau": ("τ = ", "s"),
    "time": ("t = ", "s"),
    "temperature": ("", "°C"),
}
ONE_PLACE: Final = 1e-3  # a span narrower than this share of its place is written as one number
EVEN: Final = 0.1  # interval's sides that differ by less than this share are one ±


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter as a person reads it; texts without what is not known are empty."""

    name: str
    value: str  # "30.94", "ax"
    interval: str  # "30.4 … 31.5": 95 %
    short: str  # "30.94 ± 0.55 °/h", with its unit
    unit: str  # "°/h"
    given: str  # in the model under test, where that has the effect once


def field_unit(si: str, size: float) -> Unit:
    """The unit in which people write something of ``size`` in an SI unit.

    >>> field_unit("rad/s", 1e-4).name, field_unit("rad/s", 5.0).name, field_unit("Hz", 17.0).name
    ('°/h', '°/s', 'Hz')
    """
    for kind, unit in (("gyro", "rad/s"), ("accel", "m/s²")):
        if si == unit:
            large = SAMPLE_UNITS[kind]  # type: ignore[index]
            return DEVIATION_UNITS[kind] if abs(size) * large.factor < SMALL else large  # type: ignore[index]
    return UNITS.get(si, Unit(1.0, si))


def plain(name: str) -> str:
    """An effect's or a parameter's name as words."""
    return name.replace("_", " ")


def lens_name(lens: str) -> str:
    """A lens' name as words."""
    return LENSES.get(lens, plain(lens))


def percent(share: float) -> str:
    """A probability; never "100 %".

    >>> percent(0.998), percent(0.99999), percent(0.0002)
    ('99.8 %', '> 99.9 %', '< 0.1 %')
    """
    if not isfinite(share):
        return "—"
    if share > 0.999:
        return "> 99.9 %"
    return "< 0.1 %" if share < 0.001 else f"{100.0 * share:.1f} %"


def span(low: float, high: float, unit: str) -> str:
    """A place along one lens.

    >>> span(17.1, 17.5, "Hz"), span(1800.0, 1800.5, "s")
    ('17.1 … 17.5 Hz', '1800 s')
    """
    if not abs(high - low) > ONE_PLACE * max(abs(low), abs(high)):
        return f"{_short(0.5 * (low + high))} {unit}".rstrip()
    return f"{_short(low)} … {_short(high)} {unit}".rstrip()


def place(where: Where, axis: str) -> str:
    """Where it was, e.g. "17.1 … 17.5 Hz"; "everywhere" where no lens tells a place.

    >>> place(Where(tau=(1.0, 4.0), source="ax"), "gz")
    'τ = 1 … 4 s, from ax'
    """
    found = []
    for name, at in where.found().items():
        if isinstance(at, str):
            found.append(f"from {at}")
        elif name == "value":
            unit = field_unit("rad/s" if kind_of(axis) == "gyro" else "m/s²", max(map(abs, at)))
            found.append(span(at[0] * unit.factor, at[1] * unit.factor, unit.name))
        else:
            sign, unit_name = PLACES[name]
            found.append(sign + span(*at, unit_name))
    return ", ".join(found) or "everywhere"


def score(one: Score, axis: str) -> str:
    """A gap with its lens and place, in a line."""
    return f"{lens_name(one.lens)}, {place(one.where, axis)}: gap {gap(one.gap)}, threshold {gap(one.threshold)}"


def gap(size: float) -> str:
    """
    >>> gap(0.6), gap(41.23), gap(12345.0)
    ('0.60', '41.2', '12300')
    """
    if not isfinite(size) or size >= 1000.0:
        return number(size)
    return f"{size:.2f}" if size < 10.0 else f"{size:.1f}"


def over_threshold(one: Score) -> float:
    """A gap as a share of its threshold; 0 where that is no number."""
    share = one.gap / one.threshold if one.threshold > 0.0 else 0.0
    return share if isfinite(share) else 0.0


def parameters(step: Step, axis: str, baseline: NoiseModel) -> tuple[Parameter, ...]:
    """All parameters of a step, in its order; beside those of a known effect, what the model under test has."""
    known = [effect for effect in baseline.effects.get(axis, ()) if effect.name == step.effect]
    given = known[0] if len(known) == 1 and step.kind == "retuned" else None
    return tuple(
        _parameter(step.effect, name, bounds, axis, getattr(given, name, None))
        for name, bounds in step.parameters.items()
    )


def step_line(step: Step, axis: str, baseline: NoiseModel) -> str:
    """Effect and parameters in a line: "sinusoidal: amplitude 30.94 ± 0.55 °/h, frequency 17.30000 ± 0.00010 Hz"."""
    said = [f"{plain(one.name)} {one.short}" for one in parameters(step, axis, baseline)]
    return f"{plain(step.effect)}: {', '.join(said)}" if said else plain(step.effect)


def summary(r: Reconciliation) -> str:
    """The verdict of the whole recording in one or two sentences."""
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
    """What is known of one axis, in a sentence."""
    match result.verdict:
        case "agrees":
            return "Model and measurement differ by no more than chance, through every lens."
        case "explained":
            return "After the last step nothing is left that chance would not make."
        case "partly_explained":
            return "The steps below are kept, and something is left that no known effect closes."
        case "unexplained":
            return "Model and measurement differ, and no known effect closes the gap: no name is given."


def why_not(step: Step) -> str:
    """The runners-up with what speaks for them, in a sentence."""
    if not step.runners_up:
        return "No other effect came near."
    tried = [f"{plain(one.effect)} ({percent(one.confidence)})" for one in step.runners_up]
    return f"Tried for the same gap and less likely: {_listed(tried)}."


def _parameter(effect: str, name: str, bounds: Bounds, axis: str, given: Any) -> Parameter:
    if isinstance(bounds.value, str):
        return Parameter(name, bounds.value, "", bounds.value, "", "" if given is None else str(given))
    known = {f.name: f.metadata for f in fields(EFFECTS[effect])}[name]  # type: ignore[arg-type]
    unit = BY_NAME.get(name) or field_unit(known["units"][0 if kind_of(axis) == "gyro" else 1], bounds.value)
    was = "" if given is None else f"{number(given * unit.factor)} {unit.name}".rstrip()
    value, lo, hi = (None if one is None else one * unit.factor for one in (bounds.value, bounds.lo, bounds.hi))
    assert value is not None
    if known["whole"]:
        return Parameter(name, f"{value:.0f}", "", f"{value:.0f} {unit.name}".rstrip(), unit.name, was)
    if lo is None or hi is None or not (isfinite(lo) and isfinite(hi)) or hi <= lo:
        return Parameter(name, number(value), "", f"{number(value)} {unit.name}".rstrip(), unit.name, was)
    texts = _with_interval(value, lo, hi)
    short, interval = _plus_minus(value, lo, hi, texts), f"{texts[1]} … {texts[2]}"
    return Parameter(name, texts[0], interval, f"{short} {unit.name}".rstrip(), unit.name, was)


def _plus_minus(value: float, lo: float, hi: float, texts: Sequence[str]) -> str:
    below, above = value - lo, hi - value
    if abs(above - below) > EVEN * (above + below):
        return f"{texts[0]} ({texts[1]} … {texts[2]})"
    return f"{texts[0]} ± {texts[3]}"


def _with_interval(value: float, lo: float, hi: float) -> tuple[str, ...]:
    """value, lo, hi and half the width, all to the digit that is the second one of the half width."""
    half = 0.5 * (hi - lo)
    decimals = 1 - floor(log10(half))
    if 0 <= decimals <= 9 and max(map(abs, (value, lo, hi))) < 1e6:
        return tuple(f"{one:.{decimals}f}".replace("-", "−") for one in (value, lo, hi, half))
    digits = max(3, 2 + floor(log10(max(abs(value), half) / half)))
    ends = (number(one, digits).replace("-", "−") for one in (value, lo, hi))
    return (*ends, number(half, 2))


def _short(value: float) -> str:
    """Four digits at most, without zeros at the end."""
    text = f"{value:.4g}" if 1e-4 <= abs(value) < 1e5 or value == 0.0 else number(value)
    return text.replace("-", "−", 1) if value < 0.0 else text


def _counted(steps: Sequence[Step]) -> list[str]:
    """How many effects were added and how many known terms retuned, with their names."""
    said = []
    for kind, one, many in (
        ("added", "effect added", "effects added"),
        ("retuned", "known term retuned", "known terms retuned"),
    ):
        names = [plain(step.effect) for step in steps if step.kind == kind]
        if names:
            said.append(f"{len(names)} {one if len(names) == 1 else many} ({_listed(list(dict.fromkeys(names)))})")
    return said


def _listed(words: Sequence[str]) -> str:
    """
    >>> _listed(["gx"]), _listed(["gx", "gy", "gz"])
    ('gx', 'gx, gy and gz')
    """
    return " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else "".join(words)
