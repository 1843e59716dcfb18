"""Plot of the history of a device, with coefficients, temperature, missing samples and events.

A line shows the last value in each time interval (bucket), a dark band the extremes, and a pale band the 95 % interval.
The line is interrupted where buckets are missing. Vertical lines mark events.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import AXES, Floats
from drivers.errors import NotReady
from drivers.validation.number_ranges import DAY_S
from monitor.common.unit_formatting import (
    COEFFICIENT_NAMES,
    DEFAULT_UNITS,
    KIND_NAMES,
    KINDS,
    Kind,
    UnitSystem,
    axes_of,
)
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS
from monitor.history.bucketed_history import HistoryTable
from monitor.history.history_row import COUNTS, STATES
from monitor.history.stored_events import StoredEvent
from monitor.publishing.plots import style
from monitor.publishing.terminal.history_text import summary_line

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PANEL_INCHES: Final = (7.4, 1.75)
SPARE_INCHES: Final = 1.1  # height of title and time axis
TITLE_PAD_POINTS: Final = 26.0  # space for the labels of events between the first panel and its title
EXTREMES_ALPHA: Final = 0.45
NOT_RUNNING_COLOUR: Final = "#d9534f"
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
"""Label of each kind of event that the plot shows."""
MAX_EVENTS: Final = 40  # only the most significant events are drawn
MIN_LABEL_DISTANCE: Final = 0.055  # smallest distance between two labels of events, as a share of the width
PRIORITY_KINDS: Final = ("noise_changed", "bias_stepped", "limit_crossed", "model_disagrees")


def save_history_plot(
    past: HistoryTable, path: Path, axes: Sequence[str] = AXES, units: UnitSystem = DEFAULT_UNITS
) -> None:
    """Write the plot of the stored results of a device to a file.

    Parameters
    ----------
    past
        Stored history of the device.
    path
        File to write. The suffix selects the format.
    axes
        Names of the axes to draw.
    units
        Units of the coefficients.

    Raises
    ------
    ConfigError
        If matplotlib is not installed or the file cannot be written.
    NotReady
        If the history has no rows.
    """
    if not len(past):
        raise NotReady(f"{past.device}: no rows in the time range; events alone cannot be drawn")
    with style.figure_style():
        drawn = {
            kind: [axis for axis in axes_of(kind) if axis in axes and _estimated_coefficients(past, axis)]
            for kind in KINDS
        }
        kinds = [kind for kind in KINDS if drawn[kind]] or [KINDS[0]]
        estimated = {letter for kind in kinds for axis in drawn[kind] for letter in _estimated_coefficients(past, axis)}
        letters = [letter for letter in SYMBOLS if letter in estimated]
        rows = len(letters) + (1 if len(kinds) > 1 else 2)
        figure = style.create_figure(PANEL_INCHES[0] * len(kinds), SPARE_INCHES + PANEL_INCHES[1] * rows)
        panels = figure.subplots(rows, len(kinds), squeeze=False, sharex=True)
        for column, kind in enumerate(kinds):
            for panel, letter in zip(panels[:, column], letters, strict=False):
                _draw_coefficient(panel, past, kind, letter, drawn[kind], units)
            panels[0, column].set_title(KIND_NAMES[kind], fontweight="bold", pad=TITLE_PAD_POINTS)
        temperature, losses = panels.ravel()[-2:]
        _draw_temperature(temperature, past)
        _draw_losses(losses, past)
        _set_dates(panels, past)
        for column, kind in enumerate(kinds):
            events = [one for one in _select_events(past) if one.axis is None or one.axis in drawn[kind]]
            _draw_events(list(panels[:, column]), events)
        figure.suptitle(summary_line(past))
        style.save_figure(figure, path)


def _estimated_coefficients(past: HistoryTable, axis: str) -> list[str]:
    return [letter for letter in SYMBOLS if np.isfinite(past.select_column(f"{axis}.{letter}").last).any()]


def _draw_coefficient(
    panel: "Axes", past: HistoryTable, kind: Kind, letter: str, axes: Sequence[str], units: UnitSystem
) -> None:
    unit = units.single(kind, letter)
    lows, highs = [], []
    for axis in axes:
        column, colour = past.select_column(f"{axis}.{letter}"), style.axis_colour(axis)
        ends = [past.select_column(f"{axis}.{letter}.{end}").last for end in ("lo", "hi")]
        t, low, high, last, lo, hi = _with_gaps(past, *(
            unit.factor * part for part in (column.low, column.high, column.last, *ends)
        ))  # fmt: skip
        if not np.isfinite(last).any():
            continue
        style.draw_band(panel, t, *style.omit_wide_intervals(last, lo, hi), colour)
        style.draw_band(panel, t, low, high, colour, alpha=EXTREMES_ALPHA)
        panel.plot(t, last, color=colour, lw=1.1, label=axis)
        lows.append(np.nanmin(low))
        highs.append(np.nanmax(high))
    if lows:
        style.choose_y_scale_and_limits(panel, float(min(lows)), float(max(highs)), 0.15)
        panel.legend(loc="upper left", ncols=3, fontsize=style.SMALL_TEXT, frameon=True, edgecolor="none")
    else:
        _draw_absence(panel, "never estimated")
    panel.set_ylabel(f"{letter}, {unit.name}")
    _draw_title(panel, COEFFICIENT_NAMES[kind][letter])


def _draw_temperature(panel: "Axes", past: HistoryTable) -> None:
    column = past.select_column("temperature")
    t, low, high, last = _with_gaps(past, column.low, column.high, column.last)
    if np.isfinite(last).any():
        style.draw_band(panel, t, low, high, style.ORANGE, alpha=EXTREMES_ALPHA)
        panel.plot(t, last, color=style.ORANGE, lw=1.1)
    else:
        _draw_absence(panel, "no temperature measured")
    panel.set_ylabel("°C")
    _draw_title(panel, "temperature")


def _draw_losses(panel: "Axes", past: HistoryTable) -> None:
    t, width = _days(past.start_s), past.width_s / DAY_S
    missing = past.counts[:, [COUNTS.index(name) for name in ("lost", "bad", "overflowed")]].sum(axis=1)
    panel.bar(t, missing, width, align="edge", color=style.DARK)
    for at in np.flatnonzero(past.state >= STATES.index("waiting")):
        panel.axvspan(t[at], t[at] + width[at], color=NOT_RUNNING_COLOUR, alpha=0.18, lw=0)
    panel.set_ylim(0, max(float(missing.max()) * 1.15, 1.0))
    panel.set_ylabel("samples")
    _draw_title(panel, "lost, bad or overflowed; red: not running at some time")


def _draw_absence(panel: "Axes", text: str) -> None:
    panel.text(0.5, 0.5, text, transform=panel.transAxes, ha="center", color=style.GREY)


def _draw_title(panel: "Axes", text: str) -> None:
    """Draw the title inside the panel, because the labels of events occupy the space above the panel."""
    position: dict[str, Any] = {"transform": panel.transAxes, "ha": "right", "va": "top", "bbox": style.LABEL_BOX}
    panel.text(0.995, 0.95, text, fontsize=9, color=style.GREY, **position)


def _select_events(past: HistoryTable) -> list[StoredEvent]:
    known = [one for one in past.events if one.kind in EVENT_LABELS]
    known.sort(key=lambda one: (one.kind not in PRIORITY_KINDS, -(one.sigma or 0.0)))
    return sorted(known[:MAX_EVENTS], key=lambda one: one.t_s)


def _draw_events(panels: "Sequence[Axes]", events: Sequence[StoredEvent]) -> None:
    left, right = panels[0].get_xlim()
    last_label = -np.inf
    for event in events:
        t = float(_days(np.array([event.t_s]))[0])
        colour = style.GREY if event.axis is None else style.axis_colour(event.axis)
        for panel in panels:
            panel.axvline(t, color=colour, lw=0.9, ls=style.DASHES, alpha=0.6)
        if t - last_label < MIN_LABEL_DISTANCE * (right - left):
            continue
        last_label = t
        label = panels[0].annotate(
            EVENT_LABELS[event.kind] + (f" {event.axis}" if event.axis else ""),
            (t, 1.0), xycoords=("data", "axes fraction"), xytext=(1, 3), textcoords="offset points",
            fontsize=7.5, color=colour, rotation=25, ha="left", va="bottom", annotation_clip=False,
        )  # fmt: skip
        label.set_in_layout(False)  # the padding of the title already reserves space for the label


def _set_dates(panels: Any, past: HistoryTable) -> None:
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

    panels[0, 0].set_xlim(float(_days(past.start_s[:1])[0]), float(_days(past.end_s[-1:])[0]))
    for panel in panels[-1]:
        locator = AutoDateLocator(minticks=4, maxticks=9)  # type: ignore[no-untyped-call]
        panel.xaxis.set_major_locator(locator)
        panel.xaxis.set_major_formatter(ConciseDateFormatter(locator))  # type: ignore[no-untyped-call]
        panel.set_xlabel("UTC")


def _with_gaps(past: HistoryTable, *columns: Floats) -> tuple[Floats, ...]:
    """Return times in days and the given columns, with NaN inserted where time intervals are missing."""
    ends, starts = past.end_s[:-1], past.start_s[1:]
    gaps: NDArray[np.int64] = np.flatnonzero(starts > ends) + 1
    t = np.insert(_days(past.start_s + 0.5 * past.width_s), gaps, _days(ends[gaps - 1].astype(np.float64)))
    return t, *(np.insert(np.asarray(column, np.float64), gaps, np.nan) for column in columns)


def _days(unix_s: "Floats | NDArray[np.int64]") -> Floats:
    """Convert Unix times [s] to matplotlib dates, which are days since 1970."""
    return np.asarray(unix_s, np.float64) / DAY_S
