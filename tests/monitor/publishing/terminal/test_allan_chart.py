"""Tests of the charts of Allan deviations in a terminal."""

import io
import re
from dataclasses import replace

import numpy as np
import pytest
from rich.cells import cell_len
from rich.console import Console

from monitor.common.unit_formatting import DEFAULT_UNITS, UNIT_SYSTEMS, UnitSystem
from monitor.estimation.allan.curve import AllanCurve
from monitor.publishing.terminal.allan_chart import MAX_LINES, allan_charts
from tests.monitor.publishing import example_results

DOT_ROWS = {
    bit: row for row, bits in enumerate(((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))) for bit in bits
}


def white_noise(n: float, axes: tuple[int, ...] = (0, 1, 2)) -> AllanCurve:
    """Return the Allan variances N² / τ of axes from τ = 0.01 s to τ = 100 s."""
    tau_s = np.logspace(-2.0, 2.0, 9)
    avar = np.full((tau_s.size, 6), np.nan)
    avar[:, axes] = (n**2 / tau_s)[:, None]
    return replace(example_results.make_estimate().curve, tau_s=tau_s, avar=avar)


def draw(curve: AllanCurve, width: int, lines: int = 15, units: UnitSystem = DEFAULT_UNITS) -> list[str]:
    chart = allan_charts(curve, units, width, lines)
    assert chart is not None
    console = Console(width=width, file=io.StringIO(), record=True)
    console.print(chart)
    return console.export_text().splitlines()


def test_white_noise_is_a_straight_line_from_corner_to_corner() -> None:
    chart = draw(white_noise(1e-3), 60, units=UNIT_SYSTEMS["si"])
    assert chart[0].strip() == "Gyroscopes: Allan deviation, rad/s"
    rows = [line[7:57] for line in chart[1:-1]]
    cells = [
        (row, column, ord(dot) - 0x2800)
        for row, line in enumerate(rows)
        for column, dot in enumerate(line)
        if dot != " "
    ]
    dots = [(4 * row + DOT_ROWS[bit], column) for row, column, bits in cells for bit in DOT_ROWS if bits & bit]
    y, x = np.array(dots).T
    assert (y.min(), y.max()) == (0, 4 * len(rows) - 1)
    assert (x.min(), x.max()) == (0, 49)
    assert np.abs(y - x / 49.0 * y.max()).max() < 2.0


def test_ticks_state_the_units() -> None:
    chart = draw(white_noise(1e-3), 60, units=UNIT_SYSTEMS["si"])
    assert [line.split("┤")[0].strip() for line in chart if "┤" in line] == ["0.01", "0.001", "0.0001"]
    assert chart[-1].split() == ["0.01", "0.1", "1", "10", "τ,", "s"]  # 100 s is at the right edge, next to the unit
    degrees = draw(white_noise(1e-3), 60)
    assert degrees[0].strip() == "Gyroscopes: Allan deviation, °/h"
    assert [line.split("┤")[0].strip() for line in degrees if "┤" in line] == ["1000", "100"]


def test_each_curve_has_a_name() -> None:
    chart = "\n".join(draw(example_results.make_estimate().curve, 120))
    assert sorted(re.findall(r"\b[ag][xyz]\b", chart)) == ["ax", "ay", "az", "gx", "gy", "gz"]


@pytest.mark.parametrize(("width", "lines", "expected"), [(120, 12, 12), (80, 40, MAX_LINES), (60, 20, 20)])
def test_charts_fit_the_space(width: int, lines: int, expected: int) -> None:
    chart = draw(example_results.make_estimate().curve, width, lines)
    assert len(chart) == expected
    assert max(cell_len(line) for line in chart) <= width


@pytest.mark.parametrize(("width", "lines"), [(120, 7), (60, 15), (35, 40)])
def test_nothing_is_drawn_without_space(width: int, lines: int) -> None:
    assert allan_charts(example_results.make_estimate().curve, DEFAULT_UNITS, width, lines) is None


def test_curve_without_values_is_not_drawn() -> None:
    assert allan_charts(white_noise(1e-3, ()), DEFAULT_UNITS, 120, 15) is None


def test_constant_axes_are_not_drawn() -> None:
    """The variance of a constant signal is 0, which has no logarithm."""
    assert allan_charts(white_noise(0.0), DEFAULT_UNITS, 120, 15) is None
    curve = white_noise(1e-3, (0, 1, 2, 3, 4, 5))
    curve.avar[:, :3] = 0.0
    chart = "\n".join(draw(curve, 120))
    assert sorted(re.findall(r"\b[ag][xyz]\b", chart)) == ["ax", "ay", "az"]
