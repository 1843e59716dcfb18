"""Every number that enters the program is checked against a range."""

import math
from typing import Annotated

import pytest
from pydantic import Field

from drivers import number_ranges
from drivers.errors import ConfigError
from drivers.number_ranges import RATE_HZ, SCALE, SEED, SILENCE_S, NumberRange
from drivers.settings_model import ListOf, SettingsModel
from tests.support.settings import read_settings

ALL = {name: one for name, one in vars(number_ranges).items() if isinstance(one, NumberRange)}


class Inner(SettingsModel):
    factor: Annotated[float, SCALE] = 1.0


class Outer(SettingsModel):
    rate: Annotated[float, RATE_HZ] | None = None
    tau: ListOf[Annotated[float, RATE_HZ]] = ()
    signals: dict[str, Inner] = Field({})
    seed: Annotated[int, SEED] = 1


@pytest.mark.parametrize("name", ALL)
def test_both_ends_are_supported_and_what_is_beyond_is_not(name: str) -> None:
    one = ALL[name]
    assert one.low <= one.high
    for value in (one.low, one.high, *([0] if one.zero else []), *([-one.high] if one.signed else [])):
        assert one.check(value) == value
    beyond = (math.nan, math.inf, -math.inf, 2.0 * one.high + 1.0, 10**400, *([] if one.signed else [one.low - 1e4]))
    for value in beyond:
        with pytest.raises(ConfigError, match="is outside the supported range"):
            one.check(value)


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"rate": 1e300}, "rate: 1e+300 Hz is outside the supported range 0.001 Hz to 1 MHz"),
        ({"rate": "1"}, 'rate: expected a number from 0.001 Hz to 1 MHz, got "1"'),
        ({"rate": True}, "rate: expected a number from 0.001 Hz to 1 MHz, got true"),
        ({"tau": [1.0, math.nan]}, "tau[1]: nan Hz is outside"),
        ({"signals": {"gx": {}, "gy": {"factor": 0.0}}}, "signals.gy.factor: 0 is outside"),
        ({"seed": -1}, "seed: -1 is outside"),
        ({"seed": 1.5}, "seed: expected a whole number from 0 to 9.22337e+18, got 1.5"),
    ],
)
def test_a_wrong_number_anywhere_in_settings_is_found(settings: dict[str, object], text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read_settings(Outer, settings)
    assert str(caught.value).startswith(text)


def test_every_number_outside_its_range_is_found() -> None:
    with pytest.raises(ConfigError) as caught:
        read_settings(Outer, {"rate": 0.0, "tau": [1.0, -1.0], "seed": -1})
    assert [line.partition(": ")[0] for line in caught.value.mistake_lines] == ["rate", "tau[1]", "seed"]


def test_zero_has_a_meaning_of_its_own() -> None:
    assert SILENCE_S.check(0.0) == 0.0
    with pytest.raises(ConfigError, match="1 µs is outside the supported range 1 ms to 36525 d, or 0"):
        SILENCE_S.check(1e-6)
