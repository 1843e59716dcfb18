"""Tests of coefficients in the units of data sheets."""

import math

import numpy as np
import pytest

from drivers.data_types import AXES
from monitor.common.unit_formatting import COEFFICIENT_UNITS, DEVIATION_UNITS, axes_of, coefficient_unit, format_number
from monitor.estimation.fit.coefficient_values import SYMBOLS, Coefficients, Status
from monitor.publishing.coefficient_cells import format_coefficient


@pytest.mark.parametrize(
    ("axis", "letter", "si", "field", "name"),
    [
        ("gz", "Q", 2.0e-6, 2.0, "µrad"),
        ("gz", "N", 1.5e-4, 0.515662, "°/√h"),  # 1.5e-4 · 57.29578 · 60
        ("gz", "B", math.radians(1.0) / 3600, 1.0, "°/h"),
        ("gz", "K", math.radians(1.0) / 3600 / 60, 1.0, "°/h/√h"),
        ("gz", "R", math.radians(1.0) / 3600 / 3600, 1.0, "°/h/h"),
        ("ax", "Q", 3e-6, 3.0, "µm/s"),
        ("ax", "N", 0.05 / 60, 0.05, "m/s/√h"),
        ("ax", "B", 9.80665e-6, 1.0, "µg"),
        ("ax", "K", 9.80665e-6 / 60, 1.0, "µg/√h"),
        ("ax", "R", 9.80665e-6 / 3600, 1.0, "µg/h"),
    ],
)
def test_coefficient_is_converted_to_data_sheet_units(axis, letter, si, field, name):
    unit = coefficient_unit(letter, axis)
    assert si * unit.factor == pytest.approx(field, rel=1e-5)
    assert unit.name == name


def test_n_is_the_angle_error_after_one_hour():
    angle_deg = math.degrees(1.5e-4 * math.sqrt(3600.0))  # rms angle after an hour is N·√t
    assert coefficient_unit("N", "gx").factor * 1.5e-4 == pytest.approx(angle_deg)


def test_deviation_has_the_unit_of_bias_instability():
    for kind, unit in DEVIATION_UNITS.items():
        assert unit == COEFFICIENT_UNITS[kind]["B"]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (0.99999, "1.00"),
        (999.6, "1000"),
        (12345.0, "12300"),
        (1.5e-4, "0.000150"),
        (1.5e-5, "1.50e-5"),
        (2.5e7, "2.50e7"),
        (-0.0123, "-0.0123"),
        (math.nan, "—"),
        (math.inf, "∞"),
    ],
)
def test_number_has_three_digits(value, text):
    assert format_number(value) == text


def test_cell_follows_the_status():
    shape = (5, 6)
    coefficients = Coefficients(
        np.full(shape, 1.5e-4), np.full(shape, 1.4e-4), np.full(shape, 1.6e-4), np.zeros(shape, np.int8)
    )
    at = SYMBOLS.index("N"), AXES.index("gz")
    seen = []
    for status in (Status.UNESTIMATED, Status.UPPER_BOUND, Status.ESTIMATED):
        coefficients.status[at] = status
        cell = format_coefficient(coefficients, "N", "gz")
        assert cell.unit == "°/√h"
        seen.append((cell.value, cell.interval))
    assert seen == [("—", ""), ("≤ 0.550", ""), ("0.516", "0.481 … 0.550")]


def test_gyro_and_accel_axes_are_all_axes():
    assert axes_of("gyro") + axes_of("accel") == AXES
