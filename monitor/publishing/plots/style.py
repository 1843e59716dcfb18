"""Style of all figures, and output of figures as image files and SVG elements.

Figures do not use pyplot and need no display. Drawing the same data twice gives identical files, because the files
contain no date and no random identifiers. matplotlib is imported when the first figure is drawn.
"""

import hashlib
import html
import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from drivers.data_types import AXES, Floats
from drivers.errors import ConfigError
from drivers.host.extras import install_command

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS: Final = ("#D55E00", "#009E73", "#0072B2")  # x y z: vermilion, bluish green, blue (Okabe & Ito)
DARK: Final = "#222222"
GREY: Final = "#6b6b6b"
ORANGE: Final = "#E69F00"  # marks a range in which recording and model differ (Okabe & Ito)
MINOR_GRID_COLOUR: Final = "#ececec"
BAND_ALPHA: Final = 0.16
DASHES: Final = (0, (4, 2))
SMALL_TEXT: Final = 8.0  # points
MISSING_MESSAGE: Final = f"matplotlib is not installed: {install_command('imu-monitor[plot]')}"
STYLE: Final[dict[Any, Any]] = {
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.5,
    "axes.titlesize": 11.0,
    "axes.titlelocation": "left",
    "figure.titlesize": 11.5,
    "figure.dpi": 150.0,
    "text.color": DARK,
    "text.parse_math": False,  # names of recordings may contain a dollar sign
    "axes.labelcolor": DARK,
    "axes.edgecolor": "#999999",
    "xtick.color": DARK,
    "ytick.color": DARK,
    "xtick.bottom": False,  # grid lines show the positions of ticks
    "ytick.left": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#d0d0d0",
    "grid.linewidth": 0.7,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "legend.handlelength": 1.6,
    "legend.handletextpad": 0.5,
    "legend.columnspacing": 1.1,
    "path.simplify_threshold": 0.6,
    "svg.fonttype": "none",
    "svg.hashsalt": "imu-monitor",
}
UNDATED: Final[dict[str, dict[str, Any]]] = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
"""Metadata settings that omit the date from a file, by the suffix of the file."""
RASTER_DPI: Final = 80  # resolution of heat maps and dense bands, which are raster images inside an SVG
FEW_DECADES_RATIO: Final = 60.0  # if the ratio of the limits is smaller, an axis also has labels between powers of ten
MAX_LABELS: Final = 7  # largest number of powers of ten with a label
LOG_SCALE_RATIO: Final = 3.0  # values that differ by a larger factor are drawn on a logarithmic scale
MAX_INTERVAL_RATIO: Final = 1.5  # an interval is not drawn if its end differs from the value by more than this factor
SUPERSCRIPTS: Final = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
LABEL_BOX: Final[dict[str, Any]] = {
    "boxstyle": "square,pad=0.15",
    "facecolor": "white",
    "edgecolor": "none",
    "alpha": 0.8,
}
"""Style of the box behind a label in a panel, which keeps the label legible over curves."""
TIME_UNITS: Final = (("s", 1.0, 600.0), ("min", 60.0, 10_800.0), ("h", 3600.0, 259_200.0), ("d", 86_400.0, np.inf))
"""Name and length [s] of each time unit, and the duration [s] below which a time axis uses this unit."""


def axis_colour(axis: str) -> str:
    """Return the colour of a gyroscope or accelerometer axis, which depends only on the direction x, y or z."""
    return COLOURS[AXES.index(axis) % 3]


@contextmanager
def figure_style() -> Iterator[None]:
    """Return a context manager that applies the figure style inside a ``with`` block.

    Raises
    ------
    ConfigError
        If matplotlib is not installed.
    """
    try:
        import matplotlib
        import matplotlib.figure
    except ImportError as error:
        raise ConfigError(MISSING_MESSAGE) from error
    with matplotlib.rc_context(STYLE):
        yield


def create_figure(width: float, height: float, layout: Literal["constrained"] | None = "constrained") -> "Figure":
    """Return an empty figure.

    Parameters
    ----------
    width, height
        Width and height of the figure [inches].
    layout
        By default, matplotlib arranges the panels so that labels do not overlap. With None, panels keep their
        positions.
    """
    from monitor.publishing.plots.notebook_figure import NotebookFigure

    return NotebookFigure(figsize=(width, height), layout=layout)


def save_figure(figure: "Figure", path: Path) -> None:
    """Write a figure to a file.

    Parameters
    ----------
    figure
        Figure to write.
    path
        File to write. The suffix selects the format.

    Raises
    ------
    ConfigError
        If the file cannot be written.
    """
    try:
        figure.savefig(path, metadata=UNDATED.get(path.suffix.lower()))
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot write the plot {path}: {error}") from error


