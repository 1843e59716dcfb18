"""Notes of an analysis for users, about the fit, motion, noise changes, spectral lines and outliers.

Each function returns a list of notes, which is empty if there is nothing to report. A list contains at most
``MAX_NOTES`` notes of one kind and a note with the number of omitted notes. Times are in seconds since the first
sample. The functions only format results and estimate nothing.
"""

from collections.abc import Collection, Mapping, Sequence
from itertools import groupby
from typing import Final

import numpy as np

from drivers.data_types import AXES, Floats
from monitor.common.units import format_axis_value, format_two_significant_digits
from monitor.estimation.allan.curve import AllanCurve
from monitor.estimation.detection.change_detection import Change
from monitor.estimation.detection.line_and_outlier_detection import OUTLIER_SIGMA, Line, line_share
from monitor.estimation.detection.motion_detection import Motion
from monitor.estimation.fit.coefficient_fit import Fit
from monitor.estimation.fit.coefficient_values import Status
from monitor.estimation.fit.least_squares import K, Q
from monitor.estimation.fit.low_pass_search import LowPass

Run = tuple[int, int]
"""Row numbers of the first and the last τ of a range."""

MAX_NOTES: Final = 10
DEPARTURE_SIGMA: Final = 3.0
"""Residual in standard deviations above which an averaging time departs from the fit."""
LINE_FREQUENCY_TOLERANCE: Final = 0.01
"""Relative difference of frequency below which lines on several axes are reported in one note."""
MIN_OUTLIER_SHARE: Final = 0.001
"""Smallest share of outliers that is reported."""
MIN_EXPLAINING_SHARE: Final = 0.05
"""Minimum share of the Allan variance that a line must contribute to explain a departure of the curve."""
MIN_Q_SHARE: Final = 0.2
"""Minimum share of the Allan variance of a line that can be mistaken for quantization noise."""
Q_ROWS: Final = 3
"""Number of shortest averaging times that determine Q."""
BANDWIDTH_OR_VIBRATION: Final = "the likely cause is the bandwidth of the sensor or a vibration"
BELOW_WHITE_NOISE: Final = (
    "the Allan variance at the shortest averaging times is below white noise, as after a low-pass filter; N is the "
    "level at longer averaging times, and Q is only bounded"
)
MOTION_LEFT_IN: Final = "motion of the sensor may be the cause; --rest removes the samples in motion"
UNKNOWN_CAUSE: Final = "vibration, motion or temperature may be the cause"
ORDINALS: Final = ("", "first", "second", "third", "fourth")
MIN_DEPARTURE_RATIO: Final = 0.5
"""Minimum departure of a reported averaging time, relative to the largest departure of the curve."""


def of_unexplained_curve(curve: AllanCurve, fit: Fit, filters: Sequence[LowPass | None], rate_hz: float) -> list[str]:
    """Describe where the five terms do not explain the curve. Axes with the same description are listed in one note.

    Parameters
    ----------
    curve : AllanCurve
        Measured curve.
    fit : Fit
        Fit to the curve.
    filters : sequence of LowPass or None
        Low-pass filter of each axis, or None.
    rate_hz : float
        Sample rate in Hz.
    """
    found = []
    for i, axis in enumerate(AXES):
        low_pass = filters[i]
        if low_pass is not None:
            found.append((axis, _bandwidth_note(low_pass, rate_hz)))
        elif fit.theta[Q, i] < 0.0 and not fit.left_out[i]:
            found.append((axis, BELOW_WHITE_NOISE))
        if fit.k_or_r[i]:
            found.append((axis, _k_or_r_note(fit.coefficients.status[K, i] == Status.ESTIMATED)))
    return _group_axes(found) + of_misfit(curve, fit)


