"""Tests of checking tables of settings: all mistakes are reported, without names of Python types."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import pydantic
import pytest
from pydantic import Field

from drivers.errors import ConfigError
from drivers.validation.number_ranges import FRACTION, RATE_HZ
from drivers.validation.settings_model import (
    Conflict,
    FileOrName,
    FilePath,
    KeywordOrType,
    ListOf,
    SettingsModel,
    check_table,
    one_of,
)
from tests.support.settings import read_settings


class Part(SettingsModel):
    name: str = Field(examples=["a"])
    share: Annotated[float, FRACTION] = 0.5


class Whole(SettingsModel):
    rate_hz: Annotated[float, RATE_HZ] = Field(100.0, alias="rate")
    count: int = 1
    mode: Literal["peer", "client"] | None = None
    flag: bool = False
    words: ListOf[str] = ()
    tau: Annotated[str | tuple[float, ...], KeywordOrType({"octave": "octave"}, ListOf[Annotated[float, FRACTION]])] = (
        "octave"
    )
    scale: dict[Annotated[str, one_of(("gx", "gy"))], float] = Field({})
    parts: ListOf[Part] = Field((), alias="part")
    part: Part = Field(Part(name="b"), alias="other")
    low: float = 0.0
    high: float = 1.0

    def find_conflicting_settings(self) -> Iterator[Conflict]:
        if self.low >= self.high:
            yield Conflict("low", "must be less than high", ("high",))


def list_problems(table: dict[str, object]) -> list[str]:
    return [str(problem) for problem in check_table(Whole, table).problems]


@pytest.mark.parametrize(
    ("table", "problem"),
    [
        ({"rate": "fast"}, 'rate: expected a number from 0.001 Hz to 1 MHz, got "fast"'),
        ({"rate": True}, "rate: expected a number from 0.001 Hz to 1 MHz, got true"),
        ({"rate_hz": 1.0}, 'rate_hz: unknown key; did you mean "rate"?'),
        ({"count": 1.0}, "count: expected a whole number, got 1.0"),
        ({"mode": "pear"}, 'mode: "pear"; possible are peer, client'),
        ({"flag": "yes"}, 'flag: expected true or false, got "yes"'),
        ({"words": "x"}, 'words: expected a list, got "x"'),
        ({"words": ["x", 3]}, "words[1]: expected text in quotes, got 3"),
        ({"tau": "octaves"}, 'tau: expected "octave" or a list, got "octaves"'),
        ({"tau": [0.5, 2.0]}, "tau[1]: 2 is outside the supported range 0 to 1"),
        ({"scale": {"gw": 1.0}}, 'scale.gw: "gw"; possible are gx, gy'),
        ({"scale": []}, "scale: expected a table, got a list"),
        ({"other": {"share": 2.0, "name": "x"}}, "other.share: 2 is outside the supported range 0 to 1"),
        ({"part": [{"nam": "x", "name": "y"}]}, 'part[0].nam: unknown key; did you mean "name"?'),
        ({"part": [3]}, "part[0]: expected a table, got 3"),
        ({"part": [{}]}, "part[0].name: missing"),
        ({"low": 2.0}, "low: must be less than high"),
        ({"words": "x" * 100}, f'words: expected a list, got "{"x" * 60}…"'),
    ],
)
def test_mistake_is_described_in_plain_words(table: dict[str, object], problem: str) -> None:
    assert list_problems(table) == [problem]
    assert not re.search(r"\b(float|int|str|bool|null|None|https|Literal|pydantic)\b", problem)


def test_all_mistakes_are_reported() -> None:
    table = {"rate": 0, "flag": 3, "part": [{"share": 3.0}, 4], "nonesuch": 1, "low": 5.0, "tau": ["a", 0.5, "b"]}
    assert sorted(line.partition(": ")[0] for line in list_problems(table)) == [
        *("flag", "low", "nonesuch", "part[0].name", "part[0].share", "part[1]", "rate", "tau[0]", "tau[2]"),
    ]


def test_wrong_key_with_wrong_value_gives_two_mistakes() -> None:
    found = list_problems({"scale": {"gw": "x", "gx": "y"}, "low": 5.0})
    assert found[0] == 'scale.gw: "gw"; possible are gx, gy'
    assert [line.partition(": ")[0] for line in found] == ["scale.gw", "scale.gw", "scale.gx", "low"]


def test_conflict_that_involves_a_wrong_value_is_not_reported() -> None:
    assert list_problems({"low": 5.0, "high": "x"}) == ['high: expected a number, got "x"']


def test_values_keep_their_types() -> None:
    settings = read_settings(Whole, {"rate": 50, "words": ["a"], "tau": [0.5], "part": [{"name": "x"}]})
    assert (settings.rate_hz, settings.words, settings.tau) == (50.0, ("a",), (0.5,))
    assert settings.parts == (Part(name="x"),)
    with pytest.raises(ConfigError) as caught:
        read_settings(Whole, {"rate": -1, "count": "x"})
    assert len(caught.value.mistake_lines) == 2


def test_settings_created_in_python_are_checked() -> None:
    assert Whole(rate_hz=5.0).rate_hz == 5.0
    with pytest.raises(pydantic.ValidationError, match="must be less than high"):
        Whole(low=2.0)


class Files(SettingsModel):
    path: FilePath = ""
    either: FileOrName = ""


def test_relative_paths_are_resolved_from_the_folder_of_the_configuration(tmp_path: Path) -> None:
    (tmp_path / "here").write_text("")
    found = read_settings(Files, {"path": "here", "either": "here"}, tmp_path)
    assert (found.path, found.either) == (str(tmp_path / "here"), str(tmp_path / "here"))
    assert read_settings(Files, {"either": "shipped"}, tmp_path).either == "shipped"
    with pytest.raises(ConfigError, match=f"path: {tmp_path}/none: no such file"):
        read_settings(Files, {"path": "none"}, tmp_path)
    assert read_settings(Files, {"path": "none"}).path == "none"
