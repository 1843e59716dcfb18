"""Command ``analyze``: reads a recording and computes Allan deviations, noise coefficients, motion and noise changes.

Total and Hadamard deviations take four times as long as Allan deviations, so they are computed only on request.
Independent axes and results are computed in parallel threads. The threads run in parallel because the numerical kernels
release the global interpreter lock of Python.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from drivers.data_types import AXES, Ints
from drivers.errors import ConfigError, NotReady
from drivers.recordings import Recording, iter_blocks
from drivers.validation.number_ranges import AVERAGING_TIME_S
from monitor.commands.progress_callback import ProgressCallback, ignore_progress
from monitor.common.unit_formatting import DEFAULT_UNITS, UnitSystem
from monitor.drift.thermal.temperature_removal import (
    TemperatureRemovalComparison,
    remove_temperature_effect,
)
from monitor.estimation.allan.batch import TauGrid
from monitor.estimation.allan.curve import VarianceCurve
from monitor.estimation.allan.dynamic_allan import DynamicAllan, compute_dynamic_allan
from monitor.estimation.allan.hadamard import compute_hadamard_curve
from monitor.estimation.allan.total import compute_total_curve
from monitor.estimation.analysis import RecordingAnalysis, analyze, detect_disturbances
from monitor.publishing.messages.analysis_json import AnalysisMessage
from monitor.publishing.plots.allan_figure import additional_deviations
from monitor.publishing.plots.dynamic_figure import ChangeMark
from monitor.publishing.terminal.thermal_output import notes_on_temperature_dependence

MAX_AVERAGING_TIMES: Final = 1000
"""Largest number of averaging times that a user may list."""


class TooFewSamples(NotReady):
    """Exception for a recording that has too few samples for any result.

    Parameters
    ----------
    why : str
        Text of the exception.
    samples : int
        Number of samples in the recording.
    """

    def __init__(self, why: str, samples: int) -> None:
        super().__init__(why)
        self.samples = samples


@dataclass(frozen=True, slots=True)
class AnalysisResults:
    """Results of an analysis."""

    analysis: RecordingAnalysis
    total: VarianceCurve | None = None
    hadamard: VarianceCurve | None = None
    dynamic: DynamicAllan | None = None
    lacking: str = ""  # reason why the dynamic Allan deviations are missing
    without_temperature: TemperatureRemovalComparison | None = (
        None  # coefficients without temperature effect; None if no axis has any
    )

    def to_message(self) -> AnalysisMessage:
        """Return the results as the message that ``analyze --json`` writes."""
        return AnalysisMessage.from_analysis(
            self.analysis, self.total, self.hadamard, self.dynamic, self.without_temperature
        )


def check_averaging_times(tau: TauGrid) -> None:
    """Check the averaging times that a user has listed.

    Parameters
    ----------
    tau : TauGrid
        Name of a grid, which is not checked, or averaging times in seconds.

    Raises
    ------
    ConfigError
        If there are too many averaging times, or if one is outside the supported range.
    """
    if isinstance(tau, str):
        return
    if len(tau) > MAX_AVERAGING_TIMES:
        raise ConfigError(f"{len(tau)} averaging times; at most {MAX_AVERAGING_TIMES} are possible")
    for tau_s in tau:
        AVERAGING_TIME_S.check(tau_s)


def analyze_recording(
    recording: Recording,
    tau: TauGrid = "octave",
    window_s: float | None = None,
    exclude_motion: bool = False,
    total_and_hadamard: bool = False,
    report_progress: ProgressCallback = ignore_progress,
) -> AnalysisResults:
    """Analyze a recording that has been read.

    Parameters
    ----------
    recording : Recording
        Samples to analyse.
    tau : TauGrid
        Name of a grid of averaging times, or averaging times in seconds.
    window_s : float, optional
        Length of the window [s] for dynamic Allan deviations, which are not computed without a length.
    exclude_motion : bool
        True to exclude samples during motion.
    total_and_hadamard : bool
        True to compute total and Hadamard deviations.
    report_progress : callable, optional
        Function that receives the progress.

    Raises
    ------
    ConfigError
        If the recording is too short for a requested averaging time or window.
    TooFewSamples
        If the recording has too few samples for any result.
    """
    pool = ThreadPoolExecutor(os.cpu_count())
    try:
        report_progress("curve and fit", None)
        try:
            result = analyze(
                list(iter_blocks(recording)), recording.rate_hz, tau, recording.notes, pool.map, exclude_motion
            )
        except NotReady as error:
            raise TooFewSamples(str(error), len(recording)) from error
        stage = "motion and changes" + (", total and Hadamard deviations" if total_and_hadamard else "")
        report_progress(stage, None)
        events = pool.submit(detect_disturbances, result)
        others = pool.submit(_total_and_hadamard, result, tau) if total_and_hadamard else None
        warmth = pool.submit(remove_temperature_effect, result)
        courses, lacking = _dynamic_curves(result, tau, window_s, report_progress)
        total, hadamard = others.result() if others else (None, None)
        found_all = events.result()
        without = warmth.result()
        said = [] if without is None else notes_on_temperature_dependence(without)
        found_all = replace(
            found_all,
            notes=(*found_all.notes, *said, *([lacking] if lacking else [])),
            axes_of_temperature=() if without is None else without.axes_explained_by_temperature,
        )
        return AnalysisResults(found_all, total, hadamard, courses, lacking, without)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def save_plot_or_report(results: AnalysisResults, path: Path, title: str, units: UnitSystem = DEFAULT_UNITS) -> None:
    """Save the results as a figure, or as an HTML page if the file name ends in ``.html``.

    Parameters
    ----------
    results : AnalysisResults
        Results of the analysis.
    path : Path
        File to write.
    title : str
        Title of the figure or page.
    units : UnitSystem
        Units of the figure or page.

    Raises
    ------
    ConfigError
        If the plotting library is not installed, or if the file cannot be written.
    """
    from monitor.publishing.plots.analysis_plot import AnalysisPlotData, save_analysis_plot

    result = results.analysis
    marks = [ChangeMark(change.since / result.estimate.rate_hz, AXES[change.axis]) for change in result.changes]
    others = additional_deviations(results.total, results.hadamard)
    drawn = AnalysisPlotData(result, others, results.dynamic, marks, units)
    if path.suffix == ".html":
        from monitor.publishing.reports.analysis_report import write_html_report

        write_html_report(drawn, path, title)
    else:
        save_analysis_plot(drawn, path, title)


def _dynamic_curves(
    result: RecordingAnalysis, tau: TauGrid, window_s: float | None, tell: ProgressCallback
) -> tuple[DynamicAllan | None, str]:
    if window_s is None:
        return None, ""
    rate_hz = result.estimate.rate_hz
    try:
        shown = compute_dynamic_allan(
            result.values, rate_hz, window_s, tau, progress=lambda share: tell("dynamic curves", share),
            pauses=result.pauses,
        )  # fmt: skip
    except NotReady as error:
        return None, f"no dynamic curves: {error}"
    return shown, ""


def _total_and_hadamard(result: RecordingAnalysis, tau: TauGrid) -> tuple[VarianceCurve, VarianceCurve | None]:
    """Return the total and Hadamard deviations at octave-spaced or requested averaging times."""
    values, rate_hz, theta = result.values, result.estimate.rate_hz, np.where(result.fit.entered, result.fit.theta, 0.0)
    listed = None if isinstance(tau, str) else result.estimate.curve.factors
    short: Ints | None = None if listed is None else listed[3 * listed <= len(values)]
    total = compute_total_curve(values, rate_hz, theta, listed, result.pauses)
    if short is not None and not np.size(short):
        return total, None
    return total, compute_hadamard_curve(values, rate_hz, theta, short, result.pauses)
