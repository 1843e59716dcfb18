"""Report of one analysis as a self-contained HTML page, for ``imu-monitor analyze --plot FILE.html``.

The page needs no network. It holds the Allan plot of each kind of sensor as inline SVG and the table of coefficients
with intervals in the units of the field. It also holds facts about the recording, the notes, and the dynamic curves if
they were computed. Heat maps are images inside the SVG, so that the page stays below one megabyte. matplotlib and
Jinja2 are imported when a report is requested.
"""

import io
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from drivers.errors import ConfigError
from drivers.sample import AXES
from monitor.common.units import COEFFICIENT_NAMES, KIND_NAMES, Kind, axes_of, format_duration, format_number, unit_of
from monitor.estimation.allan.dynamic_allan import DynamicAllan
from monitor.estimation.analysis import Analysis
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients import SYMBOLS, Status
from monitor.publishing.coefficient_cells import (
    TEMPERATURE_MARK,
    TEMPERATURE_MEANS,
    format_coefficient,
    mark_temperature_axis,
)
from monitor.publishing.plots import analysis_plot
from monitor.publishing.plots.allan_figure import COLOURS, LEGEND_TEXT, OtherDeviation, allan_panel
from monitor.publishing.plots.dynamic_figure import ChangeMark, dynamic_panels, height_inches

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TEMPLATE: Final = "report.html.j2"
ALLAN_INCHES: Final = (7.2, 5.2)
DYNAMIC_WIDTH_INCHES: Final = 7.2
IMAGE_DPI: Final = 80  # resolution of heat maps and bands, which are images inside the SVG
SIMPLIFY_THRESHOLD_PX: Final = 0.6  # corners of a line closer than this to it are removed
MISSING_MESSAGE: Final = 'matplotlib and Jinja2 are needed: pip install "imu-monitor[plot]"'
STATUS_TEXTS: Final = {
    Status.ESTIMATED: "",
    Status.UPPER_BOUND: "upper bound",
    Status.UNESTIMATED: "too few data",
}
K_OR_R: Final = "upper bound; K or R"


@dataclass(frozen=True, slots=True)
class Cell:
    """Text of one coefficient of one axis."""

    value: str  # "0.516 °/√h", "≤ 3.10 °/h", "—"
    interval: str  # "0.512 … 0.520", or ""
    word: str  # "upper bound", "too few data", or "" if it is estimated


@dataclass(frozen=True, slots=True)
class Row:
    """Row of one coefficient in a table."""

    letter: str
    name: str
    cells: tuple[Cell, ...]


@dataclass(frozen=True, slots=True)
class Part:
    """Section of the page for one kind of sensor."""

    name: str
    axes: tuple[tuple[str, str], ...]  # name with temperature mark, and colour
    rows: tuple[Row, ...]
    allan: str  # SVG
    dynamic: str  # SVG, or "" if there are no dynamic curves


def html_report(
    analysis: Analysis,
    path: Path,
    title: str = "",
    others: Sequence[OtherDeviation] = (),
    dynamic: DynamicAllan | None = None,
    marks: Sequence[ChangeMark] = (),
) -> None:
    """Write the page.

    Parameters
    ----------
    analysis
        The analysis.
    path
        File to write.
    title
        Title of the page.
    others
        Other deviations, such as total and Hadamard deviation.
    dynamic
        Dynamic curves of the same recording.
    marks
        Changes to mark in the dynamic curves.

    Raises
    ------
    ConfigError
        matplotlib or Jinja2 is missing, or the file cannot be written.
    """
    page = render_page(analysis, title, others, dynamic, marks)
    try:
        path.write_text(page, "utf-8")
    except OSError as error:
        raise ConfigError(f"cannot write the report {path}: {error}") from error


