"""What an analysis found, in sentences for people: of the fit, of motion, of changes.

Each function returns notes, none where there is nothing to say; a recording full of events gets MOST of a kind and a
count. Times are seconds since the first sample. Numbers are looked up in results, nothing is estimated here.
"""

from collections.abc import Sequence
from itertools import groupby
from typing import Final

import numpy as np

from drivers.sample import AXES, Floats
from monitor.estimate.bandwidth import LowPass
from monitor.estimate.change import Change
from monitor.estimate.coefficients import Status
from monitor.estimate.curve import AllanCurve
from monitor.estimate.departures import FAR, Line
from monitor.estimate.fit import Fit
from monitor.estimate.least_squares import K
from monitor.estimate.rest import Motion
from monitor.estimate.words import amount

MOST: Final = 10
"""Notes of one kind."""
CLEAR: Final = 3.0
"""σ from which on an averaging time is said to depart."""
SAME: Final = 0.01
"""Of a frequency: lines that differ by less are one, on several axes."""
FAR_SHARE: Final = 0.001
"""A smaller share of outliers is not told."""
NEAR_WORST: Final = 0.5
"""Averaging times that depart by this share of the worst, and to the same side, are told with it."""


def of_fit(curve: AllanCurve, fit: Fit, filters: Sequence[LowPass | None], rate_hz: float) -> list[str]:
    """Where the five terms are not the whole story; axes of which the same is said share a note."""
    axes: dict[str, list[str]] = {}
    for i, axis in enumerate(AXES):
        if fit.left_out[i]:
            _add(axes, axis, _left_out(float(curve.tau_s[fit.left_out[i] - 1])))
        low_pass = filters[i]
        if low_pass is not None:
            _add(axes, axis, _bandwidth(low_pass, rate_hz))
        if fit.misfit[i] > 1.0:
            _add(axes, axis, _misfit(curve.tau_s, *_departure(curve, fit, i), float(fit.misfit[i])))
        if fit.k_or_r[i]:
            _add(axes, axis, _k_or_r(fit.coefficients.status[K, i] == Status.ESTIMATED))
    return [f"{', '.join(those)}: {text}" for text, those in axes.items()]


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
    notes: list[str] = []
    left = sorted(found, key=lambda one: -one.share)
    while left and len(notes) < MOST:
        at_hz, what = left[0].frequency_hz, "a resonance about" if left[0].wide else "a line at"
        here = [one for one in left if abs(one.frequency_hz / at_hz - 1.0) < SAME]
        left = [one for one in left if one not in here]
        sizes = [f"{AXES[one.axis]} {amount(AXES[one.axis], one.amplitude)}" for one in here]
        notes.append(f"{what} {at_hz:.4g} Hz: {', '.join(sizes)}")
    notes += _more(MOST + len(left), "lines")
    shares = [f"{AXES[i]} {100.0 * far[i]:.2g} %" for i in np.flatnonzero(far > FAR_SHARE).tolist()]
    if shares:
        notes.append(
            f"outliers beyond {FAR:g} σ of the other samples: {', '.join(shares)} of all; the noise is not Gaussian, "
            "and intervals assume that it is"
        )
    return notes


def _more(count: int, what: str) -> list[str]:
    return [f"and {count - MOST} more {what}"] if count > MOST else []


def _departure(curve: AllanCurve, fit: Fit, axis: int) -> tuple[int, int]:
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


def _left_out(tau_s: float) -> str:
    return (
        f"the fit leaves out τ up to {tau_s:.3g} s, which no sum of the five terms follows: the sensor's bandwidth or "
        "a vibration shows there"
    )


def _bandwidth(low_pass: LowPass, rate_hz: float) -> str:
    return (
        f"the sensor's own bandwidth shows in the shortest τ: as of a low-pass of order {low_pass.order} at "
        f"{low_pass.cutoff * rate_hz:.3g} Hz; N is the noise inside it"
    )


def _misfit(tau_s: Floats, first: int, last: int, misfit: float) -> str:
    where = f"τ = {tau_s[first]:.3g} s" if first == last else f"τ from {tau_s[first]:.3g} to {tau_s[last]:.3g} s"
    return (
        f"the curve departs from every sum of the five terms (scatter {misfit**0.5:.2g} times wider), most at {where}: "
        "a line, vibration, motion or temperature; intervals are widened accordingly"
    )


def _k_or_r(seen: bool) -> str:
    """A rise that may be either: ``seen`` where no slope was to be had, else where it drifts and is too short."""
    if seen:
        return "K or R: samples are missing, so that no slope tells a ramp from rate random walk"
    return (
        "K or R: the record drifts by more than Q, N and B make, and is too short to tell a ramp from rate random walk"
    )
