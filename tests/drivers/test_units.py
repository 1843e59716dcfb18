"""Tests of conversion factors of units and of error messages for unknown units."""

import doctest
import math

import pytest

from drivers import units
from drivers.errors import ConfigError


def test_angular_rate_factors() -> None:
    assert units.angular_rate_factor("rad/s") == 1.0
    assert units.angular_rate_factor("deg/s") * 180.0 == pytest.approx(math.pi)
    assert units.angular_rate_factor("°/h") * 3600.0 * 180.0 == pytest.approx(math.pi)
    assert units.angular_rate_factor("mdps") == pytest.approx(math.radians(1e-3))
    assert units.angular_rate_factor("mrad/s") == 1e-3


def test_acceleration_factors() -> None:
    assert units.acceleration_factor("g") == 9.80665
    assert units.acceleration_factor("mg") == pytest.approx(9.80665e-3)
    assert units.acceleration_factor("µg") == pytest.approx(9.80665e-6)
    assert {units.acceleration_factor(n) for n in ("m/s²", "m/s^2", "m/s2", "m/s/s")} == {1.0}


@pytest.mark.parametrize(
    ("unit", "number", "celsius"),
    [("°C", 25.0, 25.0), ("K", 273.15, 0.0), ("°F", 212.0, 100.0), ("F", 32.0, 0.0), ("m°C", 25_000.0, 25.0)],
)
def test_temperature_factors_and_offsets(unit: str, number: float, celsius: float) -> None:
    factor, offset = units.temperature_factor_and_offset(unit)
    assert factor * number + offset == pytest.approx(celsius, abs=1e-12)


def test_time_factors() -> None:
    assert [units.time_factor(n) for n in ("s", "ms", "us", "µs", "ns")] == [1.0, 1e-3, 1e-6, 1e-6, 1e-9]


def test_both_micro_signs_and_spaces_are_accepted() -> None:
    assert units.acceleration_factor(" \N{GREEK SMALL LETTER MU}g ") == units.acceleration_factor("\N{MICRO SIGN}g")


@pytest.mark.parametrize(
    ("look_up", "unit", "expected_parts"),
    [
        (units.angular_rate_factor, "deg/sek", ("angular rate", '"deg/sek"', "possible are deg/sec, deg/s, ")),
        (units.angular_rate_factor, "furlong", ('"furlong"', "rad/s", "deg/s")),
        (units.acceleration_factor, "G", ('"G"', "m/s²", "mg")),
        (units.temperature_factor_and_offset, "Réaumur", ('"Réaumur"', "°C", "K")),
        (units.time_factor, "fortnight", ('"fortnight"', "ms", "ns")),
    ],
)
def test_error_names_the_unknown_unit_and_known_units(look_up, unit: str, expected_parts: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError) as caught:
        look_up(unit)
    assert all(part in str(caught.value) for part in expected_parts)
    assert "\n" not in str(caught.value)


def test_docstring_examples_are_correct() -> None:
    assert doctest.testmod(units).failed == 0
