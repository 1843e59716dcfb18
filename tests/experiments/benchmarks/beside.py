"""A data sheet beside its sensor: Allan curves of a recording and of the shipped model on one plot, and what differs.

    IMU_MONITOR_DATA=FOLDER python -m tests.experiments.benchmarks.beside [--out docs/pictures/simulated-adis16405.png]

The recording is read where it lies and not copied; the model is simulated for as long, at the recording's rate. Both go
the way of ``analyze``. Figures below the curves are taken apart from it: spectra by scipy's Welch, and correlation of
neighbouring samples after the mean of every ten seconds is taken off. A sine of frequency f stands out most at
τ = 0.371/f, where sin⁴(πfτ)/(πfτ)² is largest: there the plot names the lines of the recording.
"""

import argparse
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.signal import welch

from drivers.data_types import AXES, Floats
from monitor.commands import analyze, simulate
from monitor.common.unit_formatting import (
    COEFFICIENT_UNITS,
    DEGREE,
    DEVIATION_UNITS,
    KIND_NAMES,
    KINDS,
    Kind,
    axes_of,
    sensor_kind,
)
from monitor.estimation.analysis import RecordingAnalysis
from monitor.estimation.detection.line_and_outlier_detection import detect_spectral_lines_per_axis
from monitor.noise.model_loading import load_model
from monitor.publishing.coefficient_cells import format_coefficient
from monitor.publishing.plots.allan_figure import FIT_DASHES, MARKER_SIZES, MARKERS
from monitor.publishing.plots.style import (
    COLOURS,
    DARK,
    GREY,
    create_figure,
    draw_legend_above,
    figure_style,
    save_figure,
    style_log_axis,
)
from tests.experiments.benchmarks.machine import console, table
from tests.experiments.pictures import reduce_colours

if TYPE_CHECKING:
    from matplotlib.axes import Axes

RECORDING: Final = "adis16405/run1.npz"
MODEL: Final = "adis16405"
SEED: Final = 1
INCHES: Final = (14.4, 6.4)
MOST_AT: Final = 0.371  # of τf, for a sine
BEYOND: Final = 3.0  # an interval further than this factor beyond the points is cut
STAGGER: Final = 0.05  # of the plot's height: names of lines close to each other
SEGMENT: Final = 8192
"""Rows of a spectrum."""
MEAN_S: Final = 10.0
BANDS_HZ: Final = ((0.1, 0.4), (1.0, 5.0), (8.0, 12.0), (18.0, 23.0), (30.0, 35.0), (45.0, 49.5))
PEAKS_HZ: Final = ((0.53, 0.60), (1.6, 1.8), (6.0, 15.0), (15.0, 26.0))
"""The line, its third harmonic, the two resonances."""


@dataclass(frozen=True, slots=True)
class Side:
    """One of the two."""

    name: str
    result: RecordingAnalysis

    @property
    def rate_hz(self) -> float:
        """Samples a second."""
        return self.result.estimate.rate_hz


def sides(recording: Path, model: str, seed: int) -> tuple[Side, Side]:
    """The recording, and the model for as long."""
    recorded = analyze.run_analysis(analyze.AnalysisRequest(recording)).analysis
    estimate = recorded.estimate
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "simulated.npz"
        seconds = estimate.curve.n / estimate.rate_hz
        simulate.run_simulation(
            simulate.SimulationRequest(load_model(model, Path.cwd()), out, seconds, seed, estimate.rate_hz, name=model)
        )
        simulated = analyze.run_analysis(analyze.AnalysisRequest(out)).analysis
    return Side("recorded", recorded), Side("simulated", simulated)


# --- the plot


def draw(recorded: Side, simulated: Side, path: Path, title: str) -> None:
    """Gyroscopes left, accelerometers right; points recorded, lines simulated, 95 % shaded."""
    with figure_style():
        figure = create_figure(*INCHES)
        for kind, axes in zip(KINDS, figure.subplots(1, 2), strict=True):
            panel(axes, recorded, simulated, kind)
        figure.suptitle(title)
        save_figure(figure, path)


def panel(axes: "Axes", recorded: Side, simulated: Side, kind: Kind) -> None:
    """Both curves of three axes."""
    axes.set(xscale="log", yscale="log")
    shown = []
    for number, (axis, colour) in enumerate(zip(axes_of(kind), COLOURS, strict=True)):
        for side, style in (
            (recorded, {"linestyle": "", "marker": MARKERS[number], "mfc": "none", "mew": 1.1, "label": axis}),
            (simulated, {"linestyle": FIT_DASHES[number], "linewidth": 1.8}),
        ):
            tau_s, deviation, lo, hi = curve(side, axis)
            axes.fill_between(tau_s, lo, hi, color=colour, alpha=0.16, linewidth=0)
            axes.plot(tau_s, deviation, color=colour, markersize=MARKER_SIZES[number], **style)
            shown += [lo, hi]
    every = np.concatenate(shown)
    axes.set_ylim(every.min() / 1.3, every.max() * 1.3)
    name_lines(axes, recorded, kind)
    axes.plot([], [], "--", color=GREY, label="simulated")
    axes.fill_between([], [], [], color=GREY, alpha=0.25, label="95 %")
    axes.set(xlabel="averaging time τ, s", ylabel=f"Allan deviation σ(τ), {DEVIATION_UNITS[kind].name}")
    axes.set_title(KIND_NAMES[kind])
    for which in "xy":
        style_log_axis(axes, which)
    draw_legend_above(axes, 5)


