"""The Allan plot of one kind of sensor, drawn on matplotlib's axes: for the picture and for the report.

In come an ``Estimate`` and, if there are any, other deviations of the same recording; log-log, in the field's units.
Measured points with their 95 % band, the fitted curve dashed, and the letters in the way of the field: for each term
that is estimated its own line, thin, and a ring where the coefficient is read on it (IEEE Std 952): Q at τ = √3 s, N at
1 s, K at 3 s, R at √2 s, and B, as 0.664 B, where the curve is lowest. Rings that would cover each other share a
letter. Axes differ by colour and by marker, and none covers another: markers and rings of the second and third are
smaller, and the dashes of each fit lie in the gaps of the others. Only functions that draw import matplotlib.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from drivers.sample import AXES, Floats
from monitor.estimation.allan.hadamard import HadamardCurve
from monitor.estimation.allan.total import TotalCurve
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients import LETTERS, Status
from monitor.publishing.coefficient_cells import DEVIATION_UNITS, KIND_NAMES, Kind, axes_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS: Final = ("#D55E00", "#009E73", "#0072B2")  # x y z: vermilion, bluish green, blue (Okabe & Ito)
MARKERS: Final = ("o", "s", "^")
SIZES: Final = (8.2, 5.0, 3.8)  # of markers, pt: axes that are alike stay visible inside each other
RING_SIZES: Final = (12.0, 8.5, 5.0)
DASHES: Final = ((0, (4, 8)), (4, (4, 8)), (8, (4, 8)))  # of fits that coincide, each fills the gaps of the others
GREY: Final = "#6b6b6b"
DARK: Final = "#222222"
READ_AT_S: Final = {"Q": 3.0**0.5, "N": 1.0, "K": 3.0, "R": 2.0**0.5}  # where the term's deviation is its coefficient
SLOPES: Final = {"Q": -1.0, "N": -0.5, "B": 0.0, "K": 0.5, "R": 1.0}  # of the deviation, log-log
FLOOR: Final = (2.0 * np.log(2.0) / np.pi) ** 0.5  # deviation of flicker over B
READING: Final = (
    "○ a coefficient, read on its own line: Q at √3 s, N at 1 s, K at 3 s, R at √2 s; 0.664 B where the curve is lowest"
)
STYLES: Final = ("-", ":", "-.")  # of the lines of other deviations
BELOW: Final = 300.0  # a ring further than this factor below the curve is not shown: the curve would be flat
BEYOND: Final = 3.0  # a band further than this factor beyond the points leaves the plot
SPAN: Final = 1.6  # room around all that is shown
FEW: Final = 60.0  # a height of fewer decades has numbers between the powers of ten
LETTER_SHARE: Final = 0.045  # of the plot's height: rings closer than a letter share it


@dataclass(frozen=True, slots=True)
class Beside:
    """Another deviation of the same recording, to be drawn beside the overlapping Allan deviation."""

    name: str  # "total", "Hadamard"
    tau_s: Floats  # [k]
    deviation: Floats  # [k, 6] unit of the axis
    lo: Floats  # [k, 6] ends of the 95 % interval; NaN where none can be given
    hi: Floats
    only_beyond: bool = False  # only where τ is longer than the longest of the Allan deviation

    def rows(self, axis: int, longest_s: float) -> NDArray[np.bool_]:
        """Its points [k] that are drawn, of an axis whose Allan deviation ends at ``longest_s``."""
        there = np.isfinite(self.deviation[:, axis]) & (self.deviation[:, axis] > 0)
        return np.asarray(there & (self.tau_s > longest_s) if self.only_beyond else there)


def besides(total: TotalCurve | None = None, hadamard: HadamardCurve | None = None) -> list[Beside]:
    """Total deviation from where the Allan deviation ends, and Hadamard deviation throughout: those that are given."""
    found = []
    if total is not None:
        found.append(Beside("total", total.tau_s, np.sqrt(total.tvar), total.lo, total.hi, only_beyond=True))
    if hadamard is not None:
        found.append(Beside("Hadamard", hadamard.tau_s, np.sqrt(hadamard.hvar), hadamard.lo, hadamard.hi))
    return found


@dataclass(frozen=True, slots=True)
class _Ring:
    """A coefficient of one axis on the plot."""

    letter: str
    tau_s: float
    sigma: float  # field unit
    number: int  # of its axis, x y z

    @property
    def colour(self) -> str:
        return COLOURS[self.number]


def allan_panel(axes: "Axes", estimate: Estimate, kind: Kind, others: Sequence[Beside] = ()) -> None:
    """One log-log panel, with its title and legend."""
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
            np.clip(lo, measured[rows] / BEYOND, None),
            np.clip(hi, None, measured[rows] * BEYOND),
        ]
        shown += _beside(axes, others, i, colour, marker, factor, float(tau_s[rows][-1]))
        drawn |= {other.name for other in others if other.rows(i, float(tau_s[rows][-1])).any()}
        rings += _rings(estimate, i, factor, lowest_s, float(measured[rows].min()))
    _limits(axes, shown, rings)
    _letters(axes, rings)
    _furnish(axes, kind, others, drawn)


def _beside(
    axes: "Axes", others: Sequence[Beside], i: int, colour: str, marker: str, factor: float, longest_s: float
) -> list[Floats]:
    """Other deviations of one axis: a thin line with open markers. Returns what the height must hold."""
    shown = []
    for number, other in enumerate(others):
        marks = other.rows(i, longest_s)
        if not marks.any():
            continue
        # the line begins at the last point of the Allan deviation, so that it is seen what it goes on from
        line = marks | (other.tau_s == longest_s) if other.only_beyond else marks
        y = other.deviation[:, i] * factor
        axes.plot(other.tau_s[line], y[line], STYLES[number % 3], color=colour, linewidth=0.9, alpha=0.8, zorder=2)
        shown.append(y[line])
        if other.only_beyond:  # elsewhere its marks would cover those of the Allan deviation
            ends = np.abs([y - other.lo[:, i] * factor, other.hi[:, i] * factor - y])[:, marks]
            axes.plot(other.tau_s[marks], y[marks], marker, mfc="white", mec=colour, mew=0.9, markersize=4.5, zorder=4)
            axes.errorbar(other.tau_s[marks], y[marks], ends, fmt="none", ecolor=colour, elinewidth=0.7, alpha=0.6)
    return shown


def _lowest_s(estimate: Estimate, kind: Kind) -> float:
    """Where the curves of a kind are lowest, on average: there B is read."""
    avar = estimate.curve.avar[:, [AXES.index(axis) for axis in axes_of(kind)]]
    good = np.isfinite(avar) & (avar > 0)
    # τ that every measured axis has
    rows = (good | ~good.any(axis=0)).all(axis=1) & good.any(axis=1)
    if not rows.any():
        return 1.0
    level = np.log(avar[rows][:, good.any(axis=0)]).mean(axis=1)
    return float(estimate.curve.tau_s[rows][np.argmin(level)])


def _rings(estimate: Estimate, i: int, factor: float, lowest_s: float, floor: float) -> list[_Ring]:
    """Where the estimated coefficients of one axis are read."""
    known = estimate.coefficients
    rings = [
        _Ring(letter, READ_AT_S.get(letter, lowest_s), float(value) * (FLOOR if letter == "B" else 1.0) * factor, i % 3)
        for letter, value, status in zip(LETTERS, known.value[:, i], known.status[:, i], strict=True)
        if status == Status.ESTIMATED
    ]
    return [ring for ring in rings if ring.sigma > floor / BELOW]


def _limits(axes: "Axes", shown: Sequence[Floats], rings: Sequence[_Ring]) -> None:
    """Room for all that is shown, and for the letters under the rings."""
    axes.set(xscale="log", yscale="log")
    values = np.concatenate([*shown, [ring.sigma for ring in rings]]) if shown else np.array([1.0])
    values = values[np.isfinite(values) & (values > 0)]
    axes.set_ylim(values.min() / SPAN, values.max() * SPAN)
    left, right = axes.get_xlim()
    at = [ring.tau_s for ring in rings]
    axes.set_xlim(min([left, *(t / SPAN for t in at)]), max([right, *(t * SPAN for t in at)]))


def _letters(axes: "Axes", rings: Sequence[_Ring]) -> None:
    """The line of every term, a ring where it is read, and beside a heap of rings their letter."""
    from matplotlib.patheffects import withStroke

    ends_s = np.array(axes.get_xlim())
    halo = [withStroke(linewidth=3.0, foreground="white")]
    for ring in rings:
        line = ring.sigma * (ends_s / ring.tau_s) ** SLOPES[ring.letter]
        axes.plot(ends_s, line, "-", color=ring.colour, linewidth=0.7, alpha=0.4, zorder=1)
        size = RING_SIZES[ring.number]
        axes.plot(ring.tau_s, ring.sigma, "o", mfc="none", mec=ring.colour, mew=1.4, markersize=size, zorder=5)
    for heap in _heaps(axes, rings):
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


def _heaps(axes: "Axes", rings: Sequence[_Ring]) -> list[list[_Ring]]:
    """Rings of one letter that would cover each other's letter, lowest first."""
    bottom, top = np.log(axes.get_ylim())
    heaps: list[list[_Ring]] = []
    for ring in sorted(rings, key=lambda one: (one.letter, one.sigma)):
        before = heaps[-1][-1] if heaps else None
        close = before is not None and np.log(ring.sigma / before.sigma) < LETTER_SHARE * (top - bottom)
        if before is not None and close and before.letter == ring.letter:
            heaps[-1].append(ring)
        else:
            heaps.append([ring])
    return heaps


