"""Textual notes for users on the results of an analysis.

The public functions return lists of notes. Times in notes are in seconds since the first sample.
"""

from collections.abc import Collection, Mapping, Sequence
from itertools import groupby
from typing import Final

import numpy as np

from drivers.data_types import AXES, Floats
from monitor.common.unit_formatting import format_axis_value, format_two_significant_digits
from monitor.estimation.allan.curve import AllanCurve
from monitor.estimation.detection.change_detection import Change
from monitor.estimation.detection.line_and_outlier_detection import (
    OUTLIER_SIGMA,
    SpectralLine,
    allan_variance_share_of_line,
)
from monitor.estimation.detection.motion_detection import MotionEpisode
from monitor.estimation.fit.coefficient_fit import Fit
from monitor.estimation.fit.coefficients_with_intervals import Status
from monitor.estimation.fit.least_squares import K, Q
from monitor.estimation.fit.low_pass_search import LowPass

Run = tuple[int, int]
"""Range of averaging times, given by the indices of the first and the last one."""

MAX_NOTES: Final = 10
DEPARTURE_SIGMA: Final = 3.0
"""Minimum residual, in standard deviations, at which an Allan variance contradicts the fit."""
LINE_FREQUENCY_TOLERANCE: Final = 0.01
"""Maximum relative frequency difference between spectral lines that are reported in the same note."""
MIN_OUTLIER_SHARE: Final = 0.001
"""Minimum share of outliers that is reported."""
MIN_EXPLAINING_SHARE: Final = 0.05
"""Minimum share of the Allan variance that a spectral line must contribute to explain a poor fit."""
MIN_Q_SHARE: Final = 0.2
"""Minimum share of the Allan variance that a spectral line must contribute to be mistaken for quantization noise."""
Q_ROWS: Final = 3
"""Number of shortest averaging times that mainly determine the quantization noise coefficient Q."""
BANDWIDTH_OR_VIBRATION: Final = "the likely cause is the bandwidth of the sensor or a vibration"
BELOW_WHITE_NOISE: Final = (
    "the Allan variance at the shortest averaging times is below white noise, as after a low-pass filter; N is the "
    "level at longer averaging times, and Q is only bounded"
)
MOTION_LEFT_IN: Final = "motion of the sensor may be the cause; --rest removes the samples in motion"
UNKNOWN_CAUSE: Final = "vibration, motion or temperature may be the cause"
ORDINALS: Final = ("", "first", "second", "third", "fourth")
MIN_DEPARTURE_RATIO: Final = 0.5
"""Minimum residual at which an averaging time is reported, relative to the largest residual of the axis."""


def describe_constant_axes(values: Floats) -> list[str]:
    """Describe the axes that always have the same value, such as those that a program has filled with zeros.

    Parameters
    ----------
    values : ndarray of float64, shape (n, 6)
        Samples in rad/s and m/s²; NaN means missing.
    """
    found = []
    for i, axis in enumerate(AXES):
        known = ~np.isnan(values[:, i])
        value = values[known.argmax(), i]
        if known.any() and np.array_equal(values[:, i] == value, known):
            found.append((axis, f"always {format_axis_value(axis, float(value))}, so no noise can be measured"))
    return _group_axes(found)


def describe_unexplained_curve(
    curve: AllanCurve, fit: Fit, low_passes: Sequence[LowPass | None], rate_hz: float
) -> list[str]:
    """Describe the axes whose Allan variance the five noise terms do not explain.

    Parameters
    ----------
    curve : AllanCurve
        Measured Allan curve.
    fit : Fit
        Fit to the Allan curve.
    low_passes : sequence of LowPass or None
        Low-pass filter of each axis, or None.
    rate_hz : float
        Sample rate in Hz.
    """
    found = []
    for i, axis in enumerate(AXES):
        low_pass = low_passes[i]
        if low_pass is not None:
            found.append((axis, _bandwidth_note(low_pass, rate_hz)))
        elif fit.theta[Q, i] < 0.0 and not fit.left_out[i]:
            found.append((axis, BELOW_WHITE_NOISE))
        if fit.k_or_r[i]:
            found.append((axis, _k_or_r_note(fit.coefficients.status[K, i] == Status.ESTIMATED)))
    return _group_axes(found) + describe_misfit(curve, fit)