def curve(side: Side, axis: str) -> tuple[Floats, Floats, Floats, Floats]:
    """τ in s; deviation and the ends of its interval in the field's unit."""
    known, i = side.result.estimate.curve, AXES.index(axis)
    factor = DEVIATION_UNITS[sensor_kind(axis)].factor
    rows = np.isfinite(known.avar[:, i]) & (known.avar[:, i] > 0)
    deviation, lo, hi = (factor * a[rows, i] for a in (np.sqrt(known.avar), known.lo, known.hi))
    return known.tau_s[rows], deviation, np.clip(lo, deviation / BEYOND, None), np.clip(hi, None, deviation * BEYOND)


def name_lines(axes: "Axes", side: Side, kind: Kind) -> None:
    """A mark where each line of the recording stands out most, one for those of several axes."""
    result = side.result
    found = detect_spectral_lines_per_axis(
        result.values, np.zeros(len(result.values), bool), side.rate_hz, result.estimate.curve
    )
    named: list[float] = []
    for line in sorted((one for one in found if AXES[one.axis] in axes_of(kind)), key=lambda one: -one.share):
        if all(abs(line.frequency_hz / other - 1.0) > 0.1 for other in named):
            named.append(line.frequency_hz)
    for number, frequency_hz in enumerate(sorted(named)):
        at_s = MOST_AT / frequency_hz
        axes.axvline(at_s, color=GREY, linestyle=":", linewidth=1.0, zorder=1)
        where, said = 0.99 - STAGGER * (number % 2), f" {frequency_hz:.3g} Hz"
        axes.text(at_s, where, said, transform=axes.get_xaxis_transform(), color=DARK, va="top")


# --- the figures


def densities(side: Side) -> tuple[Floats, Floats]:
    """Frequency [k] in Hz and two-sided spectrum [k, 6], unit²/Hz."""
    f_hz, density = welch(side.result.values, side.rate_hz, "blackmanharris", SEGMENT, axis=0)
    return f_hz, density / 2.0


def within(f_hz: Floats, density: Floats, low_hz: float, high_hz: float) -> Floats:
    """Mean [6] of a band."""
    return np.asarray(density[(f_hz >= low_hz) & (f_hz < high_hz)].mean(axis=0))


def above_its_sides(f_hz: Floats, density: Floats, low_hz: float, high_hz: float) -> Floats:
    """rms [6] of what a band has above the level beside it."""
    wide = (high_hz - low_hz) / 4.0
    beside = ((f_hz >= low_hz - wide) & (f_hz < low_hz)) | ((f_hz >= high_hz) & (f_hz < high_hz + wide))
    inside = (f_hz >= low_hz) & (f_hz < high_hz)
    more = (density[inside] - np.median(density[beside], axis=0)).sum(axis=0) * 2.0 * f_hz[1]
    return np.asarray(np.sqrt(np.clip(more, 0.0, None)))


def neighbours(side: Side) -> Floats:
    """Correlation [6] of samples that follow each other."""
    rows = round(MEAN_S * side.rate_hz)
    blocks = side.result.values[: len(side.result.values) // rows * rows].reshape(-1, rows, len(AXES))
    away = blocks - blocks.mean(axis=1, keepdims=True)
    together: Floats = (away[:, 1:] * away[:, :-1]).mean(axis=(0, 1)) / (away**2).mean(axis=(0, 1))
    return together


def figures(recorded: Side, simulated: Side) -> None:
    """Print what differs, six axes beside each other."""
    as_n = np.array([COEFFICIENT_UNITS[sensor_kind(axis)]["N"].factor for axis in AXES])
    as_rms = np.array([DEGREE if sensor_kind(axis) == "gyro" else 1e3 / 9.80665 for axis in AXES])
    shown = table("what differs", "", "", *AXES)
    for letter in "NBK":
        units = "; ".join(COEFFICIENT_UNITS[kind][letter].name for kind in KINDS)
        for side in (recorded, simulated):
            cells = (format_coefficient(side.result.estimate.coefficients, letter, axis).value for axis in AXES)
            shown.add_row(f"{letter}, {units}", side.name, *cells)
    for low_hz, high_hz in BANDS_HZ:
        for side in (recorded, simulated):
            level = np.sqrt(within(*densities(side), low_hz, high_hz)) * as_n
            shown.add_row(f"√S {low_hz:g}–{high_hz:g} Hz, as N", side.name, *(f"{x:.3g}" for x in level))
    for low_hz, high_hz in PEAKS_HZ:
        for side in (recorded, simulated):
            rms = above_its_sides(*densities(side), low_hz, high_hz) * as_rms
            said = f"rms of a peak {low_hz:g}–{high_hz:g} Hz, °/s; mg"
            shown.add_row(said, side.name, *(f"{x:.2g}" for x in rms))
    for side in (recorded, simulated):
        shown.add_row("correlation of neighbours", side.name, *(f"{x:.3f}" for x in neighbours(side)))
    for side in (recorded, simulated):
        levels = (len(np.unique(side.result.values[:, i].astype(np.float32))) for i in range(len(AXES)))
        shown.add_row("different values", side.name, *map(str, levels))
    console.print(shown)


def main() -> None:
    """Draw and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/pictures/simulated-adis16405.png"))
    out = parser.parse_args().out
    folder = os.environ.get("IMU_MONITOR_DATA")
    if folder is None:
        raise SystemExit("IMU_MONITOR_DATA is not set: it names the folder of the recordings")
    recorded, simulated = sides(Path(folder) / RECORDING, MODEL, SEED)
    hours = recorded.result.seconds / 3600.0
    title = (
        f"ADIS16405, {hours:.2f} h at {recorded.rate_hz:g} Hz: points recorded, dashes simulated from the data sheet"
    )
    draw(recorded, simulated, out, title)
    figures(recorded, simulated)
    print(f"{reduce_colours(out)} ({out.stat().st_size / 1e3:.0f} kB)")


if __name__ == "__main__":
    main()
