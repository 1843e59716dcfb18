"""One recording from its file to all results that are wanted: ``analyze`` with the threads that pure rooms do without.

What is always made: curve, fit, motion and changes. Total and Hadamard deviations take four times as long as the Allan
curve and are made for who draws or writes them, dynamic curves where a window is given. Axes of the curve are done side
by side, and so are what does not need each other; kernels run without the GIL. Dynamic curves run in the caller's
thread, so that Ctrl-C ends them at once.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from drivers.errors import ConfigError, NotReady
from drivers.recordings import iter_blocks, load_samples
from drivers.sample import AXES, Ints, SampleBlock
from monitor.drift.thermal.temperature_share import WithoutTemperature, moved, without_temperature
from monitor.estimation.allan.batch import TauGrid
from monitor.estimation.allan.dynamic_allan import Dynamic, dynamic
from monitor.estimation.allan.hadamard import HadamardCurve, hadamard_curve
from monitor.estimation.allan.total import TotalCurve, total_curve
from monitor.estimation.analysis import Analysis, analyze, events_of
from monitor.estimation.regular_grid import with_temperature
from monitor.publishing.plots.allan_figure import besides
from monitor.publishing.plots.dynamic_figure import Mark
from monitor.publishing.terminal.thermal_text import notes_without

Tell = Callable[[str, float | None], None]
"""Told what is being done, and the share that is done where that is known."""


class TooShort(NotReady):
    """Too few samples for any answer."""

    def __init__(self, why: str, samples: int) -> None:
        super().__init__(why)
        self.samples = samples


@dataclass(frozen=True, slots=True)
class Request:
    """What is wanted of which recording."""

    recording: Path
    rate_hz: float | None = None
    tau: TauGrid = "octave"
    window_s: float | None = None  # of dynamic curves
    rest: bool = False  # strike out motion
    others: bool = False  # total and Hadamard deviations too
    last_s: float | None = None  # the end of the recording alone


@dataclass(frozen=True, slots=True)
class Results:
    """All that was made of it."""

    analysis: Analysis
    total: TotalCurve | None = None
    hadamard: HadamardCurve | None = None
    dynamic: Dynamic | None = None
    lacking: str = ""  # why there are no dynamic curves, where they were wanted
    warmth: WithoutTemperature | None = None  # what temperature explains, where it explains any axis


def make(request: Request, tell: Tell = lambda _what, _share: None) -> Results:
    """Read and analyse.

    Raises:
        RecordingError, ConfigError: no recording; a τ, rate or window that it does not allow; or not enough memory
        TooShort: too few samples for any answer
    """
    try:
        return _make(request, tell)
    except MemoryError as error:
        raise ConfigError(
            f"{request.recording}: the analysis needs more memory than is free; take the end alone with --last, or "
            "split the recording"
        ) from error


def _make(request: Request, tell: Tell) -> Results:
    tell("reading", None)
    found = load_samples(request.recording, request.rate_hz, request.last_s)
    blocks = list(iter_blocks(found))
    pool = ThreadPoolExecutor(os.cpu_count())
    try:
        tell("curve and fit", None)
        try:
            result = analyze(blocks, found.rate_hz, request.tau, found.notes, pool.map, request.rest)
        except NotReady as error:
            raise TooShort(str(error), len(found)) from error
        tell("motion and changes" + (", total and Hadamard deviations" if request.others else ""), None)
        events = pool.submit(events_of, result)
        others = pool.submit(_others, result, request.tau) if request.others else None
        warmth = pool.submit(_without_temperature, result, blocks, found.rate_hz)
        courses, lacking = _courses(result, request, tell)
        total, hadamard = others.result() if others else (None, None)
        found_all = events.result()
        without = warmth.result()
        said = [] if without is None else notes_without(without)
        found_all = replace(
            found_all,
            notes=(*found_all.notes, *said, *([lacking] if lacking else [])),
            axes_of_temperature=() if without is None else without.axes_of_temperature,
        )
        return Results(found_all, total, hadamard, courses, lacking, without)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def draw(results: Results, path: Path, title: str) -> None:
    """The picture, or the page if the name ends in .html.

    Raises:
        ConfigError: what draws is not installed, or the file cannot be written
    """
    result = results.analysis
    beside = besides(results.total, results.hadamard)
    marks = [Mark(change.since / result.estimate.rate_hz, AXES[change.axis]) for change in result.changes]
    if path.suffix == ".html":
        from monitor.publishing.reports.analysis_report import html_report

        html_report(result, path, title, beside, results.dynamic, marks)
    else:
        from monitor.publishing.plots.analysis_plot import allan_plot

        allan_plot(result.estimate, path, title, beside, results.dynamic, marks, result.axes_of_temperature)


def _without_temperature(
    result: Analysis, blocks: Sequence[SampleBlock], rate_hz: float | None
) -> WithoutTemperature | None:
    """Nothing is worked out where no temperature came, or where it stayed."""
    if not moved(np.concatenate([samples.temperature_c for samples in blocks])):
        return None
    _, temperature_c, _, _ = with_temperature(blocks, rate_hz)
    return without_temperature(result, temperature_c)


def _courses(result: Analysis, request: Request, tell: Tell) -> tuple[Dynamic | None, str]:
    """Dynamic curves if they are wanted, or why they cannot be made."""
    if request.window_s is None:
        return None, ""
    rate_hz = result.estimate.rate_hz
    try:
        shown = dynamic(
            result.values, rate_hz, request.window_s, request.tau, progress=lambda share: tell("dynamic curves", share)
        )
    except NotReady as error:
        return None, f"no dynamic curves: {error}"
    return shown, ""


def _others(result: Analysis, tau: TauGrid) -> tuple[TotalCurve, HadamardCurve | None]:
    """Total and Hadamard deviations: octaves, or the τ that were listed as far as they are possible."""
    values, rate_hz, theta = result.values, result.estimate.rate_hz, np.where(result.fit.entered, result.fit.theta, 0.0)
    listed = None if isinstance(tau, str) else result.estimate.curve.factors
    short: Ints | None = None if listed is None else listed[3 * listed <= len(values)]
    total = total_curve(values, rate_hz, theta, listed)
    if short is not None and not np.size(short):
        return total, None
    return total, hadamard_curve(values, rate_hz, theta, short)
