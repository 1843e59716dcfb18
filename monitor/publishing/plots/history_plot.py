"""Plot of a device's history: coefficients with their extremes, temperature, lost samples and events.

Gyroscopes are on the left, accelerometers on the right, with one row per coefficient that was ever estimated. A line
shows the last value of each bucket, the dark band its extremes, and the pale band the 95 % interval. Lines have a gap
where the device gave no data. An event is a vertical line with a label above it, in the colour of its axis if it has
one. matplotlib is imported when a plot is requested, and draws without a display.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.errors import ConfigError, NotReady
from drivers.sample import AXES, Floats
from monitor.common.units import COEFFICIENT_NAMES, COEFFICIENT_UNITS, KIND_NAMES, KINDS, Kind, axes_of
from monitor.estimation.fit.coefficients import SYMBOLS
from monitor.history.bucket import COUNTS, STATES
from monitor.history.reading import HistoryTable
from monitor.history.stored_events import StoredEvent
from monitor.publishing.plots.allan_figure import COLOURS, DARK, GREY, set_log_ticks, style_grid
from monitor.publishing.plots.analysis_plot import DPI, MISSING
from monitor.publishing.terminal.history_text import summary_line

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PANEL_INCHES: Final = (7.4, 1.75)
"""Size of one panel."""
SPARE_INCHES: Final = 1.1
LOG_SCALE_RATIO: Final = 3.0  # ratio of largest to smallest value above which a logarithmic scale is used
MAX_INTERVAL_RATIO: Final = 1.5  # intervals whose ends differ from the value by more than this factor are not drawn
EVENT_LABELS: Final = {
    "noise_changed": "noise",
    "bias_stepped": "bias",
    "link_lost": "lost",
    "link_back": "back",
    "limit_crossed": "limit",
    "model_disagrees": "model",
    "temperature_unexplained": "temperature",
    "drift_unexplained": "drift",
}
"""Label of each kind of event that is drawn; lost samples have a panel of their own."""
MAX_EVENTS: Final = 40
"""Largest number of events that are drawn; the most significant ones are selected."""
MIN_LABEL_DISTANCE: Final = 0.055  # smallest distance between two labels, as a share of the width
PRIORITY_KINDS: Final = ("noise_changed", "bias_stepped", "limit_crossed", "model_disagrees")


def history_plot(past: HistoryTable, path: Path, axes: Sequence[str] = AXES) -> None:
    """Write the plot; the suffix of ``path`` selects the format.

    Parameters
    ----------
    past
        The history.
    path
        File to write.
    axes
        Axes to draw.

    Raises
    ------
    ConfigError
        matplotlib is missing or the file cannot be written.
    NotReady
        The history has no rows.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ConfigError(MISSING) from error
    if not len(past):
        raise NotReady(f"{past.device}: events alone are not drawn; there are no rows in that time")
    there = [axis for axis in axes if any(_was_estimated(past, axis, letter) for letter in SYMBOLS)]
    shown = {kind: [axis for axis in axes_of(kind) if axis in there] for kind in KINDS}
    kinds = [kind for kind in KINDS if shown[kind]] or [KINDS[0]]
    letters = [one for one in SYMBOLS if any(_was_estimated(past, axis, one) for kind in kinds for axis in shown[kind])]
    rows = len(letters) + (1 if len(kinds) > 1 else 2)
    figure = Figure(
        figsize=(PANEL_INCHES[0] * len(kinds), SPARE_INCHES + PANEL_INCHES[1] * rows), dpi=DPI, layout="constrained"
    )
    FigureCanvasAgg(figure)
    panels: Any = figure.subplots(rows, len(kinds), squeeze=False, sharex=True)
    for column, kind in enumerate(kinds):
        for row, letter in enumerate(letters):
            _draw_coefficient(panels[row, column], past, kind, letter, shown[kind])
        panels[0, column].set_title(KIND_NAMES[kind], loc="left", fontsize=12, fontweight="bold", pad=26)
    below = [panels[-1, 0], panels[-1, 1]] if len(kinds) > 1 else [panels[-2, 0], panels[-1, 0]]
    _temperature(below[0], past)
    _losses(below[1], past)
    _dates(panels, past)
    for column, kind in enumerate(kinds):
        own = [one for one in _select_events(past) if one.axis is None or one.axis in shown[kind]]
        _draw_events(list(panels[:, column]), own)
    figure.suptitle(summary_line(past), fontsize=11)
    try:
        figure.savefig(path)
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot write the plot {path}: {error}") from error


def _was_estimated(past: HistoryTable, axis: str, letter: str) -> bool:
    """Return True if a coefficient was estimated in at least one bucket."""
    return bool(np.isfinite(past.column(f"{axis}.{letter}").last).any())


