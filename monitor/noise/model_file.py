"""Model files: TOML to effects and back, and a table for people.

A model file has ``sample_rate`` (Hz), optionally ``[temperature]``, and one table an axis, in it one table an effect,
or an array of tables where an effect occurs twice; ``g*`` and ``a*`` stand for all axes of a kind. What is wrong in it
is a ConfigError of one line that names the place and the nearest known word. Parameters that are absent stay absent.
"""

import contextlib
from collections.abc import Iterator
from dataclasses import fields
from typing import TYPE_CHECKING, Any, Final

from drivers.discovery import nearest
from drivers.errors import ConfigError
from drivers.quantities import RATE_HZ
from drivers.sample import AXES
from monitor.noise.effect import GYROS, Effect, required, units
from monitor.noise.effects import EFFECTS
from monitor.noise.temperature import UNITS, Temperature
from monitor.settings import toml_text

if TYPE_CHECKING:
    from monitor.noise.model import NoiseModel

WILDCARDS: Final = {"g*": AXES[:3], "a*": AXES[3:]}
KNOWN: Final = (*AXES, *WILDCARDS)
KEYS: Final = ("sample_rate", "temperature")

Placed = tuple[tuple[str, ...], tuple[Effect, ...]]  # axes, their effects


def read(text: str) -> tuple[list[Placed], float | None, Temperature | None]:
    """Effects, sample rate in Hz and temperature of a model file's text; ConfigError has a line for each mistake."""
    tables = toml_text.tables(text)
    wrong: list[str] = []
    rate_hz = tables.pop("sample_rate", None)
    if rate_hz is not None:
        with _collecting(wrong):
            if isinstance(rate_hz, bool) or not isinstance(rate_hz, int | float):
                raise ConfigError(f"sample_rate must be a number of Hz, is {rate_hz!r}")
            with placed("sample_rate"):
                RATE_HZ.check(rate_hz)
    temperature = None
    with _collecting(wrong):
        given = tables.pop("temperature", None)
        temperature = None if given is None else Temperature.from_table(given)
    effects: list[Placed] = []
    for axis, given in tables.items():
        with _collecting(wrong):
            effects.append((WILDCARDS.get(axis, (axis,)), tuple(_effects(axis, given, wrong))))
    if wrong:
        raise ConfigError(*wrong)
    return effects, None if rate_hz is None else float(rate_hz), temperature


def write(model: "NoiseModel") -> str:
    """The text of a model file."""
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


def table(model: "NoiseModel") -> str:
    """A line an effect: axis, name, parameters with units; rate and temperature above."""
    head = [] if model.sample_rate_hz is None else [f"sample rate {model.sample_rate_hz:g} Hz"]
    if model.temperature is not None:
        known = [(name, value) for name, value in _given(model.temperature)]
        head.append("temperature " + ", ".join(f"{name} = {value:g} {UNITS[name]}" for name, value in known))
    rows = [("axis", "effect", "parameters")]
    rows += [(axis, effect.name, _said(axis, effect)) for axis, effect in model]
    width = max(len(name) for _, name, _ in rows)
    return "\n".join([*head, *(f"{axis:4}  {name:{width}}  {said}" for axis, name, said in rows)])


@contextlib.contextmanager
def placed(place: str) -> Iterator[None]:
    """Say in a ConfigError where in the file its cause is."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f"{place}: {str(error).removeprefix(place.rpartition('.')[2] + ': ')}") from error


@contextlib.contextmanager
def _collecting(wrong: list[str]) -> Iterator[None]:
    """Note a mistake and go on, so that every one is told."""
    try:
        yield
    except ConfigError as error:
        wrong += error.lines


def _said(axis: str, effect: Effect) -> str:
    kind = 0 if axis in GYROS else 1
    unit = {name: pair[kind] for name, pair in units(type(effect)).items()}
    words = {"1": "", "axis": ""}
    said = [
        f"{name} = {value if isinstance(value, str) else format(value, 'g')} {words.get(unit[name], unit[name])}"
        for name, value in _given(effect)
    ]
    return ", ".join(one.rstrip() for one in said)


def _given(table: Any) -> Iterator[tuple[str, Any]]:
    for f in fields(table):
        value = getattr(table, f.name)
        if value is not None:
            yield f.name, value


def _assignments(table: Any) -> Iterator[str]:
    for name, value in _given(table):
        if isinstance(value, str):
            yield f'{name} = "{value}"'
        else:
            yield f"{name} = {value if isinstance(value, int) else float(value)!r}"


def _effects(axis: str, effects: Any, wrong: list[str]) -> Iterator[Effect]:
    if axis not in KNOWN:
        what = "axis" if isinstance(effects, dict) else "key"
        raise ConfigError(f'unknown {what} "{axis}"{nearest(axis, (*KNOWN, *KEYS))}')
    if not isinstance(effects, dict):
        raise ConfigError(f"{axis} must be a table of effects, such as [{axis}.angle_random_walk]")
    for name, given in effects.items():
        if name not in EFFECTS:
            wrong.append(f'{axis}: unknown effect "{name}"{nearest(name, tuple(EFFECTS))}')
            continue
        for parameters in given if isinstance(given, list) else [given]:
            with _collecting(wrong):
                yield _effect(f"{axis}.{name}", EFFECTS[name], parameters)


def _effect(place: str, effect: type[Effect], parameters: Any) -> Effect:
    known = tuple(units(effect))
    if not isinstance(parameters, dict):
        raise ConfigError(f"{place} must be a table with {', '.join(known)}")
    wrong = [f'{place}: unknown parameter "{name}"{nearest(name, known)}' for name in parameters if name not in known]
    # a misspelt parameter is missing, too, which needs no second line
    wrong = wrong or [f"{place}: {name} is missing" for name in required(effect) if name not in parameters]
    if wrong:
        raise ConfigError(*wrong)
    with placed(place):
        return effect(**parameters)
    raise AssertionError  # the context manager never swallows
