"""Allan plot of one kind of sensor on matplotlib axes, used by the PNG plot and by the report.

The plot is log-log in the units of the field: measured points with their 95 % band, and the fitted curve as a dashed
line. Each estimated term has a thin line of its own and a ring where its coefficient is read (IEEE Std 952). Q is read
at τ = √3 s, N at 1 s, K at 3 s and R at √2 s. B is read, as 0.664 B, at the minimum of the curve. Rings that would
overlap share a letter. Axes differ by colour and marker and do not hide each other. Markers and rings of the second
and third axis are smaller. The dashes of each fit lie in the gaps of the others. Only the drawing functions import
matplotlib.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from drivers.sample import AXES, Floats
from monitor.common.units import DEVIATION_UNITS, KIND_NAMES, Kind, axes_of
from monitor.estimation.allan.hadamard import HadamardCurve
from monitor.estimation.allan.total import TotalCurve
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients import SYMBOLS, Status
from monitor.noise.effects.bias_instability import FLICKER_FLOOR

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS: Final = ("#D55E00", "#009E73", "#0072B2")  # x y z: vermilion, bluish green, blue (Okabe & Ito)
MARKERS: Final = ("o", "s", "^")
SIZES: Final = (8.2, 5.0, 3.8)  # size of markers [pt]; identical axes remain visible inside each other
RING_SIZES: Final = (12.0, 8.5, 5.0)
DASHES: Final = ((0, (4, 8)), (4, (4, 8)), (8, (4, 8)))  # dashes of identical fits fill each other's gaps
GREY: Final = "#6b6b6b"
DARK: Final = "#222222"
READING_TAU_S: Final = {"Q": 3.0**0.5, "N": 1.0, "K": 3.0, "R": 2.0**0.5}  # τ at which the term's deviation equals it
SLOPES: Final = {"Q": -1.0, "N": -0.5, "B": 0.0, "K": 0.5, "R": 1.0}  # log-log slope of the deviation
LEGEND_TEXT: Final = (
    "○ a coefficient, read on its own line: Q at √3 s, N at 1 s, K at 3 s, R at √2 s; 0.664 B where the curve is lowest"
)
OTHER_LINE_STYLES: Final = ("-", ":", "-.")  # line styles of other deviations
MAX_DEPTH_RATIO: Final = 300.0  # rings further below the curve are omitted, as they would flatten the curve
MAX_BAND_RATIO: Final = 3.0  # a band extends the plot at most by this factor beyond its points
MARGIN_FACTOR: Final = 1.6  # margin around the plotted data, as a factor
FEW_DECADES_RATIO: Final = 60.0  # an axis with a smaller ratio of its ends has numbers between the powers of ten
MIN_LETTER_DISTANCE: Final = 0.045  # rings closer than this share of the plot's height share a letter


@dataclass(frozen=True, slots=True)
class OtherDeviation:
    """Another deviation of the same recording, drawn next to the overlapping Allan deviation."""

    name: str  # "total" or "Hadamard"
    tau_s: Floats  # [k]
    deviation: Floats  # [k, 6] SI unit of the axis
    lo: Floats  # [k, 6] ends of the 95 % interval; NaN if unknown
    hi: Floats
    only_beyond: bool = False  # True to draw only τ longer than the longest of the Allan deviation

    def rows(self, axis: int, longest_s: float) -> NDArray[np.bool_]:
        """Return which of the k points of an axis are drawn.

        Parameters
        ----------
        axis
            Column of the axis.
        longest_s
            Longest averaging time of the Allan deviation of this axis [s].
        """
        there = np.isfinite(self.deviation[:, axis]) & (self.deviation[:, axis] > 0)
        return np.asarray(there & (self.tau_s > longest_s) if self.only_beyond else there)


def other_deviations(total: TotalCurve | None = None, hadamard: HadamardCurve | None = None) -> list[OtherDeviation]:
    """Return the other deviations to draw: total deviation beyond the Allan deviation, Hadamard deviation everywhere.

    Parameters
    ----------
    total
        Total variance; None to omit it.
    hadamard
        Hadamard variance; None to omit it.
    """
    found = []
    if total is not None:
        found.append(OtherDeviation("total", total.tau_s, np.sqrt(total.tvar), total.lo, total.hi, only_beyond=True))
    if hadamard is not None:
        found.append(OtherDeviation("Hadamard", hadamard.tau_s, np.sqrt(hadamard.hvar), hadamard.lo, hadamard.hi))
    return found


@dataclass(frozen=True, slots=True)
class _Ring:
    """Coefficient of one axis, marked by a ring."""

    letter: str
    tau_s: float
    sigma: float  # deviation in the unit of the field
    number: int  # index of its axis: x, y, z

    @property
    def colour(self) -> str:
        """Colour of the axis."""
        return COLOURS[self.number]


def allan_panel(axes: "Axes", estimate: Estimate, kind: Kind, others: Sequence[OtherDeviation] = ()) -> None:
    """Draw one log-log panel with title and legend.

    Parameters
    ----------
    axes
        Axes to draw on.
    estimate
        The estimate.
    kind
        Kind of sensor.
    others
        Other deviations of the same recording.
    """
    factor = DEVIATION_UNITS[kind].factor
    tau_s, lowest_s = estimate.curve.tau_s, _lowest_s(estimate, kind)
    shown: list[Floats] = []
    rings: list[_Ring] = []
    drawn: set[str] = set()
    for number, (axis, colour, marker) in enumerate(zip(axes_of(kind), COLOURS, MARKERS, strict=True)):
        i = AXES.index(axis)
        rows = np.isfinite(estimate.curve.avar[:, i]) & (estimate.curve.avar[:, i] > 0)
        if not rows.any():
            continue
        measured, fitted = (np.sqrt(a[:, i]) * factor for a in (estimate.curve.avar, estimate.fitted))
        lo, hi = (a[rows, i] * factor for a in (estimate.curve.lo, estimate.curve.hi))
        axes.fill_between(tau_s[rows], lo, hi, color=colour, alpha=0.16, linewidth=0)
        axes.plot(tau_s, fitted, linestyle=DASHES[number], color=colour, linewidth=1.5, zorder=3)
        size = SIZES[number]
        axes.plot(
            tau_s[rows],
            measured[rows],
            marker,
            color=colour,
            markersize=size,
            mec="white",
            mew=0.4,
            label=axis,
            zorder=4,
        )
        shown += [
            measured[rows],
            fitted,
            np.clip(lo, measured[rows] / MAX_BAND_RATIO, None),
            np.clip(hi, None, measured[rows] * MAX_BAND_RATIO),
        ]
        shown += _draw_others(axes, others, i, colour, marker, factor, float(tau_s[rows][-1]))
        drawn |= {other.name for other in others if other.rows(i, float(tau_s[rows][-1])).any()}
        rings += _rings(estimate, i, factor, lowest_s, float(measured[rows].min()))
    _set_limits(axes, shown, rings)
    _draw_terms(axes, rings)
    _draw_labels(axes, kind, others, drawn)


def _draw_others(
    axes: "Axes", others: Sequence[OtherDeviation], i: int, colour: str, marker: str, factor: float, longest_s: float
) -> list[Floats]:
    """Draw other deviations of one axis as thin lines with open markers; return the values the plot must contain."""
    shown = []
    for number, other in enumerate(others):
        marks = other.rows(i, longest_s)
        if not marks.any():
            continue
        # The line begins at the last point of the Allan deviation, so that its origin is visible.
        line = marks | (other.tau_s == longest_s) if other.only_beyond else marks
        y = other.deviation[:, i] * factor
        axes.plot(
            other.tau_s[line], y[line], OTHER_LINE_STYLES[number % 3], color=colour, linewidth=0.9, alpha=0.8, zorder=2
        )
        shown.append(y[line])
        if other.only_beyond:  # at shorter τ, the markers would hide those of the Allan deviation
            ends = np.abs([y - other.lo[:, i] * factor, other.hi[:, i] * factor - y])[:, marks]
            axes.plot(other.tau_s[marks], y[marks], marker, mfc="white", mec=colour, mew=0.9, markersize=4.5, zorder=4)
            axes.errorbar(other.tau_s[marks], y[marks], ends, fmt="none", ecolor=colour, elinewidth=0.7, alpha=0.6)
    return shown


def _lowest_s(estimate: Estimate, kind: Kind) -> float:
    """Return the τ [s] at which the mean curve of a kind has its minimum, where B is read."""
    avar = estimate.curve.avar[:, [AXES.index(axis) for axis in axes_of(kind)]]
    good = np.isfinite(avar) & (avar > 0)
    # averaging times that all measured axes have
    rows = (good | ~good.any(axis=0)).all(axis=1) & good.any(axis=1)
    if not rows.any():
        return 1.0
    level = np.log(avar[rows][:, good.any(axis=0)]).mean(axis=1)
    return float(estimate.curve.tau_s[rows][np.argmin(level)])


def _rings(estimate: Estimate, i: int, factor: float, lowest_s: float, floor: float) -> list[_Ring]:
    """Return the rings of the estimated coefficients of one axis."""
    known = estimate.coefficients
    rings = [
        _Ring(
            letter,
            READING_TAU_S.get(letter, lowest_s),
            float(value) * (FLICKER_FLOOR if letter == "B" else 1.0) * factor,
            i % 3,
        )
        for letter, value, status in zip(SYMBOLS, known.value[:, i], known.status[:, i], strict=True)
        if status == Status.ESTIMATED
    ]
    return [ring for ring in rings if ring.sigma > floor / MAX_DEPTH_RATIO]


def _set_limits(axes: "Axes", shown: Sequence[Floats], rings: Sequence[_Ring]) -> None:
    """Set limits that contain all data, and the letters next to the rings."""
    axes.set(xscale="log", yscale="log")
    values = np.concatenate([*shown, [ring.sigma for ring in rings]]) if shown else np.array([1.0])
    values = values[np.isfinite(values) & (values > 0)]
    axes.set_ylim(values.min() / MARGIN_FACTOR, values.max() * MARGIN_FACTOR)
    left, right = axes.get_xlim()
    at = [ring.tau_s for ring in rings]
    axes.set_xlim(min([left, *(t / MARGIN_FACTOR for t in at)]), max([right, *(t * MARGIN_FACTOR for t in at)]))


def _draw_terms(axes: "Axes", rings: Sequence[_Ring]) -> None:
    """Draw the line and the ring of each term, and a letter for each group of rings."""
    from matplotlib.patheffects import withStroke

    ends_s = np.array(axes.get_xlim())
    halo = [withStroke(linewidth=3.0, foreground="white")]
    for ring in rings:
        line = ring.sigma * (ends_s / ring.tau_s) ** SLOPES[ring.letter]
        axes.plot(ends_s, line, "-", color=ring.colour, linewidth=0.7, alpha=0.4, zorder=1)
        size = RING_SIZES[ring.number]
        axes.plot(ring.tau_s, ring.sigma, "o", mfc="none", mec=ring.colour, mew=1.4, markersize=size, zorder=5)
    for heap in _group_rings(axes, rings):
        axes.annotate(
            heap[0].letter,
            (heap[0].tau_s, float(np.exp(np.mean([np.log(ring.sigma) for ring in heap])))),
            (9, 0),
            textcoords="offset points",
            ha="left",
            va="center",
            color=heap[0].colour if len(heap) == 1 else DARK,
            fontsize=11,
            fontweight="bold",
            path_effects=halo,
            zorder=6,
        )


def _group_rings(axes: "Axes", rings: Sequence[_Ring]) -> list[list[_Ring]]:
    """Group rings of one letter whose letters would overlap, lowest first."""
    bottom, top = np.log(axes.get_ylim())
    heaps: list[list[_Ring]] = []
    for ring in sorted(rings, key=lambda one: (one.letter, one.sigma)):
        before = heaps[-1][-1] if heaps else None
        close = before is not None and np.log(ring.sigma / before.sigma) < MIN_LETTER_DISTANCE * (top - bottom)
        if before is not None and close and before.letter == ring.letter:
            heaps[-1].append(ring)
        else:
            heaps.append([ring])
    return heaps


def _draw_labels(axes: "Axes", kind: Kind, others: Sequence[OtherDeviation], drawn: Collection[str]) -> None:
    """Draw labels, grid and legend; the legend names only those other deviations that are drawn."""
    axes.plot([], [], "--", color=GREY, linewidth=1.3, label="fit")
    axes.fill_between([], [], [], color=GREY, alpha=0.25, label="95 %")
    for number, other in enumerate(others):
        if other.name not in drawn:
            continue
        marker = "o" if other.only_beyond else ""
        axes.plot(
            [],
            [],
            OTHER_LINE_STYLES[number % 3],
            marker=marker,
            mfc="white",
            color=GREY,
            linewidth=0.9,
            label=other.name,
        )
    axes.set(xlabel="averaging time τ, s", ylabel=f"Allan deviation σ(τ), {DEVIATION_UNITS[kind].name}")
    axes.set_title(KIND_NAMES[kind], loc="left", fontsize=12)
    set_log_ticks(axes)
    style_grid(axes)
    # The legend is above the box, because curves and intervals may fill every corner of it.
    axes.legend(
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        borderaxespad=0.2,
        frameon=False,
        ncols=5 + len(drawn),
        handlelength=1.6,
        handletextpad=0.5,
        columnspacing=1.1,
    )


def style_grid(axes: "Axes") -> None:
    """Draw grid and frame in pale colours behind the data."""
    axes.grid(which="major", color="#d0d0d0", linewidth=0.8)
    axes.grid(which="minor", color="#ececec", linewidth=0.5)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def set_log_ticks(axes: "Axes") -> None:
    """Label a logarithmic y axis: powers of ten for several decades, else also plain numbers between them."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = axes.get_ylim()
    few = high / low < FEW_DECADES_RATIO
    axes.yaxis.set_minor_locator(LogLocator(subs=(2.0, 3.0, 5.0) if few else tuple(range(2, 10)), numticks=50))
    axes.yaxis.set_minor_formatter(FuncFormatter(lambda y, _: f"{y:g}") if few else NullFormatter())
    if few:
        axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
