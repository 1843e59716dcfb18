"""Tests of the formatting of axis values with units."""

import math

import pytest

from drivers.data_types import AXES
from monitor.common.unit_formatting import format_axis_value


@pytest.mark.parametrize(
    ("axis", "si", "text"),
    [
        ("gx", math.radians(1.0), "1 °/s"),
        ("gy", math.radians(-0.0456), "-0.046 °/s"),
        ("gz", math.radians(2000.0), "2000 °/s"),
        ("gz", math.radians(12345.0), "12000 °/s"),
        ("ax", 9.80665e-3, "1 mg"),
        ("ay", 9.80665e-6, "0.001 mg"),
        ("az", -0.5 * 9.80665, "-500 mg"),
        ("az", 9.7, "990 mg"),
        ("ax", 9.81, "9.8 m/s²"),
        ("ax", -160.0, "-160 m/s²"),
        ("ay", 1e-12, "0.0000000001 mg"),
        ("gx", 0.0, "0 °/s"),
    ],
)
def test_value_is_formatted_with_unit_and_digits(axis, si, text):
    assert format_axis_value(axis, si) == text


@pytest.mark.parametrize("axis", AXES)
def test_difference_is_formatted_with_sign(axis):
    assert format_axis_value(axis, 0.01, sign=True) == "+" + format_axis_value(axis, 0.01)
    assert (
        format_axis_value(axis, -0.01, sign=True)
        == format_axis_value(axis, -0.01)
        == "-" + format_axis_value(axis, 0.01)
    )


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("si", [1e-30, 1e30, math.inf, -math.inf, math.nan])
def test_extreme_values_are_formatted_without_exponent(axis, si):
    number, unit = format_axis_value(axis, si).split()
    assert math.isfinite(float(number)) == math.isfinite(si)
    assert "e" not in number.lower()
    assert unit in ("°/s", "mg", "m/s²")
