"""What an analysis found, in sentences for people: of the fit, of motion, of changes.

Each function returns notes, none where there is nothing to say; a recording full of events gets MOST of a kind and a
count. Times are seconds since the first sample. Numbers are looked up in results, nothing is estimated here.
"""

from collections.abc import Collection, Mapping, Sequence
from itertools import groupby
from typing import Final

import numpy as np

from drivers.sample import AXES, Floats
from monitor.common.rates import amount, plain
from monitor.estimation.allan.curve import AllanCurve
from monitor.estimation.detection.change_detection import Change
from monitor.estimation.detection.line_detection import FAR, Line, added
from monitor.estimation.detection.motion_detection import Motion
from monitor.estimation.fit.bandwidth import LowPass
from monitor.estimation.fit.coefficient_fit import Fit
from monitor.estimation.fit.coefficients import Status
from monitor.estimation.fit.least_squares import K, Q

Run = tuple[int, int]
"""First and last τ, by their places."""

MOST: Final = 10
"""Notes of one kind."""
CLEAR: Final = 3.0
"""σ from which on an averaging time is said to depart."""
SAME: Final = 0.01
"""Of a frequency: lines that differ by less are one, on several axes."""
FAR_SHARE: Final = 0.001
"""A smaller share of outliers is not told."""
MAKES: Final = 0.05
"""Of the Allan variance: a line that makes as much is why a curve departs there."""
IS_Q: Final = 0.2
"""The same, of one that Q may be."""
SHORTEST: Final = 3
"""Averaging times that tell Q."""
BAND: Final = "the sensor's bandwidth or a vibration shows there"
LOW: Final = (
    "the shortest averaging times lie below white noise, as behind a filter; N is the level of the longer ones, and Q "
    "no more than a bound"
)
MOVED: Final = "the sensor moved, which may be why; --rest strikes it out"
UNKNOWN: Final = "vibration, motion or temperature may be why"
ORDERS: Final = ("", "first", "second", "third", "fourth")
NEAR_WORST: Final = 0.5
"""Averaging times that depart by this share of the worst, and to the same side, are told with it."""


def of_fit(curve: AllanCurve, fit: Fit, filters: Sequence[LowPass | None], rate_hz: float) -> list[str]:
    """Where the five terms are not the whole story; axes of which the same is said share a note."""
    axes: dict[str, list[str]] = {}
    for i, axis in enumerate(AXES):
        low_pass = filters[i]
        if low_pass is not None:
            _add(axes, axis, _bandwidth(low_pass, rate_hz))
        elif fit.theta[Q, i] < 0.0 and not fit.left_out[i]:
            _add(axes, axis, LOW)
        if fit.k_or_r[i]:
            _add(axes, axis, _k_or_r(fit.coefficients.status[K, i] == Status.ESTIMATED))
    return [f"{', '.join(those)}: {text}" for text, those in axes.items()] + of_misfit(curve, fit)


def of_misfit(curve: AllanCurve, fit: Fit, found: Sequence[Line] = (), moved: bool = False) -> list[str]:
    """Which axes no sum of the five terms follows, those of one cause together: a line that is told, or motion.

    Of no known cause, they are apart where they depart at other τ.
    """
    names, notes = _names(found), list[str]()
    out = [i for i in range(len(AXES)) if fit.left_out[i]]
    for why, axes in _by_line(names, curve, {i: (0, int(fit.left_out[i]) - 1) for i in out}).items():
        notes.append(_left_out(curve.tau_s[fit.left_out - 1], axes, why or BAND))
    runs = {i: _departure(curve, fit, i) for i in range(len(AXES)) if fit.misfit[i] > 1.0}
    if moved:
        return [*notes, _misfit(curve.tau_s, fit, runs, MOVED, at=False)] if runs else notes
    for why, axes in _by_line(names, curve, runs).items():
        for those in [axes] if why else _alike(axes):
            notes.append(_misfit(curve.tau_s, fit, those, why or UNKNOWN))
    return notes