def _furnish(axes: "Axes", kind: Kind, others: Sequence[Beside], drawn: Collection[str]) -> None:
    """Labels, grid and legend; of other deviations those are named that are drawn."""
    axes.plot([], [], "--", color=GREY, linewidth=1.3, label="fit")
    axes.fill_between([], [], [], color=GREY, alpha=0.25, label="95 %")
    for number, other in enumerate(others):
        if other.name not in drawn:
            continue
        marker = "o" if other.only_beyond else ""
        axes.plot([], [], STYLES[number % 3], marker=marker, mfc="white", color=GREY, linewidth=0.9, label=other.name)
    axes.set(xlabel="averaging time τ, s", ylabel=f"Allan deviation σ(τ), {DEVIATION_UNITS[kind].name}")
    axes.set_title(KIND_NAMES[kind], loc="left", fontsize=12)
    plain_ticks(axes)
    quiet(axes)
    # above the box: curves and intervals may fill every corner of it
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


def quiet(axes: "Axes") -> None:
    """Grid and frame that do not stand before the data."""
    axes.grid(which="major", color="#d0d0d0", linewidth=0.8)
    axes.grid(which="minor", color="#ececec", linewidth=0.5)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def plain_ticks(axes: "Axes") -> None:
    """Of a logarithmic height: powers of ten where there are several, else plain numbers between them too."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = axes.get_ylim()
    few = high / low < FEW
    axes.yaxis.set_minor_locator(LogLocator(subs=(2.0, 3.0, 5.0) if few else tuple(range(2, 10)), numticks=50))
    axes.yaxis.set_minor_formatter(FuncFormatter(lambda y, _: f"{y:g}") if few else NullFormatter())
    if few:
        axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
