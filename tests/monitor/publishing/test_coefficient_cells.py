"""Tests of coefficients in the units of data sheets."""

import math

import numpy as np
import pytest

from drivers.data_types import AXES
from monitor.common.unit_formatting import (
    COEFFICIENT_UNITS,
    DEVIATION_UNITS,
    UNIT_SYSTEMS,
    axes_of,
    coefficient_unit,
    format_number,
)
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Coefficients, Status
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


def test_one_sided_density_times_root_of_bandwidth_is_sigma_of_a_sample():
    """White noise of N at a rate f has the variance N² f, which a one-sided density distributes over f/2."""
    rate_hz, n = 200.0, {"gyro": 1.5e-4, "accel": 2e-3}
    for kind, si in (("gyro", math.radians(1e-3)), ("accel", 9.80665e-6)):
        density = n[kind] * UNIT_SYSTEMS["datasheet"].densities[kind].factor * si
        assert density * math.sqrt(rate_hz / 2.0) == pytest.approx(n[kind] * math.sqrt(rate_hz), rel=1e-12)


def test_si_has_factors_of_one_and_other_systems_share_their_units():
    for kind in ("gyro", "accel"):
        assert {unit.factor for unit in UNIT_SYSTEMS["si"].coefficients[kind].values()} == {1.0}
        names = {column.symbol: column.unit for column in UNIT_SYSTEMS["imu"].columns(kind)}
        columns = UNIT_SYSTEMS["datasheet"].columns(kind)
        assert [column.symbol for column in columns] == ["Q", "N", "N", "B", "K", "R"]
        assert all(column.unit == names[column.symbol] for column in columns if "density" not in column.name)


def test_deviation_has_the_unit_of_bias_instability():
    for kind, unit in DEVIATION_UNITS.items():
        assert unit == COEFFICIENT_UNITS[kind]["B"] == UNIT_SYSTEMS["imu"].deviation(kind)


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