def of_quantization(curve: AllanCurve, fit: Fit, found: Sequence[Line]) -> list[str]:
    """Where Q may be a line: one that makes much of the shortest τ."""
    axes: dict[str, list[str]] = {}
    for one, name in _names(found).items():
        estimated = fit.coefficients.status[Q, one.axis] == Status.ESTIMATED
        if estimated and float(np.nanmax(added(one, curve)[:SHORTEST], initial=0.0)) >= IS_Q:
            _add(axes, AXES[one.axis], f"quantization noise may be {name}")
    return [f"{', '.join(those)}: {text}" for text, those in axes.items()]


def explained(
    notes: Sequence[str], curve: AllanCurve, fit: Fit, found: Sequence[Line], moved: bool = False
) -> list[str]:
    """The notes with what is known of misfits, once lines and motion have been looked for, in place of guesses.

    Args:
        notes: among them those of ``of_fit``
        curve, fit: what these were made of
        found: lines that are told
        moved: the sensor moved, and that was left in
    """
    known = of_misfit(curve, fit, found, moved)
    guessed = [note for note in of_misfit(curve, fit) if note not in known]
    kept = [note for note in notes if note not in guessed]
    return kept + [note for note in known if note not in kept] + of_quantization(curve, fit, found)


def of_motions(motions: Sequence[Motion], rate_hz: float, struck: bool) -> list[str]:
    """That the sensor moved, how often, and what was done about it."""
    if not motions:
        return []
    times = "once" if len(motions) == 1 else f"{len(motions)} times"
    seconds = sum(motion.seconds for motion in motions)
    done = "struck out" if struck else "left in; --rest strikes it out"
    notes = [f"the sensor moved {times}, {seconds:.3g} s in all: {done}"]
    notes += [f"at {motion.since / rate_hz:.1f} s: {motion.text}" for motion in motions[:MOST]]
    return notes + _more(len(motions), "motions")


def of_changes(changes: Sequence[Change], rate_hz: float) -> list[str]:
    """What changed, and what that means for a curve of all of it."""
    if not changes:
        return []
    notes = [f"at {change.since / rate_hz:.1f} s: {change.text} ({change.sigma:.1f} σ)" for change in changes[:MOST]]
    notes += _more(len(changes), "changes")
    if any(change.kind != "outlier_burst" for change in changes):
        notes.append("one curve of the whole recording mixes before and after; --window S shows them apart")
    return notes


def of_departures(found: Sequence[Line], far: Floats) -> list[str]:
    """Lines of the spectrum, those of several axes at one frequency together; and outliers, by axis [6] their share."""
    groups = _together(found)
    notes = []
    for here in groups[:MOST]:
        sizes = [f"{AXES[one.axis]} {amount(AXES[one.axis], one.amplitude)}" for one in here]
        notes.append(f"{_name(here[0])}: {', '.join(sizes)}")
    left = [one for here in groups[MOST:] for one in here]
    notes += _more(MOST + len(left), "lines")
    shares = [f"{AXES[i]} {100.0 * far[i]:.2g} %" for i in np.flatnonzero(far > FAR_SHARE).tolist()]
    if shares:
        notes.append(
            f"outliers beyond {FAR:g} σ of the other samples: {', '.join(shares)} of all; the noise is not Gaussian, "
            "and intervals assume that it is"
        )
    return notes


def _together(found: Sequence[Line]) -> list[list[Line]]:
    """Lines of one frequency, the strongest first."""
    groups: list[list[Line]] = []
    left = sorted(found, key=lambda one: -one.share)
    while left:
        at_hz = left[0].frequency_hz
        groups.append([one for one in left if abs(one.frequency_hz / at_hz - 1.0) < SAME])
        left = [one for one in left if one not in groups[-1]]
    return groups


def _name(line: Line) -> str:
    return f"{'a resonance about' if line.wide else 'a line at'} {line.frequency_hz:.4g} Hz"


def _names(found: Sequence[Line]) -> dict[Line, str]:
    """What each line is called where it is told."""
    return {one: _name(here[0]).replace("a ", "the ", 1) for here in _together(found)[:MOST] for one in here}


def _more(count: int, what: str) -> list[str]:
    return [f"and {count - MOST} more {what}"] if count > MOST else []


