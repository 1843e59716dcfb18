"""Allan plot of the gyroscopes or the accelerometers, for the image of ``analyze --plot`` and for the HTML report.

The plot shows the measured Allan deviations with 95 % bands, and the fitted Allan deviations as dashed lines. A fit
that does not describe the curve is grey. Each estimated noise term has a thin line with a ring at the averaging time at
which its coefficient is read (IEEE Std 952). Markers, rings and dashes differ between axes, so that equal Allan
deviations of two axes remain visible.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import AXES, Floats
from monitor.common.unit_formatting import DEFAULT_UNITS, KIND_NAMES, Kind, UnitSystem, axes_of
from monitor.estimation.allan.curve import VarianceCurve
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Status
from monitor.noise.standard_terms import UNIT_SOURCES
from monitor.publishing.plots.style import COLOURS, DARK, GREY, LABEL_BOX, draw_band, draw_legend_above, style_log_axis

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MARKERS: Final = ("o", "s", "^")
MARKER_SIZES: Final = (5.0, 6.2, 7.4)  # points; a filled circle is visible inside an open square or triangle
RING_SIZES: Final = (13.0, 10.5, 8.0)  # points
FIT_DASHES: Final = ((0, (4, 8)), (4, (4, 8)), (8, (4, 8)))
READING_TAU_S: Final = {
    "Q": 3.0**0.5,
    "N": 1.0,
    "K": 3.0,
    "R": 2.0**0.5,
}  # averaging time at which the Allan deviation of the noise term equals the coefficient
LINE_TAU_S: Final = np.array([1e-6, 1e9])  # the line of a noise term ends outside every plot
TAU0_S: Final = 1e-9  # sample period that is too short to affect the line of a noise term
LEGEND_TEXT: Final = (
    "○ a coefficient, read on its own line: Q at √3 s, N at 1 s, K at 3 s, R at √2 s; 0.664 B where the curve is lowest"
)
OTHER_LINE_STYLES: Final = ("-", ":", "-.")
TERM_LINE_ALPHA: Final = 0.4
MAX_DEPTH_RATIO: Final = 300.0  # a ring is omitted if it is lower than the lowest point by more than this factor
MAX_BAND_RATIO: Final = 3.0  # the confidence bands extend the plot by at most this factor beyond the points
MARGIN_FACTOR: Final = 1.6
MIN_LETTER_DISTANCE: Final = 0.045  # smallest distance between two labels, as a share of the height of the plot


@dataclass(frozen=True, slots=True)
class AdditionalDeviation:
    """Total or Hadamard deviation that is drawn in addition to the Allan deviation."""

    name: str  # "total" or "Hadamard"
    tau_s: Floats  # [k]
    deviation: Floats  # [k, 6] SI unit of the axis
    lo: Floats  # [k, 6] ends of the 95 % interval; NaN if unknown
    hi: Floats
    only_beyond: bool = False  # True to draw only averaging times longer than those of the Allan deviation

    def drawn_points_mask(self, axis: int, longest_allan_tau_s: float) -> NDArray[np.bool_]:
        """Return a mask of the averaging times at which the plot shows a point for one axis, shape [k].

        Parameters
        ----------
        axis
            Column index of the axis.
        longest_allan_tau_s
            Longest averaging time of the Allan deviation of this axis [s].
        """
        positive = np.isfinite(self.deviation[:, axis]) & (self.deviation[:, axis] > 0)
        return np.asarray(positive & (self.tau_s > longest_allan_tau_s) if self.only_beyond else positive)


def additional_deviations(
    total: VarianceCurve | None = None, hadamard: VarianceCurve | None = None
) -> list[AdditionalDeviation]:
    """Return the total and Hadamard deviations that are drawn in addition to the Allan deviation.

    The total deviation is drawn only beyond the longest averaging time of the Allan deviation.

    Parameters
    ----------
    total
        Total variance, or None to draw no total deviation.
    hadamard
        Hadamard variance, or None to draw no Hadamard deviation.
    """
    found = []
    if total is not None:
        found.append(
            AdditionalDeviation("total", total.tau_s, np.sqrt(total.variance), total.lo, total.hi, only_beyond=True)
        )
    if hadamard is not None:
        found.append(
            AdditionalDeviation("Hadamard", hadamard.tau_s, np.sqrt(hadamard.variance), hadamard.lo, hadamard.hi)
        )
    return found


@dataclass(frozen=True, slots=True)
class CoefficientRing:
    """Ring at the averaging time at which a coefficient is read from the Allan plot."""

    letter: str
    tau_s: float
    sigma: float  # Allan deviation at the ring, in the unit of the plot
    number: int  # 0, 1 or 2 for the axis x, y or z
    line: Floats  # Allan deviation of the noise term at the two values of LINE_TAU_S


def draw_allan_panel(
    panel: "Axes",
    estimate: Estimate,
    kind: Kind,
    others: Sequence[AdditionalDeviation] = (),
    units: UnitSystem = DEFAULT_UNITS,
) -> None:
    """Draw the Allan plot of the gyroscopes or the accelerometers.

    Parameters
    ----------
    panel
        Axes object of matplotlib.
    estimate
        Estimate from the whole recording.
    kind
        Kind of sensor: gyro or accel.
    others
        Total and Hadamard deviations of the same recording.
    units
        Units of the plot.
    """
    factor = units.deviation(kind).factor
    tau_s, minimum_tau_s = estimate.curve.tau_s, tau_of_minimum_s(estimate, kind)
    shown: list[Floats] = []
    rings: list[CoefficientRing] = []
    drawn: set[str] = set()
    for number, axis in enumerate(axes_of(kind)):
        i = AXES.index(axis)
        valid = np.isfinite(estimate.curve.avar[:, i]) & (estimate.curve.avar[:, i] > 0)
        if not valid.any():
            continue
        fitted, measured = (np.sqrt(a[:, i]) * factor for a in (estimate.fitted, estimate.curve.avar))
        lo, hi = (a[valid, i] * factor for a in (estimate.curve.lo, estimate.curve.hi))
        measured, longest_allan_tau_s = measured[valid], float(tau_s[valid][-1])
        draw_band(panel, tau_s[valid], lo, hi, COLOURS[number])
        fit_colour = GREY if axis in estimate.poorly_fitted_axes else COLOURS[number]
        panel.plot(tau_s, fitted, linestyle=FIT_DASHES[number], color=fit_colour, zorder=3)
        style = {"color": COLOURS[number], "markersize": MARKER_SIZES[number], "mew": 1.1}
        style["mfc"] = COLOURS[number] if number == 0 else "none"
        panel.plot(tau_s[valid], measured, MARKERS[number], label=axis, zorder=4, **style)  # type: ignore[arg-type]
        near_lo, near_hi = np.maximum(lo, measured / MAX_BAND_RATIO), np.minimum(hi, measured * MAX_BAND_RATIO)
        shown += [measured, fitted, near_lo, near_hi]
        for style_name, other in zip(OTHER_LINE_STYLES, others, strict=False):
            points = other.drawn_points_mask(i, longest_allan_tau_s)
            if points.any():
                shown.append(_draw_other(panel, other, points, number, i, factor, longest_allan_tau_s, style_name))
                drawn.add(other.name)
        rings += coefficient_rings(estimate, i, factor, minimum_tau_s, float(measured.min()))
    _set_limits(panel, shown, rings)
    _draw_terms(panel, rings)
    poor = [axis for axis in axes_of(kind) if axis in estimate.poorly_fitted_axes]
    if poor:
        text = f"{', '.join(poor)}: fit (grey) does not describe the curve"
        panel.text(0.5, 0.98, text, transform=panel.transAxes, ha="center", va="top", color=GREY, bbox=LABEL_BOX)
    _draw_labels(panel, kind, others, drawn, units)


def _draw_other(
    panel: "Axes", other: AdditionalDeviation, points: NDArray[np.bool_], number: int, i: int, factor: float,
    longest_allan_tau_s: float, line_style: str,
) -> Floats:  # fmt: skip
    """Draw the total or Hadamard deviation of one axis, and return the drawn values."""
    # Start the line at the last point of the Allan deviation, because the total deviation continues from this point.
    line = points | (other.tau_s == longest_allan_tau_s) if other.only_beyond else points
    y, colour = other.deviation[:, i] * factor, COLOURS[number]
    panel.plot(other.tau_s[line], y[line], line_style, color=colour, linewidth=0.9, alpha=0.8, zorder=2)
    if other.only_beyond:  # at shorter τ, the markers would hide the Allan deviation
        ends = np.abs([y - other.lo[:, i] * factor, other.hi[:, i] * factor - y])[:, points]
        style = {"mfc": "white", "color": colour, "mew": 0.9, "markersize": 4.5, "elinewidth": 0.7}
        panel.errorbar(other.tau_s[points], y[points], ends, fmt=MARKERS[number], zorder=4, **style)  # type: ignore[arg-type]
    return np.asarray(y[line])


def tau_of_minimum_s(estimate: Estimate, kind: Kind) -> float:
    """Return the averaging time [s] with the lowest mean Allan deviation, at which B is read."""
    avar = estimate.curve.avar[:, [AXES.index(axis) for axis in axes_of(kind)]]
    good = np.isfinite(avar) & (avar > 0)
    common = (good | ~good.any(axis=0)).all(axis=1) & good.any(axis=1)
    if not common.any():
        return 1.0
    level = np.log(avar[common][:, good.any(axis=0)]).mean(axis=1)
    return float(estimate.curve.tau_s[common][np.argmin(level)])


def coefficient_rings(
    estimate: Estimate, i: int, factor: float, minimum_tau_s: float, lowest: float
) -> list[CoefficientRing]:
    """Return the rings of all estimated coefficients of one axis.

    Parameters
    ----------
    estimate
        Estimate with the coefficients.
    i
        Column index of the axis.
    factor
        Factor from the SI unit of the axis to the unit of the plot.
    minimum_tau_s
        Averaging time [s] at which B is read.
    lowest
        Smallest Allan deviation of the axis, in the unit of the plot.
    """
    known, rings = estimate.coefficients, []
    for row, (letter, source) in enumerate(zip(SYMBOLS, UNIT_SOURCES, strict=True)):
        if known.status[row, i] != Status.ESTIMATED:
            continue
        tau_s = READING_TAU_S.get(letter, minimum_tau_s)
        line = known.value[row, i] * factor * np.sqrt(source.avar(np.array([tau_s, *LINE_TAU_S]), TAU0_S))
        if line[0] > lowest / MAX_DEPTH_RATIO:
            rings.append(CoefficientRing(letter, tau_s, float(line[0]), i % 3, line[1:]))
    return rings


def _set_limits(panel: "Axes", shown: Sequence[Floats], rings: Sequence[CoefficientRing]) -> None:
    panel.set(xscale="log", yscale="log")
    values = np.concatenate([*shown, [ring.sigma for ring in rings]]) if shown else np.array([1.0])
    values = values[np.isfinite(values) & (values > 0)]
    panel.set_ylim(values.min() / MARGIN_FACTOR, values.max() * MARGIN_FACTOR)
    left, right = panel.get_xlim()
    taus = [ring.tau_s for ring in rings]
    panel.set_xlim(min([left, *(t / MARGIN_FACTOR for t in taus)]), max([right, *(t * MARGIN_FACTOR for t in taus)]))


def _draw_terms(panel: "Axes", rings: Sequence[CoefficientRing]) -> None:
    for ring in rings:
        colour, size = COLOURS[ring.number], RING_SIZES[ring.number]
        panel.plot(LINE_TAU_S, ring.line, color=colour, linewidth=0.7, alpha=TERM_LINE_ALPHA, zorder=1, scalex=False)
        panel.plot(ring.tau_s, ring.sigma, "o", mfc="none", mec=colour, mew=1.4, markersize=size, zorder=5)
    for group in _group_rings(panel, rings):
        panel.annotate(
            group[0].letter,
            (group[0].tau_s, float(np.exp(np.mean([np.log(ring.sigma) for ring in group])))),
            (9, 0),
            textcoords="offset points",
            ha="left",
            va="center",
            color=COLOURS[group[0].number] if len(group) == 1 else DARK,
            fontsize=11,
            fontweight="bold",
            bbox={**LABEL_BOX, "alpha": 0.6},
            zorder=6,
        )


def _group_rings(panel: "Axes", rings: Sequence[CoefficientRing]) -> list[list[CoefficientRing]]:
    """Group rings of the same coefficient whose labels would overlap, so that each group has one label."""
    bottom, top = np.log(panel.get_ylim())
    groups: list[list[CoefficientRing]] = []
    for ring in sorted(rings, key=lambda one: (one.letter, one.sigma)):
        previous = groups[-1][-1] if groups else None
        distance = np.inf if previous is None else np.log(ring.sigma / previous.sigma) / (top - bottom)
        if previous is not None and previous.letter == ring.letter and distance < MIN_LETTER_DISTANCE:
            groups[-1].append(ring)
        else:
            groups.append([ring])
    return groups


def _draw_labels(
    panel: "Axes", kind: Kind, others: Sequence[AdditionalDeviation], drawn: Collection[str], units: UnitSystem
) -> None:
    panel.plot([], [], "--", color=GREY, label="fit")
    panel.fill_between([], [], [], color=GREY, alpha=0.25, label="95 %")
    for line_style, other in zip(OTHER_LINE_STYLES, others, strict=False):
        if other.name in drawn:
            marker = "o" if other.only_beyond else ""
            panel.plot([], [], line_style, marker=marker, mfc="white", color=GREY, linewidth=0.9, label=other.name)
    panel.set(xlabel="averaging time τ, s", ylabel=f"Allan deviation σ(τ), {units.deviation(kind).name}")
    panel.set_title(KIND_NAMES[kind])
    for which in "xy":
        style_log_axis(panel, which)
    draw_legend_above(panel, 5 + len(drawn))
