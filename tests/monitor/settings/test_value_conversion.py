"""Values of a table to their types: every wrong element is told, in words that are no types of the program."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import pytest

import drivers.decoders
import drivers.links
from drivers import discovery
from drivers.decoders.dbc.settings import SignalSettings
from monitor.settings import schema
from monitor.settings.value_conversion import WRONG, convert, message, neutral, shown

Positive = Annotated[float, msgspec.Meta(gt=0.0)]


def path_hook(kind: type, value: Any) -> Any:
    if kind is Path and isinstance(value, str):
        return Path(value)
    raise ValueError


@pytest.mark.parametrize(
    ("value", "kind", "says"),
    [
        (
            "x",
            Literal["octave", "decade10"] | list[Positive],
            "possible are decade10, octave, or a list of numbers above 0",
        ),
        ("inf", Literal["debug", "info"] | None, '"inf"; possible are info, debug'),
        (9, Literal[5, 6, 7, 8], "9; possible are 8, 7, 6, 5"),
        (True, float, "expected a number, got true"),
        ("1", Positive | None, 'expected a number above 0, or nothing, got "1"'),
        (-1, Annotated[int, msgspec.Meta(ge=0)], "expected a whole number of at least 0, got -1"),
        (9, Annotated[int, msgspec.Meta(le=8)], "expected a whole number of at most 8, got 9"),
        (2.0, Annotated[float, msgspec.Meta(gt=0.0, le=1.0)], "expected a number above 0 and at most 1, got 2.0"),
        ({}, list[str], "expected a list of texts in quotes, got a table"),
        ([], dict[str, float], "expected a table, got a list"),
        (3, Path, "expected a path in quotes, got 3"),
        ("yes", bool, 'expected true or false, got "yes"'),
        ("a/*", schema.ZenohKey, 'expected a zenoh key such as "site/alarms", without'),
        ("x" * 100, int, f'got "{"x" * 60}…"'),
    ],
)
def test_what_is_expected_is_said_in_plain_words(value: object, kind: Any, says: str) -> None:
    converted, ((place, text),) = convert(value, kind, path_hook)
    assert converted is WRONG
    assert place == ""
    assert says in text


def test_every_wrong_element_is_told_and_the_others_are_kept() -> None:
    value = {
        "gx": "A.B",
        "gy": 3,
        "gz": {"signal": "A.C", "factor": "two", "unti": "deg/s"},
        "ax": {"factor": 1.0},
    }
    converted, problems = convert(value, dict[str, str | SignalSettings], path_hook)
    assert converted == {"gx": "A.B"}
    assert problems == [
        (".gy", "expected text in quotes, or a table, got 3"),
        (".gz.unti", 'unknown key; did you mean "unit"?'),
        (".gz.factor", 'expected a number from ±1e-15 to ±1e+15, got "two"'),
        (".ax.signal", "missing"),
    ]
    assert convert(["gx", 3, "gy"], tuple[str, ...], path_hook) == (
        ("gx", "gy"),
        [("[1]", "expected text in quotes, got 3")],
    )


def test_what_fits_is_converted() -> None:
    assert convert(["a", "b"], tuple[str, ...], path_hook) == (("a", "b"), [])
    assert convert("a", Path, path_hook) == (Path("a"), [])
    assert convert(3, float, path_hook) == (3.0, [])


def kinds() -> Iterator[type[msgspec.Struct]]:
    """The struct of every table, link and decoder."""
    yield from (one for one in vars(schema).values() if isinstance(one, type) and issubclass(one, msgspec.Struct))
    yield SignalSettings
    for name in discovery.list_modules(drivers.links, "_link"):
        yield discovery.import_module(drivers.links, name, "_link").Settings
    for name in discovery.list_modules(drivers.decoders):
        yield discovery.import_module(drivers.decoders, name).Settings


@pytest.mark.parametrize("kind", list(kinds()), ids=lambda kind: f"{kind.__module__}.{kind.__name__}")
def test_no_message_names_a_type_of_the_program(kind: type[msgspec.Struct]) -> None:
    for field in msgspec.structs.fields(kind):
        for value in (object, "no-such-word", -1.5, [object], {"no such key": object}):
            text = message(value, field.type)
            said = text.removesuffix(f"got {shown(value)}").removeprefix(shown(value))
            assert not re.search(r"\b(float|int|str|bool|null|None|array|object|enum|Literal|pattern)\b", said), text
        msgspec.structs.replace(kind(**{one.name: neutral(one.type) for one in msgspec.structs.fields(kind)}))
