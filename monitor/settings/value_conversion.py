"""Convert values of a configuration table to their types, and say in plain words what is wrong with them.

Every wrong element of a list or table is reported, not only the first. Messages name no type of the program: they say
"a number above 0" or list the possible words, the nearest one first.
"""

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin

import msgspec
from msgspec import inspect

from drivers.discovery import format_choices, format_suggestion
from drivers.quantities import Quantity, find_out_of_range

WRONG: Final = object()
"""Stands for a value that cannot be converted."""
MAX_SHOWN_CHARACTERS: Final = 60
"""Characters of a value that a message quotes."""

Hook = Callable[[type, Any], Any]
"""Converts types that msgspec does not know, see ``msgspec.convert``."""
Problem = tuple[str, str]
"""Place below the converted value, such as "[2]", ".gx" or "", and what is wrong there."""


def convert(value: Any, kind: Any, hook: Hook) -> tuple[Any, list[Problem]]:
    """Convert a value to a type.

    Parameters
    ----------
    value
        As TOML gives it.
    kind
        Type with its limits, as msgspec takes it.
    hook
        For types that msgspec does not know; raises ValueError for a value that it cannot convert.

    Returns
    -------
    tuple
        The converted value, and all problems with it. With problems, the value holds the elements that could be
        converted, or is ``WRONG``.

    >>> from drivers.quantities import FRACTION
    >>> convert([1.0, -1.0, "x"], list[Annotated[float, FRACTION.meta]], lambda kind, value: value)
    ([1.0], [('[1]', '-1 is outside the supported range 0 to 1'), ('[2]', 'expected a number from 0 to 1, got "x"')])
    """
    problems: list[Problem]
    try:
        converted = msgspec.convert(value, kind, dec_hook=hook)
    except (msgspec.ValidationError, ValueError):
        problems = []
        return _rest(value, kind, hook, problems), problems or [("", message(value, kind))]
    problems = list(find_out_of_range(converted, kind))
    return (WRONG if problems else converted), problems


def neutral(kind: Any) -> Any:
    """Return an empty value of a type, which stands for a required value that is missing or wrong.

    >>> neutral(dict[str, float]), neutral(str | None), neutral(Literal["Q", "N"])
    ({}, '', 'Q')
    """
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Annotated, Union, UnionType):
        return neutral(arguments[0])
    if origin is Literal:
        return arguments[0]
    return (origin or kind)()


def message(value: Any, kind: Any) -> str:
    """Say what is expected instead of a value.

    >>> message("loud", Literal["debug", "info"]), message("1", float | None)
    ('"loud"; possible are info, debug', 'expected a number, or nothing, got "1"')
    """
    parts = list(_parts(inspect.type_info(kind)))
    words = [word for part in parts if isinstance(part, inspect.LiteralType) for word in part.values]
    others = [description for part in parts if (description := _describe(part))]
    if words:
        others = [one for one in others if one != "nothing"]
        alternatives = "".join(f", or {other}" for other in others)
        return f"{shown(value)}{_ranked(value, words)}{alternatives}"
    return f"expected {', or '.join(others)}, got {shown(value)}"


def shown(value: Any) -> str:
    """Return a value as TOML writes it, or what it is if it is long.

    >>> shown(True), shown("x"), shown([1, 2])
    ('true', '"x"', 'a list')
    """
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"' if len(value) <= MAX_SHOWN_CHARACTERS else f'"{value[:MAX_SHOWN_CHARACTERS]}…"'
    if isinstance(value, list | dict):
        return "a list" if isinstance(value, list) else "a table"
    return str(value)[:MAX_SHOWN_CHARACTERS]


