"""Tables of the noise coefficients of one device with intervals, for ``analyze`` and ``watch``."""

from collections.abc import Collection, Sequence
from typing import Final

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from monitor.common.unit_formatting import (
    DEFAULT_UNITS,
    KIND_NAMES,
    KINDS,
    NO_VALUE,
    CoefficientColumn,
    Kind,
    UnitSystem,
    axes_of,
    format_duration,
)
from monitor.estimation.estimate import Estimate
from monitor.publishing.coefficient_cells import (
    TEMPERATURE_MARK,
    TEMPERATURE_MEANS,
    format_coefficient,
    mark_temperature_axis,
)
from monitor.publishing.remote_device_states import DeviceCoefficients
from monitor.publishing.terminal.console import Console
from monitor.publishing.terminal.tables import WidthDependentTable, plain_table, print_notes

K_OR_R: Final = "K or R"
"""Text that the tables show for K and R if the data cannot distinguish K from R."""


def print_analysis(
    estimate: Estimate,
    axes_of_temperature: Collection[str] = (),
    notes: Sequence[str] = (),
    units: UnitSystem = DEFAULT_UNITS,
    console: Console | None = None,
) -> None:
    """Print the number of samples, the coefficients and the notes of an analysis.

    Parameters
    ----------
    estimate
        Estimate of the noise coefficients.
    axes_of_temperature
        Axes to mark, on which temperature explains most of the slow variance.
    notes
        Notes of the analysis.
    units
        Units of the table.
    console
        Console that receives the output. By default, standard output.
    """
    console = console or Console()
    curve = estimate.curve
    console.print(f"{curve.n} samples at {estimate.rate_hz:g} Hz, {curve.n / estimate.rate_hz:.6g} s")
    console.print(analysis_table(estimate, axes_of_temperature, units))
    print_notes(notes, console)


def analysis_table(
    estimate: Estimate, axes_of_temperature: Collection[str] = (), units: UnitSystem = DEFAULT_UNITS
) -> RenderableType:
    """Return the table of noise coefficients with 95 % intervals that ``analyze`` prints.

    Parameters
    ----------
    estimate
        Estimate of the noise coefficients.
    axes_of_temperature
        Axes to mark, on which temperature explains most of the slow variance.
    units
        Units of the table.
    """
    return Group(*coefficient_tables(DeviceCoefficients.from_estimate(estimate), axes_of_temperature, units))


def coefficient_tables(
    coefficients: DeviceCoefficients,
    axes_of_temperature: Collection[str] = (),
    units: UnitSystem = DEFAULT_UNITS,
    with_intervals: bool = True,
) -> list[RenderableType]:
    """Return a legend, and tables of the noise coefficients of gyroscopes and accelerometers.

    Parameters
    ----------
    coefficients
        Noise coefficients of the device.
    axes_of_temperature
        Axes to mark, on which temperature explains most of the slow variance.
    units
        Units of the tables.
    with_intervals
        False to omit the 95 % intervals, so that each axis has one line.
    """
    time_text = "" if coefficients.filled_s is None else f"last {format_duration(coefficients.filled_s)}; "
    marks = f"; {K_OR_R}: one of them" if coefficients.k_or_r else ""
    marks += f"; {TEMPERATURE_MARK} {TEMPERATURE_MEANS}" if axes_of_temperature else ""
    marks += "; densities are one-sided" if units.densities else ""
    interval_text = "[95 % interval]; " if with_intervals else ""
    legend = Text(f"{time_text}{interval_text}≤ bound; {NO_VALUE} too few data yet{marks}", style="dim")
    parts: list[RenderableType] = [legend]
    line_counts = (1, 2, 3) if with_intervals else (0,)
    for kind in KINDS:
        if set(axes_of(kind)) & set(coefficients.axes):
            layouts = (_kind_table(coefficients, kind, lines, axes_of_temperature, units) for lines in line_counts)
            parts.append(WidthDependentTable(*layouts))
    return parts


def _kind_table(
    known: DeviceCoefficients, kind: Kind, lines: int, axes_of_temperature: Collection[str], units: UnitSystem
) -> Table:
    """Return a table with one to three lines for each axis: value, and lower and upper end of the interval.

    With 0 lines, the intervals are omitted.
    """
    table = plain_table(KIND_NAMES[kind] if lines == 1 else kind, gap=2 if 0 < lines < 3 else 1)
    columns = units.columns(kind)
    for one in columns:
        table.add_column(f"{one.symbol} {one.unit.name}", justify="right", no_wrap=True)
    for axis in (axis for axis in axes_of(kind) if axis in known.axes):
        cells = [_cell(known, column, axis, lines) for column in columns]
        table.add_row(Text(mark_temperature_axis(axis, axes_of_temperature), style="bold"), *cells)
    return table


def _cell(known: DeviceCoefficients, column: CoefficientColumn, axis: str, lines: int) -> Text:
    one = format_coefficient(known.coefficients, column.symbol, axis, unit=column.unit)
    interval = one.interval.replace(" … ", " …\n") if lines == 3 else one.interval
    separator = " " if lines < 2 else "\n"
    small = [f"[{interval}]"] if interval and lines else []
    if axis in known.k_or_r and column.symbol in ("K", "R"):
        small.append(K_OR_R)
    return Text.assemble(one.value, *((separator + part, "dim") for part in small))
