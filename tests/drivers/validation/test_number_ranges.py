"""Tests of the ranges that numbers in settings are checked against."""

import math
from typing import Annotated

import pytest
from pydantic import Field

from drivers.errors import ConfigError
from drivers.validation import number_ranges
from drivers.validation.number_ranges import RATE_HZ, SCALE, SEED, SILENCE_S, NumberRange
from drivers.validation.settings_model import ListOf, SettingsModel
from tests.support.settings import read_settings

RANGES = {name: value for name, value in vars(number_ranges).items() if isinstance(value, NumberRange)}


class Inner(SettingsModel):
    factor: Annotated[float, SCALE] = 1.0


class Outer(SettingsModel):
    rate: Annotated[float, RATE_HZ] | None = None
    tau: ListOf[Annotated[float, RATE_HZ]] = ()
    signals: dict[str, Inner] = Field({})
    seed: Annotated[int, SEED] = 1


@pytest.mark.parametrize("name", RANGES)
def test_limits_are_accepted_and_numbers_beyond_them_are_refused(name: str) -> None:
    number_range = RANGES[name]
    assert number_range.low <= number_range.high
    for value in (
        number_range.low,
        number_range.high,
        *([0] if number_range.zero else []),
        *([-number_range.high] if number_range.signed else []),
    ):
        assert number_range.check(value) == value
    refused = (
        math.nan,
        math.inf,
        -math.inf,
        2.0 * number_range.high + 1.0,
        10**400,
        *([] if number_range.signed else [number_range.low - 1e4]),
    )
    for value in refused:
        with pytest.raises(ConfigError, match="is outside the supported range"):
            number_range.check(value)


@pytest.mark.parametrize(
    ("settings", "start"),
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
def test_wrong_number_in_nested_settings_is_reported(settings: dict[str, object], start: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read_settings(Outer, settings)
    assert str(caught.value).startswith(start)


def test_all_numbers_outside_their_ranges_are_reported() -> None:
    with pytest.raises(ConfigError) as caught:
        read_settings(Outer, {"rate": 0.0, "tau": [1.0, -1.0], "seed": -1})
    assert [line.partition(": ")[0] for line in caught.value.mistake_lines] == ["rate", "tau[1]", "seed"]


def test_zero_is_allowed_as_a_special_value() -> None:
    assert SILENCE_S.check(0.0) == 0.0
    with pytest.raises(ConfigError, match="1 µs is outside the supported range 1 ms to 36525 d, or 0"):
        SILENCE_S.check(1e-6)