def describe_misfit(
    curve: AllanCurve, fit: Fit, lines: Sequence[SpectralLine] = (), includes_motion: bool = False
) -> list[str]:
    """Describe the axes whose Allan variance differs from the fit, and group these axes by the likely cause.

    Parameters
    ----------
    curve : AllanCurve
        Measured Allan curve.
    fit : Fit
        Fit to the Allan curve.
    lines : sequence of SpectralLine
        Detected spectral lines.
    includes_motion : bool
        True if the Allan curve includes samples in motion.
    """
    names, notes = _line_names(lines), list[str]()
    out = [i for i in range(len(AXES)) if fit.left_out[i]]
    for why, axes in _group_by_line(names, curve, {i: (0, int(fit.left_out[i]) - 1) for i in out}).items():
        notes.append(_left_out_note(curve.tau_s[fit.left_out - 1], axes, why or BANDWIDTH_OR_VIBRATION))
    runs = {i: _departure(curve, fit, i) for i in range(len(AXES)) if fit.misfit[i] > 1.0}
    if includes_motion:
        return [*notes, _misfit_note(curve.tau_s, fit, runs, MOTION_LEFT_IN, at=False)] if runs else notes
    for why, axes in _group_by_line(names, curve, runs).items():
        for those in [axes] if why else _group_overlapping(axes):
            notes.append(_misfit_note(curve.tau_s, fit, those, why or UNKNOWN_CAUSE))
    return notes


def _quantization_notes(curve: AllanCurve, fit: Fit, found: Sequence[SpectralLine]) -> list[str]:
    causes = []
    for one, name in _line_names(found).items():
        estimated = fit.coefficients.status[Q, one.axis] == Status.ESTIMATED
        if (
            estimated
            and float(np.nanmax(allan_variance_share_of_line(one, curve)[:Q_ROWS], initial=0.0)) >= MIN_Q_SHARE
        ):
            causes.append((AXES[one.axis], f"quantization noise may be {name}"))
    return _group_axes(causes)


def replace_guessed_causes(
    notes: Sequence[str], curve: AllanCurve, fit: Fit, lines: Sequence[SpectralLine], includes_motion: bool = False
) -> list[str]:
    """Replace guessed causes of a poor fit by the spectral lines and the motion that were detected.

    Parameters
    ----------
    notes : sequence of str
        Notes of an analysis, including the result of ``describe_unexplained_curve``.
    curve : AllanCurve
        Measured Allan curve.
    fit : Fit
        Fit to the Allan curve.
    lines : sequence of SpectralLine
        Detected spectral lines.
    includes_motion : bool
        True if the Allan curve includes samples in motion.
    """
    known = describe_misfit(curve, fit, lines, includes_motion)
    guessed = [note for note in describe_misfit(curve, fit) if note not in known]
    kept = [note for note in notes if note not in guessed]
    return kept + [note for note in known if note not in kept] + _quantization_notes(curve, fit, lines)


def describe_motions(motions: Sequence[MotionEpisode], rate_hz: float, removed: bool) -> list[str]:
    """Describe the number and the total duration of motion episodes.

    Parameters
    ----------
    motions : sequence of MotionEpisode
        Detected episodes of motion.
    rate_hz : float
        Sample rate in Hz.
    removed : bool
        True if the samples in motion have been removed from the analysis.
    """
    if not motions:
        return []
    times = "once" if len(motions) == 1 else f"{len(motions)} times"
    seconds = sum(motion.seconds for motion in motions)
    done = "removed" if removed else "not removed; --rest removes the samples in motion"
    notes = [f"the sensor moved {times}, {seconds:.3g} s in all: {done}"]
    notes += [f"at {motion.since / rate_hz:.1f} s: {motion.text}" for motion in motions[:MAX_NOTES]]
    return notes + _count_omitted(len(motions), "motions")