def render_page(
    analysis: Analysis,
    title: str = "",
    others: Sequence[OtherDeviation] = (),
    dynamic: DynamicAllan | None = None,
    marks: Sequence[ChangeMark] = (),
) -> str:
    """Return the page as text.

    Parameters
    ----------
    analysis
        The analysis.
    title
        Title of the page.
    others
        Other deviations, such as total and Hadamard deviation.
    dynamic
        Dynamic curves of the same recording.
    marks
        Changes to mark in the dynamic curves.

    Raises
    ------
    ConfigError
        matplotlib or Jinja2 is missing.
    """
    try:
        import matplotlib.figure as _  # noqa: F401
        from jinja2 import Environment, PackageLoader, StrictUndefined
    except ImportError as error:
        raise ConfigError(MISSING_MESSAGE) from error
    environment = Environment(
        loader=PackageLoader("monitor.publishing.reports"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    estimate = analysis.estimate
    return environment.get_template(TEMPLATE).render(
        title=title or "Recording",
        facts=facts(analysis),
        notes=analysis.notes,
        parts=[
            _part(estimate, kind, others, dynamic, marks, analysis.axes_of_temperature)
            for kind in analysis_plot.kinds_of(estimate)
        ],
        temperature=f"{TEMPERATURE_MARK} {TEMPERATURE_MEANS}." if analysis.axes_of_temperature else "",
        reading=LEGEND_TEXT,
        window="" if dynamic is None else format_duration(dynamic.window_s),
    )


def facts(analysis: Analysis) -> tuple[tuple[str, str], ...]:
    """Return names and values that describe the recording."""
    estimate = analysis.estimate
    missing = max(estimate.curve.n - estimate.samples, 0)
    share = f" ({format_number(100.0 * missing / estimate.curve.n, 2)} %)" if missing else ""
    return (
        ("rate", f"{estimate.rate_hz:.6g} Hz"),
        ("samples", f"{estimate.samples:,}"),
        ("duration", format_duration(analysis.seconds)),
        ("missing samples", f"{missing:,}{share}" if missing else "none"),
        ("averaging times", f"{format_number(estimate.curve.tau_s[0])} … {format_number(estimate.curve.tau_s[-1])} s"),
    )


def table(estimate: Estimate, kind: Kind) -> tuple[Row, ...]:
    """Return the table of coefficients of one kind of sensor.

    Parameters
    ----------
    estimate
        The estimate.
    kind
        Kind of sensor.
    """
    return tuple(
        Row(letter, COEFFICIENT_NAMES[kind][letter], tuple(_cell(estimate, letter, axis) for axis in axes_of(kind)))
        for letter in SYMBOLS
    )


def _cell(estimate: Estimate, letter: str, axis: str) -> Cell:
    """Return the text of one coefficient of one axis."""
    known = estimate.coefficients
    status = Status(int(known.status[SYMBOLS.index(letter), AXES.index(axis)]))
    one = format_coefficient(known, letter, axis)
    value = one.value if status == Status.UNESTIMATED else f"{one.value} {unit_of(letter, axis).name}"
    word = K_OR_R if analysis_plot.k_or_r(estimate, letter, axis) else STATUS_TEXTS[status]
    return Cell(value, one.interval, word)


def _part(
    estimate: Estimate,
    kind: Kind,
    others: Sequence[OtherDeviation],
    dynamic: DynamicAllan | None,
    marks: Sequence[ChangeMark],
    axes_of_temperature: Collection[str],
) -> Part:
    """Return the section of one kind of sensor, drawn with simplified lines."""
    import matplotlib

    # A path keeps the threshold that was set when it was created.
    with matplotlib.rc_context({"path.simplify_threshold": SIMPLIFY_THRESHOLD_PX}):
        return _draw_part(estimate, kind, others, dynamic, marks, axes_of_temperature)


def _draw_part(
    estimate: Estimate,
    kind: Kind,
    others: Sequence[OtherDeviation],
    dynamic: DynamicAllan | None,
    marks: Sequence[ChangeMark],
    axes_of_temperature: Collection[str],
) -> Part:
    """Draw the figures of one kind of sensor and return its section."""
    from matplotlib.figure import Figure

    curves = Figure(figsize=ALLAN_INCHES, layout="constrained")
    allan_panel(curves.subplots(), estimate, kind, others)
    surface = ""
    if dynamic is not None:
        figure = Figure(figsize=(DYNAMIC_WIDTH_INCHES, height_inches(dynamic, kind)), layout="constrained")
        dynamic_panels(figure, dynamic, kind, marks)
        surface = _svg(figure, f"{kind}-dynamic")
    names = (mark_temperature_axis(axis, axes_of_temperature) for axis in axes_of(kind))
    tints = tuple(zip(names, COLOURS, strict=True))
    return Part(KIND_NAMES[kind], tints, table(estimate, kind), _svg(curves, f"{kind}-allan"), surface)


def _svg(figure: "Figure", salt: str) -> str:
    """Return the figure as an SVG element with identifiers unique within the page; the result is reproducible."""
    import matplotlib

    text = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": salt}):
        figure.savefig(text, format="svg", dpi=IMAGE_DPI, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    element = text.getvalue()[text.getvalue().index("<svg") :]
    # The identifiers of glyphs and clip paths are unique only within a figure.
    element = re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{salt}-", element)
    # The width of the column replaces the size in inches.
    return re.sub(
        r'(<svg[^>]*?) width="[^"]*"', r"\1", re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", element, count=1), count=1
    )