def _departure(curve: AllanCurve, fit: Fit, axis: int) -> Run:
    """First and last τ of the run in which the curve of one axis stands above the fit by the largest factor.

    What no term makes adds to the curve, but the fit is pulled towards it and leaves most σ elsewhere: below itself,
    and at the shortest τ, which are known best. Only what is more than chance counts.
    """
    model, edf = fit.fitted[:, axis], fit.edf[:, axis]
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = curve.avar[:, axis] / model
        sigma = (np.cbrt(ratio) - 1.0) * np.sqrt(4.5 * edf)  # Wilson & Hilferty 1931
        off = np.where(np.abs(sigma) > CLEAR, np.log(ratio), 0.0)
    worst = int(off.argmax()) if (off > 0.0).any() else int(off.argmin())
    near = off * np.sign(off[worst]) >= NEAR_WORST * abs(off[worst])
    for belongs, run in groupby(range(off.size), key=near.__getitem__):
        rows = list(run)
        if belongs and rows[0] <= worst <= rows[-1]:
            return rows[0], rows[-1]
    return worst, worst


def _add(axes: dict[str, list[str]], axis: str, text: str) -> None:
    axes.setdefault(text, []).append(axis)


def _by_line(names: Mapping[Line, str], curve: AllanCurve, runs: Mapping[int, Run]) -> dict[str, dict[int, Run]]:
    """Axes and their runs of τ by the line that makes most there; by "" where none makes enough to show."""
    found: dict[str, dict[int, Run]] = {}
    for i, (first, last) in runs.items():
        shares = {
            name: float(np.nanmax(added(one, curve)[first : last + 1], initial=0.0))
            for one, name in names.items()
            if one.axis == i
        }
        most = max(shares, key=shares.__getitem__, default="")
        why = f"{most} shows there" if shares.get(most, 0.0) >= MAKES else ""
        found.setdefault(why, {})[i] = (first, last)
    return found


def _left_out(tau_s: Floats, axes: Collection[int], why: str) -> str:
    """``tau_s`` [6]: the longest that is left out of each axis."""
    upto = ", ".join(dict.fromkeys(plain(float(tau_s[i])) for i in axes))
    return (
        f"{', '.join(AXES[i] for i in axes)}: the fit leaves out τ up to {upto} s, which no sum of the five terms "
        f"follows: {why}"
    )


def _bandwidth(low_pass: LowPass, rate_hz: float) -> str:
    return (
        f"white noise ends below half the sample rate, as behind a {ORDERS[low_pass.order]}-order low-pass at about "
        f"{low_pass.cutoff * rate_hz:.2g} Hz; N is the level below it"
    )


def _alike(runs: Mapping[int, Run]) -> list[dict[int, Run]]:
    """Axes whose runs of τ overlap."""
    groups: list[dict[int, Run]] = []
    for i, run in sorted(runs.items(), key=lambda item: item[1]):
        if groups and run[0] <= max(last for _, last in groups[-1].values()):
            groups[-1][i] = run
        else:
            groups.append({i: run})
    return groups


def _misfit(tau_s: Floats, fit: Fit, runs: Mapping[int, Run], why: str, at: bool = True) -> str:
    """Of the axes of ``runs``; ``at``: with the τ."""
    low, high = (f"{f(fit.misfit[i] for i in runs) ** 0.5:.2g}" for f in (min, max))
    times = low if low == high else f"{low} to {high}"
    first, last = min(run[0] for run in runs.values()), max(run[1] for run in runs.values())
    since, upto = plain(float(tau_s[first])), plain(float(tau_s[last]))
    where = f"τ = {since} s" if first == last else f"τ from {since} to {upto} s"
    axes = ", ".join(AXES[i] for i in sorted(runs))
    return (
        f"{axes}: the curve departs from every sum of the five terms (scatter {times} "
        f"times wider){f', most at {where}' if at else ''}: {why}; intervals are widened accordingly"
    )


def _k_or_r(seen: bool) -> str:
    """A rise that may be either: ``seen`` where no slope was to be had, else where it drifts and is too short."""
    if seen:
        return "K or R: samples are missing, so that no slope tells a ramp from rate random walk"
    return (
        "K or R: the record drifts by more than Q, N and B make, and is too short to tell a ramp from rate random walk"
    )
