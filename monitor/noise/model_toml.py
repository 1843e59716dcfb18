"""Conversion between model files in TOML and the effects of a noise model.

A model file contains the key ``sample_rate`` in Hz, an optional table ``[temperature]``, and one table for each effect
on an axis. The names ``g*`` and ``a*`` stand for all gyroscopes and all accelerometers. If a file is not valid, the
message of the ConfigError has one line for each mistake.
"""

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import fields
from typing import Any, Final, TypeVar

from drivers.data_types import AXES
from drivers.errors import ConfigError
from drivers.validation.module_lookup import format_suggestion
from drivers.validation.number_ranges import RATE_HZ
from monitor.noise.effect import GYROS, Effect, ParameterTable, gyro_and_accel_units, required_parameters
from monitor.noise.effects import EFFECTS
from monitor.noise.temperature import Temperature
from monitor.settings import toml_parser

T = TypeVar("T", bound=ParameterTable)

WILDCARDS: Final = {"g*": AXES[:3], "a*": AXES[3:]}
"""Names in model files that stand for all gyroscopes and for all accelerometers."""
AXIS_KEYS: Final = (*AXES, *WILDCARDS)
TOP_LEVEL_KEYS: Final = ("sample_rate", "temperature")

AxisEffects = tuple[tuple[str, ...], tuple[Effect, ...]]
"""Names of axes, and the effects that apply to all of these axes."""


def parse_model_toml(text: str) -> tuple[list[AxisEffects], float | None, Temperature | None]:
    """Parse the text of a model file, and return the effects, the sample rate in Hz and the temperature.

    Raises
    ------
    ConfigError
        If the text is not a valid noise model. The message has one line for each mistake.
    """
    tables = toml_parser.parse_toml(text)
    mistakes: list[str] = []
    rate_hz = tables.pop("sample_rate", None)
    if rate_hz is not None:
        with _collect_errors(mistakes):
            if isinstance(rate_hz, bool) or not isinstance(rate_hz, int | float):
                raise ConfigError(f"sample_rate must be a number of Hz, is {rate_hz!r}")
            with prefix_config_errors("sample_rate"):
                RATE_HZ.check(rate_hz)
    temperature = None
    with _collect_errors(mistakes):
        given = tables.pop("temperature", None)
        temperature = None if given is None else _parse_table("temperature", Temperature, given)
    effects: list[AxisEffects] = []
    for axis, given in tables.items():
        with _collect_errors(mistakes):
            effects.append((WILDCARDS.get(axis, (axis,)), tuple(_parse_axis(axis, given, mistakes))))
    if mistakes:
        raise ConfigError(*mistakes)
    return effects, None if rate_hz is None else float(rate_hz), temperature


def format_model_toml(
    axis_effects: Mapping[str, tuple[Effect, ...]], sample_rate_hz: float | None, temperature: Temperature | None
) -> str:
    """Format a noise model as the text of a model file.

    Parameters
    ----------
    axis_effects : mapping of str to tuple of Effect
        Effects of each axis.
    sample_rate_hz : float or None
        Sample rate, Hz.
    temperature : Temperature or None
        Simulated temperature.
    """
    lines = [] if sample_rate_hz is None else [f"sample_rate = {float(sample_rate_hz)!r}"]
    if temperature is not None:
        lines += ["", "[temperature]", *_assignments(temperature)]
    for axis, effects in axis_effects.items():
        names = [effect.name for effect in effects]
        if not effects:
            lines += ["", f"[{axis}]"]
        for effect in effects:
            bracket = "[[{}]]" if names.count(effect.name) > 1 else "[{}]"
            lines += ["", bracket.format(f"{axis}.{effect.name}"), *_assignments(effect)]
    return "\n".join(lines).lstrip() + "\n"


def format_model_as_text_table(
    axis_effects: Mapping[str, tuple[Effect, ...]], sample_rate_hz: float | None, temperature: Temperature | None
) -> str:
    """Format a noise model as a table for display, with one line for each effect.

    The parameters are those of ``format_model_toml``.
    """
    head = [] if sample_rate_hz is None else [f"sample rate {sample_rate_hz:g} Hz"]
    if temperature is not None:
        head.append(f"temperature {_format_parameters(temperature)}")
    rows = [("axis", "effect", "parameters")]
    rows += [
        (axis, effect.name, _format_parameters(effect, axis)) for axis in AXES for effect in axis_effects.get(axis, ())
    ]
    width = max(len(name) for _, name, _ in rows)
    return "\n".join([*head, *(f"{axis:4}  {name:{width}}  {text}" for axis, name, text in rows)])


@contextlib.contextmanager
def prefix_config_errors(location: str) -> Iterator[None]:
    """Add a location, such as a table of a model file, to the beginning of the message of a ConfigError."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f"{location}: {str(error).removeprefix(location.rpartition('.')[2] + ': ')}") from error


@contextlib.contextmanager
def _collect_errors(mistakes: list[str]) -> Iterator[None]:
    """Suppress a ConfigError inside the context, and append the lines of its message to ``mistakes``."""
    try:
        yield
    except ConfigError as error:
        mistakes += error.mistake_lines


def _format_parameters(table: ParameterTable, axis: str = GYROS[0]) -> str:
    texts = []
    for name, value in _set_fields(table):
        unit = gyro_and_accel_units(type(table))[name][axis not in GYROS]
        number = value if isinstance(value, str) else format(value, "g")
        texts.append(f"{name} = {number}" + ("" if unit in ("1", "axis", "text") else f" {unit}"))
    return ", ".join(texts)


def _set_fields(table: Any) -> Iterator[tuple[str, Any]]:
    """Yield the names and values of all fields that are not None."""
    for f in fields(table):
        value = getattr(table, f.name)
        if value is not None:
            yield f.name, value


def _assignments(table: Any) -> Iterator[str]:
    for name, value in _set_fields(table):
        if isinstance(value, str):
            yield f'{name} = "{value}"'
        else:
            yield f"{name} = {value if isinstance(value, int) else float(value)!r}"


def _parse_axis(axis: str, effects: Any, mistakes: list[str]) -> Iterator[Effect]:
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
                yield _parse_table(f"{axis}.{name}", EFFECTS[name], parameters)


def _parse_table(place: str, kind: type[T], parameters: Any) -> T:
    known = tuple(gyro_and_accel_units(kind))
    if not isinstance(parameters, dict):
        raise ConfigError(f"{place} must be a table with {', '.join(known)}")
    mistakes = [
        f'{place}: unknown parameter "{name}"{format_suggestion(name, known)}'
        for name in parameters
        if name not in known
    ]
    # Missing parameters are only reported if no parameter is misspelt.
    mistakes = mistakes or [
        f"{place}: {name} is missing" for name in required_parameters(kind) if name not in parameters
    ]
    if mistakes:
        raise ConfigError(*mistakes)
    with prefix_config_errors(place):
        return kind(**parameters)
    raise AssertionError  # not reached, because the context manager does not suppress exceptions