def of_misfit(curve: AllanCurve, fit: Fit, found: Sequence[Line] = (), moved: bool = False) -> list[str]:
    """List the axes with a curve that the five terms cannot explain, grouped by cause.

    The cause is a spectral line or motion. Axes without a known cause are grouped if they depart at the same τ.

    Parameters
    ----------
    curve : AllanCurve
        Measured curve.
    fit : Fit
        Fit to the curve.
    found : sequence of Line
        Spectral lines that are reported.
    moved : bool
        True if the curve includes samples in motion.
    """
    names, notes = _line_names(found), list[str]()
    out = [i for i in range(len(AXES)) if fit.left_out[i]]
    for why, axes in _group_by_line(names, curve, {i: (0, int(fit.left_out[i]) - 1) for i in out}).items():
        notes.append(_left_out_note(curve.tau_s[fit.left_out - 1], axes, why or BANDWIDTH_OR_VIBRATION))
    runs = {i: _departure(curve, fit, i) for i in range(len(AXES)) if fit.misfit[i] > 1.0}
    if moved:
        return [*notes, _misfit_note(curve.tau_s, fit, runs, MOTION_LEFT_IN, at=False)] if runs else notes
    for why, axes in _group_by_line(names, curve, runs).items():
        for those in [axes] if why else _group_overlapping(axes):
            notes.append(_misfit_note(curve.tau_s, fit, those, why or UNKNOWN_CAUSE))
    return notes


def _quantization_notes(curve: AllanCurve, fit: Fit, found: Sequence[Line]) -> list[str]:
    """Warn if the estimate of Q may be caused by a spectral line."""
    causes = []
    for one, name in _line_names(found).items():
        estimated = fit.coefficients.status[Q, one.axis] == Status.ESTIMATED
        if estimated and float(np.nanmax(line_share(one, curve)[:Q_ROWS], initial=0.0)) >= MIN_Q_SHARE:
            causes.append((AXES[one.axis], f"quantization noise may be {name}"))
    return _group_axes(causes)


def replace_guessed_causes(
    notes: Sequence[str], curve: AllanCurve, fit: Fit, found: Sequence[Line], moved: bool = False
) -> list[str]:
    """Replace the guessed causes of misfits with the causes found by the search for lines and motion.

    Parameters
    ----------
    notes : sequence of str
        Notes of an analysis, including the result of ``of_unexplained_curve``.
    curve : AllanCurve
        Curve from which these notes were made.
    fit : Fit
        Fit from which these notes were made.
    found : sequence of Line
        Spectral lines that are reported.
    moved : bool
        True if the curve includes samples in motion.
    """
    known = of_misfit(curve, fit, found, moved)
    guessed = [note for note in of_misfit(curve, fit) if note not in known]
    kept = [note for note in notes if note not in guessed]
    return kept + [note for note in known if note not in kept] + _quantization_notes(curve, fit, found)


def of_motions(motions: Sequence[Motion], rate_hz: float, removed: bool) -> list[str]:
    """Report how often and how long the sensor moved, and whether the samples in motion were removed.

    Parameters
    ----------
    motions : sequence of Motion
        Episodes of motion.
    rate_hz : float
        Sample rate in Hz.
    removed : bool
        True if the samples in motion have been removed.
    """
    if not motions:
        return []
    times = "once" if len(motions) == 1 else f"{len(motions)} times"
    seconds = sum(motion.seconds for motion in motions)
    done = "removed" if removed else "not removed; --rest removes the samples in motion"
    notes = [f"the sensor moved {times}, {seconds:.3g} s in all: {done}"]
    notes += [f"at {motion.since / rate_hz:.1f} s: {motion.text}" for motion in motions[:MAX_NOTES]]
    return notes + _count_omitted(len(motions), "motions")