def to_svg_element(figure: "Figure", description: str) -> str:
    """Convert a figure to an SVG element without a fixed width and height.

    Parameters
    ----------
    figure
        Figure to convert.
    description
        Text alternative for people who cannot see the figure.
    """
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    text = io.StringIO()
    figure.set_dpi(RASTER_DPI)
    canvas: Any = FigureCanvasSVG(figure)
    # savefig would draw the figure twice
    canvas.print_svg(text, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    element = text.getvalue()[text.getvalue().index("<svg") :]
    element = re.sub(r' (?:width|height)="[\d.]+pt"', "", element, count=2)
    element = element.replace("<svg", f'<svg role="img" aria-label="{html.escape(description)}"', 1)
    # No element refers to these identifiers, and equal images have the same one.
    element = re.sub(r'(<g|<image[^>]*?) id="[^"]*"', r"\1", element)
    element = re.sub(r"<[^>]*>", lambda tag: re.sub(r"\d+\.\d{3,}", _shorten, tag[0]), element)
    element = re.sub(r"\n(?:L )?\s*", " ", element)  # in an SVG path, coordinates without a letter continue a line
    prefix = hashlib.sha256(element.encode()).hexdigest()[:8]  # figures on the same page need different identifiers
    return re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{prefix}", element)


def _shorten(number: re.Match[str]) -> str:
    return f"{float(number[0]):.1f}".removesuffix(".0")


def format_tick(value: float) -> str:
    """Format the number at a tick of an axis.

    >>> format_tick(0.01), format_tick(-2000.0), format_tick(1e4), format_tick(2.5e-7)
    ('0.01', '−2000', '10⁴', '2.5·10⁻⁷')
    """
    sign, size = "−" if value < 0.0 else "", abs(value)
    mantissa, power = f"{size:.4e}".split("e")
    factor = f"{float(mantissa):g}"
    if size == 0.0 or 0.99e-3 < size < (1e4 if factor == "1" else 1e5):
        return f"{sign}{size:.5g}"
    return f"{sign}{'' if factor == '1' else f'{factor}·'}10{str(int(power)).translate(SUPERSCRIPTS)}"


def style_log_axis(panel: "Axes", which: str, minor_grid: bool = True) -> None:
    """Label a logarithmic axis with plain numbers and draw the grid lines.

    Powers of ten are labelled. If the axis covers few decades, 2 and 5 times each power of ten are also labelled.

    Parameters
    ----------
    panel
        Axes object of matplotlib, whose limits have already been set.
    which
        Axis to label: x or y.
    minor_grid
        True to draw grid lines between the powers of ten.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

    axis, (low, high) = (panel.xaxis, panel.get_xlim()) if which == "x" else (panel.yaxis, panel.get_ylim())
    few = high / low < FEW_DECADES_RATIO
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,), numticks=MAX_LABELS + 2))
    axis.set_major_formatter(FuncFormatter(lambda value, _: format_tick(value)))
    axis.set_minor_formatter(NullFormatter())
    axis.set_minor_locator(LogLocator(subs=tuple(range(2, 10)), numticks=50) if minor_grid else NullLocator())
    panel.grid(which="minor", axis=which, color=MINOR_GRID_COLOUR, linewidth=0.5)  # type: ignore[arg-type]


def draw_band(panel: "Axes", x: Floats, lo: Floats, hi: Floats, colour: str, **options: Any) -> None:
    """Draw a confidence interval as a translucent band.

    Parameters
    ----------
    panel
        Axes object of matplotlib.
    x, lo, hi
        Horizontal positions, and lower and upper ends of the intervals, shape [n].
    colour
        Colour of the band.
    options
        Further options of matplotlib's ``fill_between``.
    """
    panel.fill_between(x, lo, hi, **{"color": colour, "alpha": BAND_ALPHA, "linewidth": 0, **options})


def draw_legend_above(panel: "Axes", columns: int, **options: Any) -> None:
    """Draw the legend above the panel.

    Parameters
    ----------
    panel
        Axes object of matplotlib.
    columns
        Number of columns of the legend.
    options
        Further options of matplotlib's ``legend``.
    """
    panel.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2, ncols=columns, **options)


def choose_y_scale_and_limits(panel: "Axes", smallest: float, largest: float, margin: float) -> None:
    """Set the scale and the limits of the y axis. A logarithmic scale is used if the values span a wide range.

    Parameters
    ----------
    panel
        Axes object of matplotlib.
    smallest, largest
        Smallest and largest of the drawn values.
    margin
        Margin above and below the values on a linear scale, as a share of their range.
    """
    if smallest > 0 and largest > LOG_SCALE_RATIO * smallest:
        panel.set_yscale("log")
        panel.set_ylim(smallest / 1.3, largest * 1.3)
        style_log_axis(panel, "y")
    else:
        space = margin * (largest - smallest) + 0.02 * largest
        panel.set_ylim(max(smallest - space, 0.0), largest + space)


def omit_wide_intervals(value: Floats, lo: Floats, hi: Floats) -> tuple[Floats, Floats]:
    """Return the ends of intervals, NaN for wide intervals that would dominate the scale of a plot.

    Parameters
    ----------
    value, lo, hi
        Values, and lower and upper ends of their intervals, all of the same shape.
    """
    near = (lo * MAX_INTERVAL_RATIO > value) & (hi < value * MAX_INTERVAL_RATIO)
    return np.where(near, lo, np.nan), np.where(near, hi, np.nan)


def select_time_unit(duration_s: float) -> tuple[str, float]:
    """Return the name and the length [s] of a time unit that suits a time axis of the given duration.

    >>> select_time_unit(7200.0), select_time_unit(5e5)
    (('min', 60.0), ('d', 86400.0))
    """
    return next((name, seconds) for name, seconds, below in TIME_UNITS if duration_s < below)
