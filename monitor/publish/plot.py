"""The Allan plot of one analysis as a picture, for ``imu-monitor analyze --plot FILE.png``.

In comes an ``Estimate``, out goes a file: gyroscopes and accelerometers side by side, log-log, in the field's
units, with the measured deviation and its 95 % intervals, the fitted curve and a table of the coefficients below.
matplotlib is imported when a plot is asked for, and draws without a screen. Axes differ by colour and by marker.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from drivers.errors import ConfigError
from drivers.sample import AXES
from monitor.estimate.coefficients import LETTERS
from monitor.estimate.estimate import Estimate
from monitor.publish.units import (
    COEFFICIENT_NAMES,
    COEFFICIENT_UNITS,
    DEVIATION_UNITS,
    KIND_NAMES,
    KINDS,
    Kind,
    axes_of,
    measured_axes,
    reading,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

INCHES: Final = (7.2, 7.0)  # of one panel with its table
DPI: Final = 150
MISSING: Final = 'matplotlib is not installed: pip install "imu-monitor[plot]"'
COLOURS: Final = ("#D55E00", "#009E73", "#0072B2")  # x y z: vermilion, bluish green, blue (Okabe & Ito)
MARKERS: Final = ("o", "s", "^")
GREY: Final = "#6b6b6b"


def allan_plot(estimate: Estimate, path: Path, title: str = "") -> None:
    """Write the picture; the ending of ``path`` says the format.

    ConfigError when matplotlib is missing or the folder cannot be written.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ConfigError(MISSING) from error
    present = measured_axes(estimate.curve.avar)
    kinds = [kind for kind in KINDS if set(axes_of(kind)) & set(present)] or list(KINDS)
    figure = Figure(figsize=(INCHES[0] * len(kinds), INCHES[1]), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, len(kinds), height_ratios=[3.4, 1.7])
    for column, kind in enumerate(kinds):
        _curves(figure.add_subplot(grid[0, column]), estimate, kind)
        _table(figure.add_subplot(grid[1, column]), estimate, kind)
    if title:
        figure.suptitle(title, fontsize=13, fontweight="bold")
    try:
        figure.savefig(path)
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot write the plot {path}: {error}") from error


def _curves(axes: "Axes", estimate: Estimate, kind: Kind) -> None:
    """One log-log panel."""
    unit = DEVIATION_UNITS[kind]
    tau_s = estimate.curve.tau_s
    for axis, colour, marker in zip(axes_of(kind), COLOURS, MARKERS, strict=True):
        i = AXES.index(axis)
        rows = np.isfinite(estimate.curve.avar[:, i]) & (estimate.curve.avar[:, i] > 0)
        if not rows.any():
            continue
        measured, fitted = (np.sqrt(a[:, i]) * unit.factor for a in (estimate.curve.avar, estimate.fitted))
        lo, hi = (a[rows, i] * unit.factor for a in (estimate.curve.lo, estimate.curve.hi))
        axes.fill_between(tau_s[rows], lo, hi, color=colour, alpha=0.18, linewidth=0)
        axes.plot(tau_s, fitted, "--", color=colour, linewidth=1.3)
        axes.plot(tau_s[rows], measured[rows], marker, color=colour, markersize=4.5, label=axis)
    axes.plot([], [], "--", color=GREY, linewidth=1.3, label="fit")
    axes.fill_between([], [], [], color=GREY, alpha=0.25, label="95 %")
    axes.set(xscale="log", yscale="log", xlabel="averaging time τ, s", ylabel=f"Allan deviation σ(τ), {unit.name}")
    axes.set_title(KIND_NAMES[kind], loc="left", fontsize=12)
    axes.grid(which="major", color="#d0d0d0", linewidth=0.8)
    axes.grid(which="minor", color="#ececec", linewidth=0.5)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    # above the box: curves and intervals may fill every corner of it
    axes.legend(
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        borderaxespad=0.2,
        frameon=False,
        ncols=5,
        handlelength=1.6,
        columnspacing=1.2,
    )


def _table(axes: "Axes", estimate: Estimate, kind: Kind) -> None:
    """The coefficients of one kind: value, and its interval in small print."""
    axes.axis("off")
    columns = (0.0, 0.46, 0.65, 0.84)
    rows = np.linspace(0.95, 0.06, len(LETTERS) + 1)
    for axis, x, colour in zip(axes_of(kind), columns[1:], COLOURS, strict=True):
        axes.text(x, rows[0], axis, color=colour, fontweight="bold", va="center")
    for letter, y in zip(LETTERS, rows[1:], strict=True):
        unit = COEFFICIENT_UNITS[kind][letter].name
        axes.text(columns[0], y, f"{letter}  {COEFFICIENT_NAMES[kind][letter]}, {unit}", va="center", fontsize=9.5)
        for axis, x in zip(axes_of(kind), columns[1:], strict=True):
            cell = reading(estimate.coefficients, letter, axis)
            axes.text(x, y + 0.02, cell.value, va="center", fontsize=9.5)
            axes.text(x, y - 0.055, cell.interval, va="center", fontsize=6.5, color=GREY)
    axes.set(xlim=(0, 1), ylim=(0, 1))
