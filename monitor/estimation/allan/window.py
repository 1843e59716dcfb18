"""The sliding window: overlapping Allan variance of the last L samples, renewed with every sample.

Comes in: samples, missing ones included as NaN, in their places. Goes out: sums of squared second
differences S_m and their counts C_m for every cluster size m and axis, from which
σ²(m) = S_m / (2 m² C_m) (rate form; "Dynamic extraction of random
drift error coefficients of MEMS gyroscopes", eq. 12-15). Cost per sample: one added and one
evicted term a τ and axis, whatever the window's length.

Why it stays exact for years:

- Phase is an integer: the running sum of y · 2^s modulo 2⁶⁴, each rounding carried on to the next sample. So a
  second difference x_k - 2x_{k-m} + x_{k-2m} is right to one unit of 2^-s however far phase has wandered or
  wrapped, with 9.81 m/s² on the axis or not. s is chosen so that full-scale input cannot overflow at the longest τ.
- The same integers give the same squares when a term is evicted as when it was added, and S_m is kept as
  a double and the exact sum of its roundings (Knuth's TwoSum), so what a transient added is taken out again
  to 2⁻¹⁰⁶ of the largest sum ever held. Nothing is left behind.
- A missing sample keeps its place in time. A running count of missing samples a axis tells for every term
  whether its 2m samples were all there; only then does it enter, and the same count decides its leaving.

A row may look back over fewer samples than the window holds (``spans``): all rows share the one ring of phase, and each
evicts at its own distance.

The rounding is white phase noise of variance 2^-2s/12 and changes σ²(m) by about 2·2^-s/(σ √L) of itself at every m,
σ being the noise of a sample: for an hour at 100 Hz (s = 38, 36) and σ = 1e-4, 1e-10.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.errors import ConfigError
from drivers.sample import Floats, Ints
from monitor.estimation.allan.window_kernel import (
    AXES,
    LANES,
    LINE,
    NEWEST,
    RUN,
    STAGE,
    STRUCK,
    TOTAL,
    WIDTH,
    Parts,
    advance,
    bends,
    forget,
    thirds,
    view_floats,
    view_ints,
)

MIN_LENGTH: Final = 100
"""Samples; a shorter window holds no Allan curve worth a name."""
MAX_LENGTH: Final = 10_000_000
"""Samples; 64 bytes each are kept, 96 once any has been missing."""
HOLE_ROWS: Final = 4096
FULL_SCALE: Final = (70.0,) * 3 + (400.0,) * 3 + (1.0,) * 2
"""rad/s and m/s²: the mean over τ may reach these at the longest τ (4000 °/s, 40 g), more at shorter ones."""
QUICK_S: Final = 10.0
"""A shorter span makes the deviation of one sample jump about under the eye: 1000 samples at 100 Hz hold it to 3 %."""
QUICK_CLUSTERS: Final = 16
"""Of τ in its span: 15 independent differences, a deviation to ±20 %."""


def quick_spans(factors: Ints, rate_hz: float, length: int) -> Ints:
    """Samples that a displayed deviation looks back over: max(10 s, 16 τ), within the window.

    A change of N shows within a minute at τ up to 3 s, where a window of an hour needs the hour, and long τ keep the
    confidence they can have. Such a curve is for the eye: its points speak of different times, so a fit over it
    invents terms while anything changes (measured: ``docs/windows.md``).

    >>> quick_spans(np.array([1, 100, 10_000]), 100.0, 100_000).tolist()
    [1000, 1600, 100000]
    """
    return np.minimum(np.maximum(QUICK_CLUSTERS * factors, round(QUICK_S * rate_hz)), length)


def phase_scale(longest: int) -> Floats:
    """2^s [LANES], units of integer phase in one unit of the axis times a sample, for clusters of up to ``longest``.

    |second difference| ≤ 2 m · full scale must stay below 2^63.
    """
    bits = 62 - np.ceil(np.log2(2.0 * longest * np.array(FULL_SCALE)))
    return np.asarray(np.exp2(np.minimum(bits, 48.0)))


class AllanWindow:
    """Windowed overlapping Allan variance of six axes at many cluster sizes.

    Args:
        length: samples in the full window, MIN_LENGTH … MAX_LENGTH
        factors: cluster sizes m in samples, ascending, 1 ≤ m ≤ length/2
        spans: samples each row looks back over, 2m ≤ span ≤ length; absent: all of the window. With it, rows may
            come in any order and an m may occur again with another span

    >>> window = AllanWindow(100, np.array([1, 2]))
    >>> window.update(np.tile([[1.0], [2.0]], (50, 6)))   # 1, 2, 1, 2, … : σ²(1) = 1/2, σ²(2) = 0
    >>> window.avar()[:, 0].tolist()
    [0.5, 0.0]
    """

    def __init__(self, length: int, factors: Ints, spans: Ints | None = None) -> None:
        if not MIN_LENGTH <= length <= MAX_LENGTH:
            raise ConfigError(f"window of {length} samples; possible are {MIN_LENGTH} to {MAX_LENGTH}")
        if factors.size == 0 or factors.min() < 1 or 2 * factors.max() > length:
            raise ConfigError(f"cluster sizes {factors.tolist()} must lie within 1 and {length // 2}")
        if spans is None:
            if (np.diff(factors) <= 0).any():
                raise ConfigError(f"cluster sizes {factors.tolist()} must ascend")
            spans = np.full(factors.size, length)
        if spans.shape != factors.shape or (spans < 2 * factors).any() or (spans > length).any():
            raise ConfigError(f"spans {spans.tolist()} must lie within two clusters and {length} samples")
        self.length = length
        self.factors = factors.astype(np.int64)
        self.spans = spans.astype(np.int64)
        self._taus = int(factors.size)
        self._scale = phase_scale(int(factors.max()))
        # few arrays for all, as the interpreter takes 50 ns to hand one to the kernel; see view_ints, view_floats
        taus, places = self._taus, length + 1 + RUN
        self._ints = _aligned(LANES + -(-2 * taus // LINE) * LINE + taus * LANES + places * LANES, np.int64)
        self._floats = _aligned((2 + 2 * RUN + 2 * taus + STAGE) * LANES, np.float64)
        self._missing = np.zeros(places * LANES, np.int32)
        self._state, rows_m, rows_span, terms, self._phase = view_ints(self._ints, taus)
        rows_m[:], rows_span[:] = self.factors, self.spans
        self._scaling, _, sums, rest, stage = view_floats(self._floats, taus)
        self._terms = terms.reshape(taus, LANES)
        self._sums, self._rest = sums.reshape(taus, LANES), rest.reshape(taus, LANES)
        self._stage = stage[: STAGE * AXES].reshape(STAGE, AXES)
        self.resets = -1  # how many times it was emptied
        self.reset()

    @property
    def n(self) -> int:
        """Samples in the window now, missing ones included."""
        return min(int(self._state[TOTAL]), self.length)

    @property
    def total(self) -> int:
        """Samples since the last reset, missing ones included."""
        return int(self._state[TOTAL])

    def reset(self) -> None:
        """Forget all samples; phase and the count of missing ones only matter by their differences, and stay."""
        self.resets += 1
        self._terms[:] = 0
        self._floats[:] = 0
        self._scaling[:LANES] = self._scale
        self._state[[TOTAL, STRUCK, WIDTH]] = (0, -(1 << 62), LANES)

    def update(self, values: Floats) -> None:
        """Advance by samples [n, 6], one by one; NaN, and what is beyond any phase (1e7 and more), = missing."""
        rows = np.asarray(values)
        shape = rows.shape
        if len(shape) != 2 or shape[1] != AXES:
            raise ValueError(f"samples of shape {shape}; expected is [n, {AXES}]")
        n = shape[0]
        if n > STAGE:
            for start in range(0, n, STAGE):
                self.update(rows[start : start + STAGE])
            return
        self._stage[:n] = rows  # as ``stage`` does; calling it would cost a single sample 3 %
        advance(self._ints, self._floats, self._missing, self._taus, 0, n)

    def stage(self, values: Floats) -> None:
        """Lay up to STAGE samples [n, 6] ready for compiled code that advances by them (``parts``)."""
        # copied: each layout and access flag of an array would be compiled anew, for seconds
        self._stage[: len(values)] = values

    def parts(self) -> Parts:
        """What compiled code needs to advance the window."""
        return Parts(self._ints, self._floats, self._missing, self._taus, self.length)

    def skip(self, n: int) -> None:
        """Advance by n missing samples; more than the window holds empty it at once."""
        if n > self.length:
            self.reset()
            return
        # in pieces, so that a long outage needs no array of its length
        hole = np.full((min(n, HOLE_ROWS), AXES), np.nan)
        for start in range(0, n, HOLE_ROWS):
            self.update(hole[: n - start])

    def forget(self, axis: int, n: int) -> None:
        """Of one axis, forget all but the newest n samples: those before are missing from now on.

        Costs a walk over the window, and what n samples cost.
        """
        if n < self.n:
            forget(self._ints, self._floats, self._missing, self._taus, axis, n)

    def avar(self) -> Floats:
        """Allan variance [m, 6] in unit² of the axis; NaN where no term is complete."""
        sums = (self._sums + self._rest)[:, :AXES]
        m = self.factors[:, None] * self._scale[:AXES]
        terms = self._terms[:, :AXES]
        # a constant axis shows second differences of up to one unit, the rounding of its phase: no noise at all
        sums = np.where(sums <= terms, 0.0, sums)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(terms > 0, sums / (2.0 * m * m * terms), np.nan)

    def slope(self, lengths: Ints | None = None) -> Floats:
        """Slope of the rate over the newest ``lengths`` [6] samples, by default all; NaN where one is missing.

        [6], unit of the axis a sample: mean of the last third less that of the first, over two thirds of the
        window (``fit.slope_of_thirds``).
        """
        newest = int(self._state[NEWEST])
        lengths = np.full(AXES, self.n) if lengths is None else lengths
        result = np.array([thirds(self._phase, self._missing, newest, n, axis) for axis, n in enumerate(lengths)])
        return result / self._scale[:AXES]

    def slopes(self, lengths: Ints | None = None) -> Floats:
        """Slope of the rate [m, 6] as each τ sees it: its mean second difference of phase over m²; unit a sample.

        NaN where a sample is missing. Not of spans, but of the newest ``lengths`` [6] samples; of all by default.
        """
        result = np.empty((self._taus, AXES))
        lengths = np.full(AXES, self.n) if lengths is None else lengths
        bends(self._phase, self._missing, int(self._state[NEWEST]), lengths, self.factors, result)
        return result / self._scale[:AXES]

    def terms(self) -> Ints:
        """Number of second differences averaged, [m, 6]."""
        return self._terms[:, :AXES].copy()

    def newest(self, axis: int, n: int) -> Floats:
        """Up to n of the newest samples of one axis, from its phase; NaN = missing."""
        places = self._phase.size // LANES
        at = (int(self._state[NEWEST]) - np.arange(min(n, self.n), -1, -1)) % places
        phase, missing = self._phase[at * LANES + axis], self._missing[at * LANES + axis]
        return np.where(np.diff(missing) > 0, np.nan, np.diff(phase) / self._scale[axis])

    def ring(self) -> tuple[Ints, NDArray[np.int32], int, Floats]:
        """A look at phase without a copy, good until the next update.

        Phase [places, LANES] modulo 2⁶⁴; how many samples before each point were missing, alike; the row of the oldest
        of the window's n + 1 points, from which they go round; what one unit of phase is, in rad/s and m/s² [6].
        """
        rows = (self._phase.size // LANES, LANES)
        phase, missing = self._phase.reshape(rows), self._missing.reshape(rows)
        phase.flags.writeable = missing.flags.writeable = False
        return phase, missing, (int(self._state[NEWEST]) - self.n) % rows[0], 1.0 / self._scale[:AXES]


def _aligned(size: int, dtype: type[np.generic]) -> NDArray[Any]:
    """So many zeros that begin with a cache line."""
    space = np.zeros(size + LINE, dtype)
    start = -(space.ctypes.data // space.itemsize) % LINE
    return space[start : start + size]
