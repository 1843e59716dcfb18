"""Sentences and formatted values for the results of ``reconcile``.

The HTML report, the viewer and the terminal share the texts. Values in SI units are converted to displayed units. For
example, a small angular rate is displayed in °/h and a large rate in °/s. The 95 % interval of a value determines the
number of digits.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from math import floor, isfinite, log10, nan
from typing import Any, Final

from monitor.common.unit_formatting import (
    DEFAULT_UNITS,
    DEGREE,
    DEVIATION_UNITS,
    KINDS,
    MICRO_G,
    SAMPLE_UNITS,
    Kind,
    Unit,
    UnitSystem,
    format_number,
    sensor_kind,
)
from monitor.noise.effect import gyro_and_accel_units
from monitor.noise.effects import EFFECTS
from monitor.noise.model import NoiseModel
from monitor.publishing.exporters.export_input import COEFFICIENT_EFFECTS
from monitor.reconcile.result import (
    AddedOrResizedEffect,
    AxisResult,
    DiagnosticGap,
    Location,
    ParameterInterval,
)
from monitor.reconcile.summary.ranked_findings import RankedGapCause
from monitor.reconcile.summary.summary_sentences import describe_finding, join_words

RESULT_TEXTS: Final = {
    "agrees": "agrees",
    "explained": "explained",
    "partly_explained": "partly explained",
    "unexplained": "unexplained",
}
"""Text for each possible result of an axis or a recording."""
DIAGNOSTIC_NAMES: Final = {"psd": "spectrum", "allan": "Allan deviation"}
"""Displayed names of diagnostics whose identifiers are abbreviations."""
WHITE_NOISE: Final = COEFFICIENT_EFFECTS["N"].name
SAMPLE_SI_UNITS: Final[dict[Kind, str]] = {"gyro": "rad/s", "accel": "m/s²"}
GRAVITY: Final = 9.80665  # m/s², standard (CGPM 1901)
SMALL_UNIT_BELOW: Final = 0.1  # in °/s or m/s²; smaller values are displayed in °/h or µg
_DEGREES_PER_HOUR: Final = DEVIATION_UNITS["gyro"].factor  # °/h per rad/s
_COEFFICIENTS_BY_UNIT: Final = {
    si: (kind, letter)
    for letter, effect in COEFFICIENT_EFFECTS.items()
    for kind, si in zip(KINDS, gyro_and_accel_units(effect)[letter], strict=True)
}
FIELD_UNITS: Final = {
    "1": Unit(1.0, ""),
    "rad/s³": Unit(_DEGREES_PER_HOUR * 3600.0**2, "°/h/h²"),
    "m/s⁴": Unit(MICRO_G * 3600.0**2, "µg/h²"),
    "rad/s/°C": Unit(_DEGREES_PER_HOUR, "°/h/°C"),
    "rad/s/°C²": Unit(_DEGREES_PER_HOUR, "°/h/°C²"),
    "rad/s/°C³": Unit(_DEGREES_PER_HOUR, "°/h/°C³"),
    "rad/s per m/s²": Unit(_DEGREES_PER_HOUR * GRAVITY, "°/h/g"),
    **dict.fromkeys(("(rad/s)²/Hz", "rad²/s²/Hz"), Unit(_DEGREES_PER_HOUR**2, "(°/h)²/Hz")),
    "rad/s/√Hz": Unit(_DEGREES_PER_HOUR, "°/h/√Hz"),
    **dict.fromkeys(("(rad/s)²", "rad²/s²"), Unit(_DEGREES_PER_HOUR**2, "(°/h)²")),
    "m/s²/°C": Unit(MICRO_G, "µg/°C"),
    "m/s²/°C²": Unit(MICRO_G, "µg/°C²"),
    "m/s²/°C³": Unit(MICRO_G, "µg/°C³"),
    **dict.fromkeys(("(m/s²)²/Hz", "m²/s⁴/Hz"), Unit(MICRO_G**2, "µg²/Hz")),
    "m/s²/√Hz": Unit(MICRO_G, "µg/√Hz"),
    **dict.fromkeys(("(m/s²)²", "m²/s⁴"), Unit(MICRO_G**2, "µg²")),
}
"""Displayed unit for each SI unit. Other units, such as Hz, s and °C, are displayed unchanged."""
UNITS_BY_NAME: Final = {"phase": Unit(DEGREE, "°"), "fraction": Unit(100.0, "%")}
"""Displayed units of the parameters whose SI unit does not determine the displayed unit."""
RANGE_FORMATS: Final = {
    "frequency": ("", Unit(1.0, "Hz")),
    "tau": ("τ = ", Unit(1.0, "s")),
    "time": ("t = ", Unit(1.0, "s")),
    "temperature": ("", Unit(1.0, "°C")),
}
"""Prefix and unit for each kind of range."""
MIN_RANGE_SHARE: Final = 1e-3  # a relatively narrower range is written as one number
MAX_DIGITS: Final = 9  # largest number of digits of a value with a very narrow interval
SYMMETRY_TOLERANCE: Final = 0.1  # largest relative difference of the interval sides that are written as ±


@dataclass(frozen=True, slots=True)
class FormattedParameter:
    """Texts for one parameter of a noise effect. Unknown texts are empty."""

    name: str
    value: str  # "30.94", "ax"
    interval: str  # "30.4 … 31.5", the 95 % interval
    short: str  # "30.94 ± 0.55 °/h", with the unit
    unit: str  # "°/h"
    given: str  # value in the model under test, if the model has the effect exactly once


def displayed_unit(si_unit: str, value_si: float, units: UnitSystem = DEFAULT_UNITS) -> Unit:
    """Return the displayed unit of a quantity.

    >>> displayed_unit("rad/s", 1e-4).name, displayed_unit("rad/s", 5.0).name, displayed_unit("Hz", 17.0).name
    ('°/h', '°/s', 'Hz')

    Parameters
    ----------
    si_unit
        SI unit.
    value_si
        Value of the quantity in the SI unit.
    units
        Unit system.
    """
    for kind in () if units.is_si else KINDS:
        if si_unit == SAMPLE_SI_UNITS[kind]:
            large = SAMPLE_UNITS[kind]
            return DEVIATION_UNITS[kind] if abs(value_si) * large.factor < SMALL_UNIT_BELOW else large
    if si_unit in _COEFFICIENTS_BY_UNIT:
        kind, symbol = _COEFFICIENTS_BY_UNIT[si_unit]
        return units.coefficients[kind][symbol]
    if units.is_si:
        return Unit(1.0, "" if si_unit == "1" else si_unit)
    return FIELD_UNITS.get(si_unit, Unit(1.0, si_unit))


def readable_name(name: str) -> str:
    """Return the name of an effect or a parameter with spaces instead of underscores."""
    return name.replace("_", " ")


def diagnostic_name(diagnostic_id: str) -> str:
    """Return the displayed name of a diagnostic."""
    return DIAGNOSTIC_NAMES.get(diagnostic_id, readable_name(diagnostic_id))


def format_probability(probability: float) -> str:
    """Format a probability. Probabilities near 0 and 1 are written as inequalities.

    >>> format_probability(0.998), format_probability(0.99999), format_probability(0.0002)
    ('99.8 %', '> 99.9 %', '< 0.1 %')
    """
    if not isfinite(probability):
        return "—"
    if probability > 0.999:
        return "> 99.9 %"
    return "< 0.1 %" if probability < 0.001 else f"{100.0 * probability:.1f} %"


def format_range(where: Location, axis: str, units: UnitSystem = DEFAULT_UNITS) -> str:
    """Format the range in which a diagnostic found a difference. Without a range, return "everywhere".

    >>> format_range(Location(tau=(1.0, 4.0), source="ax"), "gz"), format_range(Location(time=(1800.0, 1800.5)), "gz")
    ('τ = 1 … 4 s, from ax', 't = 1800 s')

    Parameters
    ----------
    where
        The range.
    axis
        Name of the axis, which determines the units.
    units
        Unit system.
    """
    texts = []
    for name, ends in where.resolved_location_dimensions().items():
        if isinstance(ends, str):
            texts.append(f"from {ends}")
            continue
        prefix, unit = RANGE_FORMATS.get(name, ("", Unit(1.0, "")))
        if name == "value":
            unit = displayed_unit(SAMPLE_SI_UNITS[sensor_kind(axis)], max(map(abs, ends)), units)
        low, high = (end * unit.factor for end in ends)
        narrow = not abs(high - low) > MIN_RANGE_SHARE * max(abs(low), abs(high))
        text = _short(0.5 * (low + high)) if narrow else f"{_short(low)} … {_short(high)}"
        texts.append(f"{prefix}{text} {unit.name}")
    return ", ".join(texts) or "everywhere"


def describe_gap(gap: DiagnosticGap, axis: str, units: UnitSystem = DEFAULT_UNITS) -> str:
    """Describe a difference between model and recording (gap) with the diagnostic, range and threshold.

    Parameters
    ----------
    gap
        Gap of a diagnostic.
    axis
        Name of the axis, which determines the units.
    units
        Unit system.
    """
    sizes = f"gap {format_gap(gap.gap)}, threshold {format_gap(gap.threshold)}"
    return f"{diagnostic_name(gap.diagnostic)}, {format_range(gap.where, axis, units)}: {sizes}"


def format_gap(gap: float) -> str:
    """Format the size of a difference between model and recording (gap).

    >>> format_gap(0.6), format_gap(41.23), format_gap(12345.0)
    ('0.60', '41.2', '12300')
    """
    if not isfinite(gap) or gap >= 1000.0:
        return format_number(gap)
    return f"{gap:.2f}" if gap < 10.0 else f"{gap:.1f}"


def gap_to_threshold_ratio(gap: DiagnosticGap) -> float:
    """Return the gap of a diagnostic divided by the threshold, or 0 if the ratio is not finite."""
    share = gap.gap / gap.threshold if gap.threshold > 0.0 else 0.0
    return share if isfinite(share) else 0.0


def format_parameters(
    step: AddedOrResizedEffect, axis: str, baseline: NoiseModel, units: UnitSystem = DEFAULT_UNITS
) -> tuple[FormattedParameter, ...]:
    """Format all parameters of the noise effect that a step adds or changes.

    Parameters
    ----------
    step
        Step of the reconciliation.
    axis
        Name of the axis.
    baseline
        Model under test.
    units
        Unit system.
    """
    known = [effect for effect in baseline.effects.get(axis, ()) if effect.name == step.effect]
    given = known[0] if len(known) == 1 and step.kind == "retuned" else None
    shown = []
    for name, bounds in step.parameters.items():
        unit = parameter_unit(step.effect, name, axis, bounds.value, units)
        shown.append(_format_parameter(step.effect, name, bounds, unit, getattr(given, name, None)))
        for density in units.columns(sensor_kind(axis), "N")[1:] if step.effect == WHITE_NOISE else ():
            one = _format_parameter(step.effect, name, bounds, density.unit, getattr(given, name, None))
            shown.append(replace(one, name=density.name))
    return tuple(shown)


def describe_step(
    step: AddedOrResizedEffect, axis: str, baseline: NoiseModel, units: UnitSystem = DEFAULT_UNITS
) -> str:
    """Describe the noise effect and the parameters of a step in one line.

    An example is "sinusoidal: amplitude 30.94 ± 0.55 °/h, frequency 17.30000 ± 0.00010 Hz".

    Parameters
    ----------
    step
        Step of the reconciliation.
    axis
        Name of the axis.
    baseline
        Model under test.
    units
        Unit system.
    """
    said = [f"{readable_name(one.name)} {one.short}" for one in format_parameters(step, axis, baseline, units)]
    return f"{readable_name(step.effect)}: {', '.join(said)}" if said else readable_name(step.effect)


def describe_finding_and_parameters(finding: RankedGapCause, units: UnitSystem = DEFAULT_UNITS) -> str:
    """Describe a finding with all parameters of the axis with the largest gain, in one line.

    Parameters
    ----------
    finding
        Finding of the recording.
    units
        Unit system.
    """
    said = f"{'added ' if finding.kind == 'added' else ''}{describe_finding(finding)}"
    axis, texts = finding.strongest_axis, []
    for name, bounds in finding.parameters.items():
        unit = parameter_unit(finding.effect, name, axis, bounds.value, units)
        texts.append(f"{readable_name(name)} {_format_parameter(finding.effect, name, bounds, unit, None).short}")
    where = f" ({axis})" if len(finding.axes) > 1 else ""
    return f"{said}: {', '.join(texts)}{where}" if texts else said


def describe_allan_influence(finding: RankedGapCause) -> str:
    """Describe the largest influence of a finding on the Allan deviation, such as "× 1.24 at τ = 0.01 s (gz)"."""
    axis = finding.most_influenced_axis
    if axis is None:
        return "—"
    one = finding.influences[axis]
    return f"× {_short(one.ratio)} at τ = {_short(one.tau_s)} s ({axis})"


def describe_result(result: AxisResult) -> str:
    """Describe the result of one axis in one sentence."""
    match result.verdict:
        case "agrees":
            return "In every diagnostic, model and measurement differ by no more than chance."
        case "explained":
            return "After the last step, no difference larger than chance remains."
        case "partly_explained":
            return "The steps below explain a part of the difference. No known effect explains the rest."
        case "unexplained":
            return "Model and measurement differ. No known effect explains the difference, so no effect is named."


def describe_largest_gap(result: AxisResult, units: UnitSystem = DEFAULT_UNITS) -> str:
    """Describe the gap of an axis that is largest relative to its threshold, in the given unit system."""
    return describe_gap(max(result.start.gaps, key=gap_to_threshold_ratio), result.axis, units)


def describe_alternatives(step: AddedOrResizedEffect) -> str:
    """Describe the alternative effects of a step and their probabilities."""
    if not step.runners_up:
        return "No other effect explains the gap nearly as well."
    tried = [f"{readable_name(one.effect)} ({format_probability(one.confidence)})" for one in step.runners_up]
    return f"Less likely explanations of the same gap: {join_words(tried)}."


def describe_held_out_gap_change(step: AddedOrResizedEffect) -> str:
    """Describe the gap before and after a step on data that were not used to choose the effect."""
    if step.held_out is None:
        return f"None: {step.held_out_reason}."
    before, after = step.held_out
    return f"{format_gap(before)} → {format_gap(after)}, threshold {format_gap(step.after.threshold)}"


def parameter_unit(effect: str, name: str, axis: str, value_si: float | str, units: UnitSystem = DEFAULT_UNITS) -> Unit:
    """Return the displayed unit of a parameter of a noise effect.

    Parameters
    ----------
    effect
        Name of the effect.
    name
        Name of the parameter.
    axis
        Name of the axis.
    value_si
        Value of the parameter in the SI unit, or text.
    units
        Unit system.
    """
    if isinstance(value_si, str):
        return Unit(1.0, "")
    si = gyro_and_accel_units(EFFECTS[effect])[name][KINDS.index(sensor_kind(axis))]
    own = None if units.is_si else UNITS_BY_NAME.get(name)
    return own or displayed_unit(si, value_si, units)


def _format_parameter(effect: str, name: str, bounds: ParameterInterval, unit: Unit, given: Any) -> FormattedParameter:
    if isinstance(bounds.value, str):
        return FormattedParameter(name, bounds.value, "", bounds.value, "", "" if given is None else str(given))

    def with_unit(text: str) -> str:
        return f"{text} {unit.name}".rstrip()

    was = "" if given is None else with_unit(format_number(given * unit.factor))
    value, lo, hi = (nan if end is None else end * unit.factor for end in (bounds.value, bounds.lo, bounds.hi))
    whole = any(f.name == name and f.metadata["whole"] for f in fields(EFFECTS[effect]))  # type: ignore[arg-type]
    if whole or not isfinite(hi - lo) or hi <= lo:
        text = f"{value:.0f}" if whole else format_number(value)
        return FormattedParameter(name, text, "", with_unit(text), unit.name, was)
    texts = _with_interval(value, lo, hi)
    short = with_unit(_plus_minus(value, lo, hi, texts))
    return FormattedParameter(name, texts[0], f"{texts[1]} … {texts[2]}", short, unit.name, was)


def _plus_minus(value: float, lo: float, hi: float, texts: Sequence[str]) -> str:
    """Format a value with ±, or with two interval ends if the interval is asymmetric."""
    below, above = value - lo, hi - value
    if abs(above - below) > SYMMETRY_TOLERANCE * (above + below):
        return f"{texts[0]} ({texts[1]} … {texts[2]})"
    return f"{texts[0]} ± {texts[3]}"


def _with_interval(value: float, lo: float, hi: float) -> tuple[str, ...]:
    """Format a value, the interval ends and the half width, rounded to the second digit of the half width."""
    half = 0.5 * (hi - lo)
    decimals = 1 - floor(log10(half))
    if 0 <= decimals <= 9 and max(map(abs, (value, lo, hi))) < 1e6:
        return tuple(f"{one:.{decimals}f}".replace("-", "−") for one in (value, lo, hi, half))
    digits = min(max(3, 2 + floor(log10(max(abs(value), half) / half))), MAX_DIGITS)
    ends = (format_number(one, digits).replace("-", "−") for one in (value, lo, hi))
    return (*ends, format_number(half, 2))


def _short(value: float) -> str:
    """Format a number with at most four digits and without trailing zeros."""
    text = f"{value:.4g}" if 1e-4 <= abs(value) < 1e5 or value == 0.0 else format_number(value)
    return text.replace("-", "−", 1) if value < 0.0 else text
