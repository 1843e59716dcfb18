"""Plot of drift compensation: drift over time and Allan deviation, one row per axis.

matplotlib is imported when a plot is requested, and draws without a display.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from drivers.errors import ConfigError
from drivers.sample import AXES
from monitor.common.distributions import Z95
from monitor.common.units import DEVIATION_UNITS
from monitor.drift.compensation.compensation_result import AxisCompensation, CompensationResult
from monitor.drift.compensation.sage_husa import USED
from monitor.publishing.plots.allan_figure import COLOURS, GREY
from monitor.publishing.plots.analysis_plot import DPI, MISSING
from monitor.publishing.rerun.panels import format_duration

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ROW_INCHES: Final = (11.0, 2.6)
UNIT: Final = DEVIATION_UNITS["gyro"]


def compensate_plot(result: CompensationResult, path: Path) -> None:
    """Write the plot.

    Parameters
    ----------
    result
        Results of the compensation.
    path
        File to write; its suffix selects the format.

    Raises
    ------
    ConfigError
        matplotlib is missing or the file cannot be written.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ConfigError(MISSING) from error
    figure = Figure(figsize=(ROW_INCHES[0], 0.7 + ROW_INCHES[1] * len(result.axes)), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    panels: Any = figure.subplots(len(result.axes), 2, squeeze=False, width_ratios=[1.7, 1.0])
    for (over_time, allan), (axis, one) in zip(panels, result.axes.items(), strict=True):
        _drift(over_time, axis, result)
        _allan(allan, axis, one)
    panels[-1, 0].set_xlabel("time, min")
    panels[-1, 1].set_xlabel("averaging time, s")
    figure.suptitle(f"{result.recording}: drift and noise of the gyros, {result.method}", fontsize=12)
    try:
        figure.savefig(path)
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot write the plot {path}: {error}") from error


def _drift(panel: "Axes", axis: str, result: CompensationResult) -> None:
    """Draw the means at rest and the predicted drift of one axis."""
    at = AXES.index(axis)
    minutes = np.array([one.end for one in result.intervals]) / result.rate_hz / 60.0
    mean = np.array([one.mean[at] for one in result.intervals])
    used = np.array([one.outcome[at] for one in result.intervals]) == USED
    expected = np.array([one.expected[at] for one in result.intervals])
    error = Z95 * np.array([one.known[at] for one in result.intervals])
    middle = float(np.nanmedian(np.where(used, mean, np.nan)))
    mean, expected, error = UNIT.factor * (mean - middle), UNIT.factor * (expected - middle), UNIT.factor * error
    panel.plot(
        minutes[used], mean[used], ".", ms=2, color=GREY, label=f"means of {format_duration(result.interval_s)} at rest"
    )
    panel.fill_between(minutes, expected - error, expected + error, color=COLOURS[at], alpha=0.25, lw=0)
    panel.plot(minutes, expected, color=COLOURS[at], lw=1.3, label="drift expected before each, 95 %")
    far = np.nanmax(np.abs(np.concatenate([mean[used], expected]))) if used.any() else 1.0
    panel.set_ylim(-1.1 * far, 1.1 * far)
    panel.set_ylabel(f"{axis} about its middle, {UNIT.name}")
    panel.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, fontsize=7.5, frameon=False, borderaxespad=0.1)


def _allan(panel: "Axes", axis: str, one: AxisCompensation) -> None:
    """Draw the Allan deviation of one axis before and after compensation."""
    colour = COLOURS[AXES.index(axis)]
    panel.loglog(one.uncompensated.tau_s, UNIT.factor * one.uncompensated.allan, color=GREY, lw=1.2, label="before")
    panel.loglog(one.compensated.tau_s, UNIT.factor * one.compensated.allan, color=colour, lw=1.5, label="after")
    panel.grid(which="major", lw=0.3, alpha=0.6)
    panel.set_ylabel(f"Allan deviation, {UNIT.name}")
    panel.legend(loc="best", fontsize=7.5, frameon=False)