def _rest(value: Any, kind: Any, hook: Hook, problems: list[Problem]) -> Any:
    """Return what can be converted of a list or table; append what is wrong with the others."""
    container = _container(value, kind)
    if container is None:
        return WRONG
    if isinstance(value, list):
        parts = {f"[{i}]": (one, get_args(container)[0]) for i, one in enumerate(value)}
    elif isinstance(container, type) and issubclass(container, msgspec.Struct):
        fields = {field.encode_name: field for field in msgspec.structs.fields(container)}
        problems += [
            (f".{key}", f"unknown key{format_suggestion(key, tuple(fields))}") for key in value if key not in fields
        ]
        problems += [(f".{key}", "missing") for key, field in fields.items() if field.required and key not in value]
        parts = {f".{key}": (one, fields[key].type) for key, one in value.items() if key in fields}
    else:
        parts = {f".{key}": (one, get_args(container)[1]) for key, one in value.items()}
    found = {}
    for place, (one, part) in parts.items():
        converted, wrong = convert(one, part, hook)
        problems += [(place + inner, text) for inner, text in wrong]
        if converted is not WRONG:
            found[place.removeprefix(".")] = converted
    if isinstance(value, list):
        return (get_origin(container) or container)(found.values())
    return found if get_origin(container) is dict else WRONG


def _container(value: Any, kind: Any) -> Any:
    """Return the list, tuple, table or struct type in ``kind`` that a list or table would be; None if there is none."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return _container(value, arguments[0])
    if origin in (Union, UnionType):
        return next((found for one in arguments if (found := _container(value, one)) is not None), None)
    if isinstance(value, list):
        return kind if origin in (list, tuple) else None
    if isinstance(value, dict):
        struct = isinstance(kind, type) and issubclass(kind, msgspec.Struct)
        return kind if origin is dict or struct else None
    return None


def _parts(info: inspect.Type) -> Iterator[inspect.Type]:
    """Yield the alternatives of a union, nothing (None) last."""
    if isinstance(info, inspect.UnionType):
        yield from sorted(info.types, key=lambda one: isinstance(one, inspect.NoneType))
    else:
        yield info


def _describe(info: inspect.Type, many: bool = False) -> str:
    """Return a type in plain words; "" for words that are listed one by one."""
    s = "s" if many else ""
    match info:
        case inspect.Metadata():
            description = (info.extra_json_schema or {}).get("description")
            quantity = (info.extra or {}).get("quantity")
            limits = f" from {quantity.range_text()}" if isinstance(quantity, Quantity) else ""
            return str(description) if description else f"{_describe(info.type, many)}{limits}"
        case inspect.LiteralType():
            return f"words of {', '.join(map(str, info.values))}" if many else ""
        case inspect.UnionType():
            return " or ".join(_describe(one, many) for one in _parts(info))
        case inspect.IntType():
            return f"{'' if many else 'a '}whole number{s}{_limits(info)}"
        case inspect.FloatType():
            return f"{'' if many else 'a '}number{s}{_limits(info)}"
        case inspect.BoolType():
            return "true or false"
        case inspect.StrType():
            return f"text{s} in quotes"
        case inspect.NoneType():
            return "nothing"
        case inspect.ListType() | inspect.VarTupleType():
            return f"{'' if many else 'a '}list{s} of {_describe(info.item_type, many=True)}"
        case inspect.CustomType(cls=kind) if kind is Path:
            return f"{'' if many else 'a '}path{s} in quotes"
        case inspect.AnyType():
            return "anything" if not many else "values"
    return f"{'' if many else 'a '}table{s}"


def _limits(info: inspect.IntType | inspect.FloatType) -> str:
    """Return the range of a number.

    >>> _limits(inspect.FloatType(gt=0.0, le=1.0)), _limits(inspect.IntType(ge=0, le=65535))
    (' above 0 and at most 1', ' from 0 to 65535')
    """
    if info.ge is not None and info.le is not None:
        return f" from {_plain(info.ge)} to {_plain(info.le)}"
    most = "of at most" if info.gt is None else "at most"
    limits = (("above", info.gt), ("of at least", info.ge), ("below", info.lt), (most, info.le))
    said = " and ".join(f"{word} {_plain(limit)}" for word, limit in limits if limit is not None)
    return f" {said}" if said else ""


def _plain(number: float) -> str:
    return str(number) if isinstance(number, int) else f"{number:.12g}"


def _ranked(value: Any, words: list[Any]) -> str:
    """Return the possible words, the nearest first."""
    if isinstance(value, int | float) and all(isinstance(word, int | float) for word in words) and math.isfinite(value):
        words = sorted(words, key=lambda word: abs(word - value))
        return f"; possible are {', '.join(map(str, words))}"
    return format_choices(value if isinstance(value, str) else "", [str(word) for word in words])
