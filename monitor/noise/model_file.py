"""Model files: conversion of TOML text to effects and back, and a table for display.

A model file has ``sample_rate`` (Hz), optionally ``[temperature]``, and one table per axis. Each axis has one table per
effect, or an array of tables if an effect occurs twice. ``g*`` and ``a*`` stand for all axes of a kind. An error in the
file raises a ConfigError of one line, which names the place and the nearest known word. Absent parameters stay absent.
"""

import contextlib
from collections.abc import Iterator
from dataclasses import fields
from typing import TYPE_CHECKING, Any, Final

from drivers.discovery import format_suggestion
from drivers.errors import ConfigError
from drivers.quantities import RATE_HZ
from drivers.sample import AXES
from monitor.noise.effect import GYROS, Effect, parameter_units, required_parameters
from monitor.noise.effects import EFFECTS
from monitor.noise.temperature import TEMPERATURE_UNITS, Temperature
from monitor.settings import toml_text

if TYPE_CHECKING:
    from monitor.noise.model import NoiseModel

WILDCARDS: Final = {"g*": AXES[:3], "a*": AXES[3:]}
"""Keys that stand for all axes of a kind."""
AXIS_KEYS: Final = (*AXES, *WILDCARDS)
"""Keys of a model file that name axes."""
TOP_LEVEL_KEYS: Final = ("sample_rate", "temperature")
"""Other keys of a model file."""

AxisEffects = tuple[tuple[str, ...], tuple[Effect, ...]]
"""Names of axes, and the effects that each of them has."""


def parse_model(text: str) -> tuple[list[AxisEffects], float | None, Temperature | None]:
    """Return the effects, the sample rate in Hz and the temperature of a model file's text.

    Raises
    ------
    ConfigError
        If the text is not valid, with one line for each mistake.
    """
    tables = toml_text.parse_toml(text)
    mistakes: list[str] = []
    rate_hz = tables.pop("sample_rate", None)
    if rate_hz is not None:
        with _collect_errors(mistakes):
            if isinstance(rate_hz, bool) or not isinstance(rate_hz, int | float):
                raise ConfigError(f"sample_rate must be a number of Hz, is {rate_hz!r}")
            with error_location("sample_rate"):
                RATE_HZ.check(rate_hz)
    temperature = None
    with _collect_errors(mistakes):
        given = tables.pop("temperature", None)
        temperature = None if given is None else Temperature.from_table(given)
    effects: list[AxisEffects] = []
    for axis, given in tables.items():
        with _collect_errors(mistakes):
            effects.append((WILDCARDS.get(axis, (axis,)), tuple(_parse_axis(axis, given, mistakes))))
    if mistakes:
        raise ConfigError(*mistakes)
    return effects, None if rate_hz is None else float(rate_hz), temperature


def format_model(model: "NoiseModel") -> str:
    """Return the text of a model file."""
    lines = [] if model.sample_rate_hz is None else [f"sample_rate = {float(model.sample_rate_hz)!r}"]
    if model.temperature is not None:
        lines += ["", "[temperature]", *_assignments(model.temperature)]
    for axis, effects in model.effects.items():
        names = [effect.name for effect in effects]
        if not effects:
            lines += ["", f"[{axis}]"]
        for effect in effects:
            bracket = "[[{}]]" if names.count(effect.name) > 1 else "[{}]"
            lines += ["", bracket.format(f"{axis}.{effect.name}"), *_assignments(effect)]
    return "\n".join(lines).lstrip() + "\n"


def format_table(model: "NoiseModel") -> str:
    """Return a table for display, with one line per effect: axis, name, and parameters with units.

    Sample rate and temperature stand above the table.
    """
    head = [] if model.sample_rate_hz is None else [f"sample rate {model.sample_rate_hz:g} Hz"]
    if model.temperature is not None:
        known = [(name, value) for name, value in _set_fields(model.temperature)]
        head.append(
            "temperature " + ", ".join(f"{name} = {value:g} {TEMPERATURE_UNITS[name]}" for name, value in known)
        )
    rows = [("axis", "effect", "parameters")]
    rows += [(axis, effect.name, _format_parameters(axis, effect)) for axis, effect in model]
    width = max(len(name) for _, name, _ in rows)
    return "\n".join([*head, *(f"{axis:4}  {name:{width}}  {said}" for axis, name, said in rows)])


@contextlib.contextmanager
def error_location(place: str) -> Iterator[None]:
    """Add the place in the file to a ConfigError that is raised inside the context."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f"{place}: {str(error).removeprefix(place.rpartition('.')[2] + ': ')}") from error


@contextlib.contextmanager
def _collect_errors(mistakes: list[str]) -> Iterator[None]:
    """Collect a ConfigError and continue, so that all mistakes are reported together."""
    try:
        yield
    except ConfigError as error:
        mistakes += error.lines


def _format_parameters(axis: str, effect: Effect) -> str:
    """Return the parameters of an effect with their units."""
    kind = 0 if axis in GYROS else 1
    unit = {name: pair[kind] for name, pair in parameter_units(type(effect)).items()}
    words = {"1": "", "axis": ""}
    said = [
        f"{name} = {value if isinstance(value, str) else format(value, 'g')} {words.get(unit[name], unit[name])}"
        for name, value in _set_fields(effect)
    ]
    return ", ".join(one.rstrip() for one in said)


def _set_fields(table: Any) -> Iterator[tuple[str, Any]]:
    """Yield name and value of the fields that are not None."""
    for f in fields(table):
        value = getattr(table, f.name)
        if value is not None:
            yield f.name, value


def _assignments(table: Any) -> Iterator[str]:
    """Yield the TOML lines of the fields."""
    for name, value in _set_fields(table):
        if isinstance(value, str):
            yield f'{name} = "{value}"'
        else:
            yield f"{name} = {value if isinstance(value, int) else float(value)!r}"


def _parse_axis(axis: str, effects: Any, mistakes: list[str]) -> Iterator[Effect]:
    """Yield the effects of one axis, and collect the mistakes."""
    if axis not in AXIS_KEYS:
        what = "axis" if isinstance(effects, dict) else "key"
        raise ConfigError(f'unknown {what} "{axis}"{format_suggestion(axis, (*AXIS_KEYS, *TOP_LEVEL_KEYS))}')
    if not isinstance(effects, dict):
        raise ConfigError(f"{axis} must be a table of effects, such as [{axis}.angle_random_walk]")
    for name, given in effects.items():
        if name not in EFFECTS:
            mistakes.append(f'{axis}: unknown effect "{name}"{format_suggestion(name, tuple(EFFECTS))}')
            continue
        for parameters in given if isinstance(given, list) else [given]:
            with _collect_errors(mistakes):
                yield _parse_effect(f"{axis}.{name}", EFFECTS[name], parameters)


def _parse_effect(place: str, effect: type[Effect], parameters: Any) -> Effect:
    """Return the effect of one table."""
    known = tuple(parameter_units(effect))
    if not isinstance(parameters, dict):
        raise ConfigError(f"{place} must be a table with {', '.join(known)}")
    mistakes = [
        f'{place}: unknown parameter "{name}"{format_suggestion(name, known)}'
        for name in parameters
        if name not in known
    ]
    # A misspelt parameter is also missing, but one line is enough.
    mistakes = mistakes or [
        f"{place}: {name} is missing" for name in required_parameters(effect) if name not in parameters
    ]
    if mistakes:
        raise ConfigError(*mistakes)
    with error_location(place):
        return effect(**parameters)
    raise AssertionError  # not reached: the context manager does not suppress exceptions
