"""Plot of the drift over time, and of the Allan deviations before and after drift compensation.

In a long recording, the predicted drift is averaged over groups of intervals, so that the 95 % band remains visible.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from drivers.data_types import AXES, Floats
from monitor.common.distributions import Z95
from monitor.common.unit_formatting import DEFAULT_UNITS, Unit, UnitSystem, format_duration
from monitor.drift.compensation.compensation_score import AxisCompensation, DriftCompensationResult
from monitor.drift.compensation.sage_husa import USED
from monitor.publishing.plots import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ROW_INCHES: Final = (11.0, 2.6)
MAX_LINE_POINTS: Final = 400  # more points would hide the band and the measured means
MEANS_ALPHA: Final = 0.6


def save_compensation_plot(result: DriftCompensationResult, path: Path, units: UnitSystem = DEFAULT_UNITS) -> None:
    """Write the plot of a drift compensation to a file.

    Parameters
    ----------
    result
        Results of the drift compensation of a recording.
    path
        File to write. The suffix selects the format.
    units
        Units of the drift and of the Allan deviations.

    Raises
    ------
    ConfigError
        If matplotlib is not installed or the file cannot be written.
    """
    unit = units.deviation("gyro")
    with style.figure_style():
        figure = style.create_figure(ROW_INCHES[0], 0.7 + ROW_INCHES[1] * len(result.axes))
        panels = figure.subplots(len(result.axes), 2, squeeze=False, sharex="col", width_ratios=[1.7, 1.0])
        for (drift, allan), (axis, one) in zip(panels, result.axes.items(), strict=True):
            _draw_drift(drift, axis, result, unit)
            _draw_allan_deviation(allan, axis, one, unit)
        panels[-1, 0].set_xlabel("time, min")
        panels[-1, 1].set_xlabel("averaging time τ, s")
        figure.suptitle(f"{result.recording}: drift and noise of the gyroscopes, method {result.method}")
        style.save_figure(figure, path)


def _draw_drift(panel: "Axes", axis: str, result: DriftCompensationResult, unit: Unit) -> None:
    i, colour = AXES.index(axis), style.axis_colour(axis)
    minutes = np.array([one.end for one in result.intervals]) / result.rate_hz / 60.0
    used = np.array([one.outcome[i] for one in result.intervals]) == USED
    mean = np.where(used, [one.mean[i] for one in result.intervals], np.nan)
    centre = float(np.nanmedian(mean))
    mean = unit.factor * (mean - centre)
    expected = unit.factor * (np.array([one.expected[i] for one in result.intervals]) - centre)
    error = unit.factor * Z95 * np.array([one.known[i] for one in result.intervals])
    limit = 1.1 * np.nanmax(np.abs([mean, expected])) if used.any() else 1.0
    label = f"means of {format_duration(result.interval_s)} at rest"
    points = {"markersize": 2.5, "markeredgewidth": 0, "alpha": MEANS_ALPHA}
    panel.plot(minutes, mean, ".", color=style.GREY, label=label, rasterized=True, **points)  # type: ignore[arg-type]
    size = -(-minutes.size // MAX_LINE_POINTS)
    minutes, expected, error = (_average_groups(values, size) for values in (minutes, expected, error))
    style.draw_band(panel, minutes, expected - error, expected + error, colour, alpha=0.4, label="95 %", zorder=2)
    panel.plot(minutes, expected, color=colour, linewidth=1.0, label="predicted drift", zorder=3)
    panel.set_ylim(-limit, limit)
    panel.set_ylabel(f"{axis} minus its median, {unit.name}")
    style.draw_legend_above(panel, 3, fontsize=7.5, markerscale=3.0)


def _average_groups(values: Floats, size: int) -> Floats:
    """Return the means of successive groups of ``size`` values. An incomplete last group is omitted."""
    return np.asarray(values[: values.size // size * size].reshape(-1, size).mean(axis=1))


def _draw_allan_deviation(panel: "Axes", axis: str, one: AxisCompensation, unit: Unit) -> None:
    for curve, colour, label in (
        (one.uncompensated, style.GREY, "before compensation"),
        (one.compensated, style.axis_colour(axis), "after"),
    ):
        panel.loglog(curve.tau_s, unit.factor * curve.allan, color=colour, label=label)
    for which in "xy":
        style.style_log_axis(panel, which)
    panel.set_ylabel(f"Allan deviation, {unit.name}")
    style.draw_legend_above(panel, 2, fontsize=7.5)
