"""Plot the Allan deviations of a recording and of the shipped model of its sensor, and print their differences.

    IMU_MONITOR_DATA=FOLDER python -m tests.experiments.benchmarks.compare_recording_with_model [--out FILE.png]

The model comes from the data sheet. It is simulated with the duration and rate of the recording, and both are analysed
by ``analyze``. The printed numbers are computed separately: spectra with Welch's method in SciPy, and the correlation
of successive samples after subtraction of the means of ten seconds. A sine of frequency f is most visible at
τ = 0.371/f, where sin⁴(πfτ)/(πfτ)² is largest. The plot labels the lines of the recording there.
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
from monitor.commands.recording_loading import load_recording
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
from tests.experiments.benchmarks.machine import console, create_table
from tests.experiments.pictures import reduce_colours

if TYPE_CHECKING:
    from matplotlib.axes import Axes

RECORDING: Final = "adis16405/run1.npz"
MODEL: Final = "adis16405"
SEED: Final = 1
INCHES: Final = (14.4, 6.4)
MOST_VISIBLE_TAU_F: Final = 0.371  # τf at which a sine is most visible
MAX_INTERVAL_RATIO: Final = 3.0  # intervals are clipped at this factor from the points
LABEL_OFFSET: Final = 0.05  # offset of labels as a share of the height
SEGMENT: Final = 8192
"""Number of samples in each segment of a spectrum."""
MEAN_S: Final = 10.0
BANDS_HZ: Final = ((0.1, 0.4), (1.0, 5.0), (8.0, 12.0), (18.0, 23.0), (30.0, 35.0), (45.0, 49.5))
PEAKS_HZ: Final = ((0.53, 0.60), (1.6, 1.8), (6.0, 15.0), (15.0, 26.0))
"""Bands of a line, of its third harmonic, and of two resonances."""


@dataclass(frozen=True, slots=True)
class AnalysedSeries:
    """Analysis of the recording or of the simulation."""

    name: str
    result: RecordingAnalysis

    @property
    def rate_hz(self) -> float:
        """Sample rate in Hz."""
        return self.result.estimate.rate_hz


def analyse_both(recording: Path, model: str, seed: int) -> tuple[AnalysedSeries, AnalysedSeries]:
    """Analyse the recording and a simulation with the same duration."""
    recorded = analyze.analyze_recording(load_recording(recording)).analysis
    estimate = recorded.estimate
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "simulated.npz"
        seconds = estimate.curve.n / estimate.rate_hz
        simulate.run_simulation(
            simulate.SimulationRequest(load_model(model, Path.cwd()), out, seconds, seed, estimate.rate_hz, name=model)
        )
        simulated = analyze.analyze_recording(load_recording(out)).analysis
    return AnalysedSeries("recorded", recorded), AnalysedSeries("simulated", simulated)


# --- the plot


def draw_plot(recorded: AnalysedSeries, simulated: AnalysedSeries, path: Path, title: str) -> None:
    """Draw gyroscopes and accelerometers: recording as points, simulation as lines, 95 % intervals shaded."""
    with figure_style():
        figure = create_figure(*INCHES)
        for kind, axes in zip(KINDS, figure.subplots(1, 2), strict=True):
            draw_panel(axes, recorded, simulated, kind)
        figure.suptitle(title)
        save_figure(figure, path)


def draw_panel(axes: "Axes", recorded: AnalysedSeries, simulated: AnalysedSeries, kind: Kind) -> None:
    """Draw the curves of three axes."""
    axes.set(xscale="log", yscale="log")
    bounds = []
    for number, (axis, colour) in enumerate(zip(axes_of(kind), COLOURS, strict=True)):
        for side, style in (
            (recorded, {"linestyle": "", "marker": MARKERS[number], "mfc": "none", "mew": 1.1, "label": axis}),
            (simulated, {"linestyle": FIT_DASHES[number], "linewidth": 1.8}),
        ):
            tau_s, deviation, lo, hi = get_curve(side, axis)
            axes.fill_between(tau_s, lo, hi, color=colour, alpha=0.16, linewidth=0)
            axes.plot(tau_s, deviation, color=colour, markersize=MARKER_SIZES[number], **style)
            bounds += [lo, hi]
    limits = np.concatenate(bounds)
    axes.set_ylim(limits.min() / 1.3, limits.max() * 1.3)
    label_lines(axes, recorded, kind)
    axes.plot([], [], "--", color=GREY, label="simulated")
    axes.fill_between([], [], [], color=GREY, alpha=0.25, label="95 %")
    axes.set(xlabel="averaging time τ, s", ylabel=f"Allan deviation σ(τ), {DEVIATION_UNITS[kind].name}")
    axes.set_title(KIND_NAMES[kind])
    for which in "xy":
        style_log_axis(axes, which)
    draw_legend_above(axes, 5)


def get_curve(side: AnalysedSeries, axis: str) -> tuple[Floats, Floats, Floats, Floats]:
    """Return τ in s, the deviation and the ends of its interval in display units."""
    known, i = side.result.estimate.curve, AXES.index(axis)
    factor = DEVIATION_UNITS[sensor_kind(axis)].factor
    rows = np.isfinite(known.avar[:, i]) & (known.avar[:, i] > 0)
    deviation, lo, hi = (factor * a[rows, i] for a in (np.sqrt(known.avar), known.lo, known.hi))
    return (
        known.tau_s[rows],
        deviation,
        np.clip(lo, deviation / MAX_INTERVAL_RATIO, None),
        np.clip(hi, None, deviation * MAX_INTERVAL_RATIO),
    )


def label_lines(axes: "Axes", side: AnalysedSeries, kind: Kind) -> None:
    """Mark each line of the recording at its most visible τ, and lines of several axes only once."""
    result = side.result
    found = detect_spectral_lines_per_axis(
        result.values, np.zeros(len(result.values), bool), side.rate_hz, result.estimate.curve
    )
    named: list[float] = []
    for line in sorted((line for line in found if AXES[line.axis] in axes_of(kind)), key=lambda line: -line.share):
        if all(abs(line.frequency_hz / other - 1.0) > 0.1 for other in named):
            named.append(line.frequency_hz)
    for number, frequency_hz in enumerate(sorted(named)):
        at_s = MOST_VISIBLE_TAU_F / frequency_hz
        axes.axvline(at_s, color=GREY, linestyle=":", linewidth=1.0, zorder=1)
        y, label = 0.99 - LABEL_OFFSET * (number % 2), f" {frequency_hz:.3g} Hz"
        axes.text(at_s, y, label, transform=axes.get_xaxis_transform(), color=DARK, va="top")


# --- the figures


def compute_spectrum(side: AnalysedSeries) -> tuple[Floats, Floats]:
    """Return frequencies [k] in Hz and the two-sided spectrum [k, 6] in unit²/Hz."""
    f_hz, density = welch(side.result.values, side.rate_hz, "blackmanharris", SEGMENT, axis=0)
    return f_hz, density / 2.0


def mean_in_band(f_hz: Floats, density: Floats, low_hz: float, high_hz: float) -> Floats:
    """Return the mean [6] of the spectrum in a band."""
    return np.asarray(density[(f_hz >= low_hz) & (f_hz < high_hz)].mean(axis=0))


def rms_of_peak(f_hz: Floats, density: Floats, low_hz: float, high_hz: float) -> Floats:
    """Return the rms [6] in a band above the level in the adjacent bands."""
    wide = (high_hz - low_hz) / 4.0
    adjacent = ((f_hz >= low_hz - wide) & (f_hz < low_hz)) | ((f_hz >= high_hz) & (f_hz < high_hz + wide))
    inside = (f_hz >= low_hz) & (f_hz < high_hz)
    more = (density[inside] - np.median(density[adjacent], axis=0)).sum(axis=0) * 2.0 * f_hz[1]
    return np.asarray(np.sqrt(np.clip(more, 0.0, None)))


def correlation_of_successive_samples(side: AnalysedSeries) -> Floats:
    """Return the correlation [6] of successive samples."""
    rows = round(MEAN_S * side.rate_hz)
    blocks = side.result.values[: len(side.result.values) // rows * rows].reshape(-1, rows, len(AXES))
    away = blocks - blocks.mean(axis=1, keepdims=True)
    together: Floats = (away[:, 1:] * away[:, :-1]).mean(axis=(0, 1)) / (away**2).mean(axis=(0, 1))
    return together


def print_differences(recorded: AnalysedSeries, simulated: AnalysedSeries) -> None:
    """Print the differences of six axes."""
    as_n = np.array([COEFFICIENT_UNITS[sensor_kind(axis)]["N"].factor for axis in AXES])
    as_rms = np.array([DEGREE if sensor_kind(axis) == "gyro" else 1e3 / 9.80665 for axis in AXES])
    table = create_table("differences", "", "", *AXES)
    for letter in "NBK":
        units = "; ".join(COEFFICIENT_UNITS[kind][letter].name for kind in KINDS)
        for side in (recorded, simulated):
            cells = (format_coefficient(side.result.estimate.coefficients, letter, axis).value for axis in AXES)
            table.add_row(f"{letter}, {units}", side.name, *cells)
    for low_hz, high_hz in BANDS_HZ:
        for side in (recorded, simulated):
            level = np.sqrt(mean_in_band(*compute_spectrum(side), low_hz, high_hz)) * as_n
            table.add_row(f"√S {low_hz:g}–{high_hz:g} Hz, as N", side.name, *(f"{x:.3g}" for x in level))
    for low_hz, high_hz in PEAKS_HZ:
        for side in (recorded, simulated):
            rms = rms_of_peak(*compute_spectrum(side), low_hz, high_hz) * as_rms
            label = f"rms of a peak {low_hz:g}–{high_hz:g} Hz, °/s; mg"
            table.add_row(label, side.name, *(f"{x:.2g}" for x in rms))
    for side in (recorded, simulated):
        table.add_row(
            "correlation of successive samples",
            side.name,
            *(f"{x:.3f}" for x in correlation_of_successive_samples(side)),
        )
    for side in (recorded, simulated):
        levels = (len(np.unique(side.result.values[:, i].astype(np.float32))) for i in range(len(AXES)))
        table.add_row("different values", side.name, *map(str, levels))
    console.print(table)


def main() -> None:
    """Draw the plot and print the differences."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/pictures/simulated-adis16405.png"))
    out = parser.parse_args().out
    folder = os.environ.get("IMU_MONITOR_DATA")
    if folder is None:
        raise SystemExit("IMU_MONITOR_DATA is not set: it names the folder of the recordings")
    recorded, simulated = analyse_both(Path(folder) / RECORDING, MODEL, SEED)
    hours = recorded.result.seconds / 3600.0
    title = (
        f"ADIS16405, {hours:.2f} h at {recorded.rate_hz:g} Hz: points recorded, dashes simulated from the data sheet"
    )
    draw_plot(recorded, simulated, out, title)
    print_differences(recorded, simulated)
    print(f"{reduce_colours(out)} ({out.stat().st_size / 1e3:.0f} kB)")


if __name__ == "__main__":
    main()