def of_changes(changes: Sequence[Change], rate_hz: float) -> list[str]:
    """Report changes of the noise and the bias.

    Parameters
    ----------
    changes : sequence of Change
        Changes in order of time.
    rate_hz : float
        Sample rate in Hz.
    """
    if not changes:
        return []
    notes = [
        f"at {change.since / rate_hz:.1f} s: {change.text} ({change.sigma:.1f} σ)" for change in changes[:MAX_NOTES]
    ]
    notes += _count_omitted(len(changes), "changes")
    if any(change.kind != "outlier_burst" for change in changes):
        notes.append(
            "the curve of the whole recording mixes the noise before and after; --window S shows the noise over time"
        )
    return notes


def of_lines_and_outliers(found: Sequence[Line], far: Floats) -> list[str]:
    """Report spectral lines and the share of outliers. Axes with a line at the same frequency share a note.

    Parameters
    ----------
    found : sequence of Line
        Spectral lines of all axes.
    far : ndarray of float64, shape (6,)
        Share of outliers of each axis, 0 to 1; NaN means unknown.
    """
    groups = _group_by_frequency(found)
    notes = []
    for here in groups[:MAX_NOTES]:
        sizes = [f"{AXES[one.axis]} {format_axis_value(AXES[one.axis], one.amplitude)}" for one in here]
        notes.append(f"{_line_name(here[0])}: {', '.join(sizes)}")
    left = [one for here in groups[MAX_NOTES:] for one in here]
    notes += _count_omitted(MAX_NOTES + len(left), "lines")
    shares = [f"{AXES[i]} {100.0 * far[i]:.2g} %" for i in np.flatnonzero(far > MIN_OUTLIER_SHARE).tolist()]
    if shares:
        notes.append(
            f"outliers beyond {OUTLIER_SIGMA:g} σ of the other samples: {', '.join(shares)} of all; "
            "the intervals assume Gaussian noise"
        )
    return notes


def _group_by_frequency(found: Sequence[Line]) -> list[list[Line]]:
    """Group lines of the same frequency. The group with the strongest line is first."""
    groups: list[list[Line]] = []
    left = sorted(found, key=lambda one: -one.share)
    while left:
        at_hz = left[0].frequency_hz
        groups.append([one for one in left if abs(one.frequency_hz / at_hz - 1.0) < LINE_FREQUENCY_TOLERANCE])
        left = [one for one in left if one not in groups[-1]]
    return groups


def _line_name(line: Line) -> str:
    """Return the name of a line or a resonance with its frequency."""
    return f"{'a resonance about' if line.wide else 'a line at'} {line.frequency_hz:.4g} Hz"


def _line_names(found: Sequence[Line]) -> dict[Line, str]:
    """Return the name of each reported line in the notes."""
    return {
        one: _line_name(here[0]).replace("a ", "the ", 1)
        for here in _group_by_frequency(found)[:MAX_NOTES]
        for one in here
    }


def _count_omitted(count: int, what: str) -> list[str]:
    """Return a note with the number of omitted notes, if there are any."""
    return [f"and {count - MAX_NOTES} more {what}"] if count > MAX_NOTES else []


def _departure(curve: AllanCurve, fit: Fit, axis: int) -> Run:
    """Return the range of τ in which the curve of one axis departs most from the fit.

    The range contains the largest ratio of curve and fit, among residuals above ``DEPARTURE_SIGMA``. The largest
    residual in σ would not be suitable. Noise outside the five terms pulls the fit upwards, so the largest residuals in
    σ are often elsewhere, where the curve is below the fit.
    """
    model, edf = fit.fitted[:, axis], fit.edf[:, axis]
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = curve.avar[:, axis] / model
        sigma = (np.cbrt(ratio) - 1.0) * np.sqrt(4.5 * edf)  # Wilson & Hilferty 1931
        off = np.where(np.abs(sigma) > DEPARTURE_SIGMA, np.log(ratio), 0.0)
    worst = int(off.argmax()) if (off > 0.0).any() else int(off.argmin())
    near = off * np.sign(off[worst]) >= MIN_DEPARTURE_RATIO * abs(off[worst])
    for belongs, run in groupby(range(off.size), key=near.__getitem__):
        rows = list(run)
        if belongs and rows[0] <= worst <= rows[-1]:
            return rows[0], rows[-1]
    return worst, worst