def _draw_coefficient(panel: "Axes", past: HistoryTable, kind: Kind, letter: str, axes: Sequence[str]) -> None:
    """Draw one coefficient of up to three axes."""
    unit = COEFFICIENT_UNITS[kind][letter]
    lows, highs = [], []
    for axis in axes:
        course, colour = past.column(f"{axis}.{letter}"), COLOURS[AXES.index(axis) % 3]
        ends = [past.column(f"{axis}.{letter}.{end}").last for end in ("lo", "hi")]
        t, low, high, last, lo, hi = _with_gaps(past, *(
            unit.factor * part for part in (course.low, course.high, course.last, *ends)
        ))  # fmt: skip
        if not np.isfinite(last).any():
            continue
        near = (lo * MAX_INTERVAL_RATIO > last) & (hi < last * MAX_INTERVAL_RATIO)
        panel.fill_between(t, np.where(near, lo, np.nan), np.where(near, hi, np.nan), color=colour, alpha=0.12, lw=0)
        panel.fill_between(t, low, high, color=colour, alpha=0.45, lw=0)
        panel.plot(t, last, "-", color=colour, lw=1.1, label=axis)
        lows.append(np.nanmin(low))
        highs.append(np.nanmax(high))
    if not lows:
        panel.text(0.5, 0.5, "never estimated", transform=panel.transAxes, ha="center", color=GREY)
    elif min(lows) > 0 and max(highs) > LOG_SCALE_RATIO * min(lows):
        panel.set_yscale("log")
        panel.set_ylim(min(lows) / 1.2, max(highs) * 1.2)
        set_log_ticks(panel)
    else:
        room = 0.15 * (max(highs) - min(lows)) + 0.02 * max(highs)
        panel.set_ylim(max(min(lows) - room, 0.0), max(highs) + room)
    panel.set_ylabel(f"{letter}, {unit.name}")
    _draw_title(panel, COEFFICIENT_NAMES[kind][letter])
    style_grid(panel)
    if lows:
        panel.legend(loc="upper left", frameon=False, ncols=3, fontsize=8, handlelength=1.2, columnspacing=1.0)


def _temperature(panel: "Axes", past: HistoryTable) -> None:
    """Draw the temperature with its extremes."""
    course = past.column("temperature")
    t, low, high, last = _with_gaps(past, course.low, course.high, course.last)
    if np.isfinite(last).any():
        panel.fill_between(t, low, high, color="#c0841a", alpha=0.4, lw=0)
        panel.plot(t, last, "-", color="#c0841a", lw=1.1)
    else:
        panel.text(0.5, 0.5, "no temperature measured", transform=panel.transAxes, ha="center", color=GREY)
    panel.set_ylabel("°C")
    _draw_title(panel, "temperature")
    style_grid(panel)


def _losses(panel: "Axes", past: HistoryTable) -> None:
    """Draw the number of missing samples by bucket, and the time in which the device was not running."""
    t, width = _days(past.start_s), past.width_s / 86_400.0
    missing = past.counts[:, [COUNTS.index(name) for name in ("lost", "bad", "overflowed")]].sum(axis=1)
    panel.bar(t, missing, width, align="edge", color=DARK)
    away = past.state >= STATES.index("waiting")
    for at in np.flatnonzero(away):
        panel.axvspan(t[at], t[at] + width[at], color="#d9534f", alpha=0.18, lw=0)
    panel.set_ylim(0, max(float(missing.max()) * 1.15, 1.0))
    panel.set_ylabel("samples")
    _draw_title(panel, "lost, bad or overflowed; red: not running at some time")
    style_grid(panel)


def _draw_title(panel: "Axes", text: str) -> None:
    """Write the title of a panel inside it, because event labels are above it."""
    place = {"boxstyle": "square,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
    panel.text(0.995, 0.95, text, transform=panel.transAxes, ha="right", va="top", fontsize=9, color=GREY, bbox=place)


def _select_events(past: HistoryTable) -> list[StoredEvent]:
    """Return the events to draw, in order of time."""
    kinds = [one for one in past.events if one.kind in EVENT_LABELS]
    kinds.sort(key=lambda one: (one.kind not in PRIORITY_KINDS, -(one.sigma or 0.0)))
    return sorted(kinds[:MAX_EVENTS], key=lambda one: one.t_s)


def _draw_events(panels: "Sequence[Axes]", events: Sequence[StoredEvent]) -> None:
    """Draw event lines through the panels and labels above the first one; labels that would overlap are omitted."""
    left, right = panels[0].get_xlim()
    said_to = -np.inf
    for event in events:
        at = float(_days(np.array([event.t_s]))[0])
        colour = GREY if event.axis is None else COLOURS[AXES.index(event.axis) % 3]
        for panel in panels:
            panel.axvline(at, color=colour, lw=0.9, ls=(0, (4, 2)), alpha=0.6)
        if at - said_to < MIN_LABEL_DISTANCE * (right - left):
            continue
        said_to = at
        word = EVENT_LABELS[event.kind] + (f" {event.axis}" if event.axis else "")
        above = panels[0].annotate(
            word, (at, 1.0), xycoords=("data", "axes fraction"), xytext=(1, 3), textcoords="offset points",
            fontsize=7.5, color=colour, rotation=25, ha="left", va="bottom", annotation_clip=False,
        )  # fmt: skip
        above.set_in_layout(False)  # the title reserves the space


def _dates(panels: Any, past: HistoryTable) -> None:
    """Set the limits and labels of the time axes."""
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

    start, end = float(_days(past.start_s[:1])[0]), float(_days(past.end_s[-1:])[0])
    for panel in panels.ravel():
        panel.set_xlim(start, end)
        locator = AutoDateLocator(minticks=4, maxticks=9)  # type: ignore[no-untyped-call]
        panel.xaxis.set_major_locator(locator)
        panel.xaxis.set_major_formatter(ConciseDateFormatter(locator))  # type: ignore[no-untyped-call]
    for panel in panels[-1]:
        panel.set_xlabel("UTC")


def _with_gaps(past: HistoryTable, *columns: Floats) -> tuple[Floats, ...]:
    """Return times in days and the columns, with a NaN wherever buckets are missing."""
    ends, starts = past.end_s[:-1], past.start_s[1:]
    holes: NDArray[np.int64] = np.flatnonzero(starts > ends) + 1
    middle = _days(past.start_s + 0.5 * past.width_s)
    t = np.insert(middle, holes, _days(ends[holes - 1].astype(np.float64)))
    return t, *(np.insert(np.asarray(column, np.float64), holes, np.nan) for column in columns)


def _days(unix_s: "Floats | NDArray[np.int64]") -> Floats:
    """Convert Unix seconds to the dates of matplotlib: days since 1970."""
    return np.asarray(unix_s, np.float64) / 86_400.0