def describe_changes(changes: Sequence[Change], rate_hz: float) -> list[str]:
    """Describe the detected changes of the noise and the bias.

    Parameters
    ----------
    changes : sequence of Change
        Changes in chronological order.
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
            "the curve of the whole recording mixes both noise levels; curves over time (--window S) separate them"
        )
    return notes


def describe_lines_and_outliers(lines: Sequence[SpectralLine], outlier_shares: Floats) -> list[str]:
    """Describe the spectral lines and the share of outliers on each axis.

    Parameters
    ----------
    lines : sequence of SpectralLine
        Spectral lines of all axes.
    outlier_shares : ndarray of float64, shape (6,)
        Share of outliers of each axis, from 0 to 1; NaN means unknown.
    """
    groups = _group_by_frequency(lines)
    notes = []
    for here in groups[:MAX_NOTES]:
        sizes = [f"{AXES[one.axis]} {format_axis_value(AXES[one.axis], one.amplitude)}" for one in here]
        notes.append(f"{_line_name(here[0])}: {', '.join(sizes)}")
    left = [one for here in groups[MAX_NOTES:] for one in here]
    notes += _count_omitted(MAX_NOTES + len(left), "lines")
    shares = [
        f"{AXES[i]} {100.0 * outlier_shares[i]:.2g} %"
        for i in np.flatnonzero(outlier_shares > MIN_OUTLIER_SHARE).tolist()
    ]
    if shares:
        notes.append(
            f"outliers beyond {OUTLIER_SIGMA:g} σ of the other samples: {', '.join(shares)} of all; "
            "the intervals assume Gaussian noise"
        )
    return notes


def _group_by_frequency(found: Sequence[SpectralLine]) -> list[list[SpectralLine]]:
    """Group spectral lines of similar frequency, starting with the strongest line."""
    groups: list[list[SpectralLine]] = []
    left = sorted(found, key=lambda one: -one.share)
    while left:
        at_hz = left[0].frequency_hz
        groups.append([one for one in left if abs(one.frequency_hz / at_hz - 1.0) < LINE_FREQUENCY_TOLERANCE])
        left = [one for one in left if one not in groups[-1]]
    return groups


def _line_name(line: SpectralLine) -> str:
    return f"{'a resonance about' if line.wide else 'a line at'} {line.frequency_hz:.4g} Hz"


def _line_names(found: Sequence[SpectralLine]) -> dict[SpectralLine, str]:
    return {
        one: _line_name(here[0]).replace("a ", "the ", 1)
        for here in _group_by_frequency(found)[:MAX_NOTES]
        for one in here
    }


def _count_omitted(count: int, what: str) -> list[str]:
    return [f"and {count - MAX_NOTES} more {what}"] if count > MAX_NOTES else []


def _departure(curve: AllanCurve, fit: Fit, axis: int) -> Run:
    """Return the range of averaging times at which the Allan variance and the fit differ by the largest factor.

    Only residuals above ``DEPARTURE_SIGMA`` standard deviations are considered. The largest residual in standard
    deviations would often be misleading. If noise outside the five terms raises the fitted curve, the Allan variance
    lies below this curve at other averaging times.
    """
    model, edf = fit.fitted[:, axis], fit.edf[:, axis]
    with np.errstate(invalid="ignore", divide="ignore"):
        excess = np.broadcast_to(curve.excess, curve.avar.shape)[:, axis]
        ratio = (curve.avar[:, axis] + excess) / (model + excess)
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
    axes: dict[str, list[str]] = {}
    for axis, text in found:
        axes.setdefault(text, []).append(axis)
    return [f"{', '.join(those)}: {text}" for text, those in axes.items()]


def _group_by_line(
    names: Mapping[SpectralLine, str], curve: AllanCurve, runs: Mapping[int, Run]
) -> dict[str, dict[int, Run]]:
    """Group axes by the spectral line that contributes most to the Allan variance in a range of averaging times.

    The key is empty for axes on which no line contributes a share of at least ``MIN_EXPLAINING_SHARE``.
    """
    found: dict[str, dict[int, Run]] = {}
    for i, (first, last) in runs.items():
        shares = {
            name: float(np.nanmax(allan_variance_share_of_line(one, curve)[first : last + 1], initial=0.0))
            for one, name in names.items()
            if one.axis == i
        }
        most = max(shares, key=shares.__getitem__, default="")
        why = f"the likely cause is {most}" if shares.get(most, 0.0) >= MIN_EXPLAINING_SHARE else ""
        found.setdefault(why, {})[i] = (first, last)
    return found


def _left_out_note(tau_s: Floats, axes: Collection[int], why: str) -> str:
    upto = ", ".join(dict.fromkeys(format_two_significant_digits(float(tau_s[i])) for i in axes))
    return (
        f"{', '.join(AXES[i] for i in axes)}: the fit leaves out τ up to {upto} s, which the five terms do not "
        f"explain: {why}"
    )


def _bandwidth_note(low_pass: LowPass, rate_hz: float) -> str:
    return (
        f"white noise ends below half the sample rate, as after a {ORDINALS[low_pass.order]}-order low-pass at about "
        f"{low_pass.cutoff * rate_hz:.2g} Hz; N is the level below this frequency"
    )


def _group_overlapping(runs: Mapping[int, Run]) -> list[dict[int, Run]]:
    groups: list[dict[int, Run]] = []
    for i, run in sorted(runs.items(), key=lambda item: item[1]):
        if groups and run[0] <= max(last for _, last in groups[-1].values()):
            groups[-1][i] = run
        else:
            groups.append({i: run})
    return groups


def _misfit_note(tau_s: Floats, fit: Fit, runs: Mapping[int, Run], why: str, at: bool = True) -> str:
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
    if no_slope:
        return "K or R: too many samples are missing to distinguish a ramp from rate random walk"
    return (
        "K or R: the recording drifts by more than Q, N and B explain, and is too short to distinguish a ramp from "
        "rate random walk"
    )