def _group_axes(found: Sequence[tuple[str, str]]) -> list[str]:
    """Return one note for all axes with the same text."""
    axes: dict[str, list[str]] = {}
    for axis, text in found:
        axes.setdefault(text, []).append(axis)
    return [f"{', '.join(those)}: {text}" for text, those in axes.items()]


def _group_by_line(names: Mapping[Line, str], curve: AllanCurve, runs: Mapping[int, Run]) -> dict[str, dict[int, Run]]:
    """Group axes by the spectral line that contributes most in the range of τ of the axis.

    The key is an empty string if no line contributes at least ``MIN_EXPLAINING_SHARE``.
    """
    found: dict[str, dict[int, Run]] = {}
    for i, (first, last) in runs.items():
        shares = {
            name: float(np.nanmax(line_share(one, curve)[first : last + 1], initial=0.0))
            for one, name in names.items()
            if one.axis == i
        }
        most = max(shares, key=shares.__getitem__, default="")
        why = f"the likely cause is {most}" if shares.get(most, 0.0) >= MIN_EXPLAINING_SHARE else ""
        found.setdefault(why, {})[i] = (first, last)
    return found


def _left_out_note(tau_s: Floats, axes: Collection[int], why: str) -> str:
    """Format a note about the shortest averaging times, which the fit leaves out.

    ``tau_s`` [6] is the longest excluded τ of each axis.
    """
    upto = ", ".join(dict.fromkeys(format_two_significant_digits(float(tau_s[i])) for i in axes))
    return (
        f"{', '.join(AXES[i] for i in axes)}: the fit leaves out τ up to {upto} s, which the five terms do not "
        f"explain: {why}"
    )


def _bandwidth_note(low_pass: LowPass, rate_hz: float) -> str:
    """Format the note on the low-pass filter of the sensor."""
    return (
        f"white noise ends below half the sample rate, as after a {ORDINALS[low_pass.order]}-order low-pass at about "
        f"{low_pass.cutoff * rate_hz:.2g} Hz; N is the level below this frequency"
    )


def _group_overlapping(runs: Mapping[int, Run]) -> list[dict[int, Run]]:
    """Group axes whose ranges of τ overlap."""
    groups: list[dict[int, Run]] = []
    for i, run in sorted(runs.items(), key=lambda item: item[1]):
        if groups and run[0] <= max(last for _, last in groups[-1].values()):
            groups[-1][i] = run
        else:
            groups.append({i: run})
    return groups


def _misfit_note(tau_s: Floats, fit: Fit, runs: Mapping[int, Run], why: str, at: bool = True) -> str:
    """Format the note on a misfit of several axes. If ``at`` is true, the note contains the range of τ."""
    low, high = (f"{f(fit.misfit[i] for i in runs) ** 0.5:.2g}" for f in (min, max))
    times = low if low == high else f"{low} to {high}"
    first, last = min(run[0] for run in runs.values()), max(run[1] for run in runs.values())
    since, upto = format_two_significant_digits(float(tau_s[first])), format_two_significant_digits(float(tau_s[last]))
    where = f"τ = {since} s" if first == last else f"τ from {since} to {upto} s"
    axes = ", ".join(AXES[i] for i in sorted(runs))
    return (
        f"{axes}: the five terms do not explain the curve (scatter {times} "
        f"times wider){f', most at {where}' if at else ''}: {why}; intervals are widened accordingly"
    )


def _k_or_r_note(no_slope: bool) -> str:
    """Format the note on a drift that is due to K or R.

    The cause is unknown because no slope was measured (``no_slope``) or because the recording is too short.
    """
    if no_slope:
        return "K or R: too many samples are missing to distinguish a ramp from rate random walk"
    return (
        "K or R: the recording drifts by more than Q, N and B explain, and is too short to distinguish a ramp from "
        "rate random walk"
    )
