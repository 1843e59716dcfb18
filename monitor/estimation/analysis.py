"""A whole recording at once: the Allan curve, its intervals and the fitted coefficients; the live service's reference.

The recording is first put on a regular grid by the same clock that stamps live samples: what is missing becomes NaN in
its place, and everything found about the time stamps is said in ``notes``. ``analyze`` makes the curve and the fit;
``events_of`` asks of the same samples whether the sensor moved, whether its noise changed, and what of it is a line or
an outlier, which takes longer than the curve and is a step of its own. Moving stretches are struck out of the curve
only on demand, as a rest that was wrongly called motion would be lost; of what ``events_of`` asks they are always kept
out.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from drivers.errors import NotReady
from drivers.sample import Floats, Ints, SampleBlock
from monitor.estimation import analysis_notes
from monitor.estimation.allan.batch import EachAxis, TauGrid, cluster_sizes, overlapping, slope, slopes
from monitor.estimation.allan.curve import AllanCurve
from monitor.estimation.allan.uncertainty import intervals, table
from monitor.estimation.detection.change_detection import Change, ChangeDetector
from monitor.estimation.detection.line_detection import lines, outliers
from monitor.estimation.detection.motion_detection import Motion, find
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.bandwidth import LowPass, contradicted, power, sought, with_bandwidth
from monitor.estimation.fit.coefficient_fit import Fit, Looks, design, fit
from monitor.estimation.fit.fit_kernel import MIN_ROWS
from monitor.estimation.regular_grid import on_grid

FEWEST: Final = 50
"""Samples; below this nothing can be said, and the command exits with status 3."""
CHUNK: Final = 65_536
"""Rows given to the detector of changes at a time."""


@dataclass(frozen=True, slots=True)
class Analysis:
    """What ``imu-monitor analyze`` finds."""

    estimate: Estimate
    seconds: float
    notes: tuple[str, ...]
    values: Floats  # [n, 6] on the grid, SI; NaN = missing, or moving and struck out
    fit: Fit
    bandwidth_hz: Floats  # [6] the sensor's own, where the curve shows one; else NaN
    motions: tuple[Motion, ...] = ()
    changes: tuple[Change, ...] = ()
    struck: bool = False  # moving stretches are missing in ``values``
    axes_of_temperature: tuple[str, ...] = ()  # temperature explains most of their slow variance


def analyze(
    blocks: Sequence[SampleBlock],
    rate_hz: float | None,
    tau: TauGrid = "octave",
    notes: Iterable[str] = (),
    each: EachAxis = map,
    rest: bool = False,
) -> Analysis:
    """The analysis of a recording.

    Args:
        blocks: the recording, with its own times
        rate_hz: the stated rate; None = found from the times
        tau: grid or list of averaging times, s
        notes: what reading the file found
        each: maps the axes; of an executor, they are done side by side
        rest: strike out stretches in which the sensor moved
    Raises:
        NotReady: fewer than FEWEST samples, or fewer at rest
        ConfigError: no τ of the list is possible
    """
    values, rate, found = on_grid(blocks, rate_hz)
    if len(values) < FEWEST:
        raise NotReady(f"{len(values)} samples; at least {FEWEST} are needed to say anything")
    motions: tuple[Motion, ...] = ()
    if rest:
        values, motions = _at_rest(values, rate)
        found = [*found, *analysis_notes.of_motions(motions, rate, struck=True)]
    curve, fitted, filters = _fitted(values, rate, cluster_sizes(len(values), rate, tau), each)
    estimate = Estimate(
        int(blocks[-1].t_ns[-1]), rate, curve.n / rate, sum(len(samples) for samples in blocks),
        curve, fitted.fitted, fitted.coefficients, fitted.k_or_r,
    )  # fmt: skip
    bandwidth_hz = np.array([np.nan if one is None else one.cutoff * rate for one in filters])
    few = [f"{len(curve.tau_s)} averaging times are too few to fit five terms; at least {MIN_ROWS} are needed"]
    said = few if len(curve.tau_s) < MIN_ROWS else analysis_notes.of_fit(curve, fitted, filters, rate)
    return Analysis(
        estimate, estimate.window_s, (*notes, *found, *said), values, fitted, bandwidth_hz, motions, struck=rest
    )


def events_of(result: Analysis, alarms_per_day: float = 1.0 / 30.0) -> Analysis:
    """The same analysis with what happened in the recording: motion, changes, lines, outliers, told in its notes.

    Args:
        result: of ``analyze``
        alarms_per_day: false alarms of the detector of changes to bear, of all axes together
    """
    rate = result.estimate.rate_hz
    moving = np.zeros(len(result.values), np.bool_)
    motions, notes = result.motions, list(result.notes)
    if not result.struck:
        moving, listed = find(result.values, rate)
        motions = tuple(listed)
        notes += analysis_notes.of_motions(motions, rate, struck=False)
    detector = ChangeDetector(rate, alarms_per_day)
    for begin in range(0, len(result.values), CHUNK):
        rows, struck = result.values[begin : begin + CHUNK], moving[begin : begin + CHUNK]
        detector.update(np.where(struck[:, None], np.nan, rows) if struck.any() else rows)
    changes = tuple(sorted(detector.take(), key=lambda change: change.since))
    notes += analysis_notes.of_changes(changes, rate)
    found = lines(result.values, moving, rate, result.estimate.curve)
    moved = bool(motions) and not result.struck
    notes = analysis_notes.explained(notes, result.estimate.curve, result.fit, found, moved)
    notes += analysis_notes.of_departures(found, outliers(result.values, moving))
    return replace(result, notes=tuple(notes), motions=motions, changes=changes)


def refitted(result: Analysis, values: Floats, each: EachAxis = map) -> Fit:
    """The fit to the same averaging times of other samples [n, 6], such as what is left of those of an analysis."""
    _, found, _ = _fitted(values, result.estimate.rate_hz, result.estimate.curve.factors, each)
    return found


def _at_rest(values: Floats, rate_hz: float) -> tuple[Floats, tuple[Motion, ...]]:
    """The samples with moving stretches missing, and the stretches."""
    moving, motions = find(values, rate_hz)
    left = len(values) - int(moving.sum())
    if left < FEWEST:
        raise NotReady(f"{left} samples at rest; at least {FEWEST} are needed to say anything")
    return np.where(moving[:, None], np.nan, values) if moving.any() else values, tuple(motions)


def _fitted(
    values: Floats, rate_hz: float, factors: Ints, each: EachAxis
) -> tuple[AllanCurve, Fit, list[LowPass | None]]:
    """The curve with its intervals, the fit to it, and the sensor's own low-pass on axes that show one."""
    n = len(values)
    avar, terms = overlapping(values, factors, each)
    columns, covariances = design(factors, rate_hz), table(n, factors)
    looks = Looks(avar, terms, slope(values) * rate_hz, slopes(values, factors) * rate_hz)
    found = fit(columns, covariances, avar, terms, slope=looks.slope, slopes=looks.slopes)
    filters = [
        sought(columns, covariances, looks.axis(axis), power(values[:, axis])) if contradicted(found, axis) else None
        for axis in range(values.shape[1])
    ]
    found, filters = with_bandwidth(columns, covariances, looks, found, filters)
    lo, hi = intervals(avar, found.edf)
    return AllanCurve(factors / rate_hz, factors, avar, terms, found.edf, lo, hi, n), found, filters
