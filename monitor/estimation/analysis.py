"""Analysis of a whole recording, which gives Allan deviations, noise coefficients and events.

The function ``analyze`` computes the Allan variance and fits the noise coefficients. The slower function
``detect_disturbances`` searches the recording for motion, noise changes, spectral lines and outliers.

By default, the Allan variance includes samples in motion, because the motion detector may mistake samples at rest for
motion. The search for events always ignores samples in motion.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from drivers.data_types import Floats, Ints, SampleBlock
from drivers.errors import NotReady
from monitor.common.loss_of_samples import LossOfSamples
from monitor.estimation import analysis_notes
from monitor.estimation.allan.batch import (
    NO_PAUSES,
    EachAxis,
    TauGrid,
    cluster_sizes,
    overlapping_allan_variances,
    rate_slope_from_thirds,
    rate_slope_per_tau,
)
from monitor.estimation.allan.curve import AllanCurve
from monitor.estimation.allan.uncertainty import covariance_table, deviation_intervals
from monitor.estimation.detection.change_detection import Change, NoiseAndBiasChangeDetector
from monitor.estimation.detection.line_and_outlier_detection import (
    detect_spectral_lines_per_axis,
    outlier_share_of_axes,
)
from monitor.estimation.detection.motion_detection import MotionEpisode, detect_motion
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficient_fit import Fit, MeasuredVariancesAndSlopes, fit_coefficients, make_design_matrix
from monitor.estimation.fit.fit_kernel import MIN_ROWS
from monitor.estimation.fit.interval_widening import FitWithInputs, loss_of_samples
from monitor.estimation.fit.low_pass_search import (
    LowPass,
    axes_contradicting_five_terms,
    find_low_pass,
    power_spectrum,
    refit_with_low_passes,
)
from monitor.estimation.regular_grid import place_samples_on_grid

MIN_SAMPLES: Final = 50
"""Minimum number of samples that a recording must contain."""
DETECTOR_CHUNK_ROWS: Final = 65_536
"""Number of samples that are passed to the change detector at a time."""


@dataclass(frozen=True, slots=True)
class RecordingAnalysis:
    """Allan deviations, noise coefficients and events of one recording."""

    estimate: Estimate
    seconds: float
    notes: tuple[str, ...]
    values: Floats  # [n, 6] samples on a regular time grid, SI units; NaN if missing, or removed because of motion
    fit: Fit
    bandwidth_hz: Floats  # [6] cutoff frequency of the sensor's low-pass filter; NaN if no filter has been found
    motions: tuple[MotionEpisode, ...] = ()
    changes: tuple[Change, ...] = ()
    motion_removed: bool = False  # True if ``values`` contains no samples in motion
    axes_of_temperature: tuple[str, ...] = ()  # axes on which temperature explains most of the bias variance
    pauses: Ints = field(default_factory=lambda: NO_PAUSES)  # rows of ``values`` that stand for a long gap
    temperature_c: Floats = field(default_factory=lambda: np.empty(0))  # [n] °C of each row; NaN if not measured


def analyze(
    blocks: Sequence[SampleBlock],
    rate_hz: float | None,
    tau: TauGrid = "octave",
    reading_notes: Iterable[str] = (),
    map_axes: EachAxis = map,
    remove_motion: bool = False,
) -> RecordingAnalysis:
    """Compute the Allan deviations of a recording, and fit the noise coefficients to them.

    Parameters
    ----------
    blocks : sequence of SampleBlock
        Recording with time stamps.
    rate_hz : float or None
        Sample rate in Hz that the user has stated. If None, the rate is estimated from the time stamps.
    tau : TauGrid
        Name of a grid of averaging times, or a tuple of times in seconds.
    reading_notes : iterable of str
        Notes from reading the file, which are placed before the notes of the analysis.
    map_axes : EachAxis
        Function that applies a computation to each axis. The method ``map`` of a thread pool processes the axes in
        parallel.
    remove_motion : bool
        True to remove samples in motion before the Allan variance is computed.

    Raises
    ------
    NotReady
        If the recording contains fewer than ``MIN_SAMPLES`` usable samples.
    ConfigError
        If every averaging time is shorter than one sample or longer than half the recording.
    """
    newest_ns, received = int(blocks[-1].t_ns[-1]), sum(len(samples) for samples in blocks)
    grid = place_samples_on_grid(blocks, rate_hz)
    del blocks  # the times of a day at 200 Hz take 280 MB
    values, rate, found = grid.values, grid.rate_hz, grid.notes
    if len(values) < MIN_SAMPLES:
        raise NotReady(f"{len(values)} samples; at least {MIN_SAMPLES} are needed for an analysis")
    motions: tuple[MotionEpisode, ...] = ()
    if remove_motion:
        values, motions = _without_motion(values, rate)
        found = [*found, *analysis_notes.describe_motions(motions, rate, removed=True)]
    curve, fitted, filters, loss = _fit_curve(
        values, rate, cluster_sizes(len(values), rate, tau), map_axes, grid.pauses
    )
    if loss.share > 0.0:
        found = [*found, loss.describe()]
    estimate = Estimate(
        newest_ns, rate, curve.n / rate, received,
        curve, fitted.fitted, fitted.coefficients, fitted.k_or_r, poorly_fitted_axes=fitted.poorly_fitted_axes,
    )  # fmt: skip
    bandwidth_hz = np.array([np.nan if one is None else one.cutoff * rate for one in filters])
    few = [f"{len(curve.tau_s)} averaging times are too few to fit five terms; at least {MIN_ROWS} are needed"]
    said = (
        few if len(curve.tau_s) < MIN_ROWS else analysis_notes.describe_unexplained_curve(curve, fitted, filters, rate)
    )
    return RecordingAnalysis(
        estimate,
        estimate.window_s,
        (*reading_notes, *found, *analysis_notes.describe_constant_axes(values), *said),
        values,
        fitted,
        bandwidth_hz,
        motions,
        motion_removed=remove_motion,
        pauses=grid.pauses,
        temperature_c=grid.temperature_c,
    )


def detect_disturbances(result: RecordingAnalysis, alarms_per_day: float = 1.0 / 30.0) -> RecordingAnalysis:
    """Search a recording for motion, noise changes, spectral lines and outliers.

    Parameters
    ----------
    result : RecordingAnalysis
        Analysis of the recording, to which the results are added in a copy.
    alarms_per_day : float
        Accepted number of false alarms of the change detector per day, for all axes together.
    """
    rate = result.estimate.rate_hz
    moving = np.zeros(len(result.values), np.bool_)
    motions, notes = result.motions, list(result.notes)
    if not result.motion_removed:
        moving, listed = detect_motion(result.values, rate)
        motions = tuple(listed)
        notes += analysis_notes.describe_motions(motions, rate, removed=False)
    detector = NoiseAndBiasChangeDetector(rate, alarms_per_day)
    for begin in range(0, len(result.values), DETECTOR_CHUNK_ROWS):
        rows, struck = result.values[begin : begin + DETECTOR_CHUNK_ROWS], moving[begin : begin + DETECTOR_CHUNK_ROWS]
        detector.process_samples(np.where(struck[:, None], np.nan, rows) if struck.any() else rows)
    changes = tuple(sorted(detector.take_changes(), key=lambda change: change.since))
    notes += analysis_notes.describe_changes(changes, rate)
    found = detect_spectral_lines_per_axis(result.values, moving, rate, result.estimate.curve)
    moved = bool(motions) and not result.motion_removed
    notes = analysis_notes.replace_guessed_causes(notes, result.estimate.curve, result.fit, found, moved)
    notes += analysis_notes.describe_lines_and_outliers(found, outlier_share_of_axes(result.values, moving))
    return replace(result, notes=tuple(notes), motions=motions, changes=changes)


def fit_other_samples(result: RecordingAnalysis, samples: Floats) -> Fit:
    """Fit noise coefficients to other samples with the sample rate and averaging times of an existing analysis.

    Parameters
    ----------
    result : RecordingAnalysis
        Analysis from which the sample rate and the averaging times are taken.
    samples : ndarray of float64, shape (n, k)
        Samples of k axes in rad/s and m/s², for example after temperature compensation; NaN means missing.
    """
    rate, factors = result.estimate.rate_hz, result.estimate.curve.factors
    _, found, _, _ = _fit_curve(samples, rate, factors, map, result.pauses)
    return found


def _without_motion(values: Floats, rate_hz: float) -> tuple[Floats, tuple[MotionEpisode, ...]]:
    moving, motions = detect_motion(values, rate_hz)
    left = len(values) - int(moving.sum())
    if left < MIN_SAMPLES:
        raise NotReady(f"{left} samples at rest; at least {MIN_SAMPLES} are needed for an analysis")
    return np.where(moving[:, None], np.nan, values) if moving.any() else values, tuple(motions)


def _fit_curve(
    values: Floats, rate_hz: float, factors: Ints, each: EachAxis, pauses: Ints
) -> tuple[AllanCurve, Fit, list[LowPass | None], LossOfSamples]:
    """Fit the noise coefficients, and compute by how much missing samples widen the intervals."""
    n = len(values)
    avar, terms, excess = overlapping_allan_variances(values, factors, each, pauses)
    columns, covariances = make_design_matrix(factors, rate_hz), covariance_table(n, factors)
    measured = MeasuredVariancesAndSlopes(
        avar, terms, rate_slope_from_thirds(values) * rate_hz, rate_slope_per_tau(values, factors) * rate_hz,
        excess=excess,
    )  # fmt: skip
    found = fit_coefficients(columns, covariances, measured)
    filters = [
        find_low_pass(columns, covariances, measured.select_axis(axis), power_spectrum(values[:, axis]))
        if contradicts
        else None
        for axis, contradicts in enumerate(axes_contradicting_five_terms(found))
    ]
    loss = loss_of_samples(np.isnan(values).mean(axis=0), [FitWithInputs(columns, covariances, measured, found)])
    found, filters = refit_with_low_passes(columns, covariances, measured, found, filters)
    lo, hi = deviation_intervals(avar, found.edf, excess=excess)
    curve = AllanCurve(factors / rate_hz, factors, np.maximum(avar, 0.0), terms, found.edf, lo, hi, n, excess)
    return curve, found, filters, loss
