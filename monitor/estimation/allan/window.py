"""Sliding window with the overlapping Allan variance of the last L samples, updated with every sample.

For every cluster size m and axis, the window stores the sum S_m and the number C_m of the squared second differences of
phase. The Allan variance of the rate is σ²(m) = S_m / (2 m² C_m), see "Dynamic extraction of random drift error
coefficients of MEMS gyroscopes", equations 12 to 15. Missing samples are NaN in the input and keep their positions in
time. For each τ and axis, a new sample adds one second difference and removes the oldest one. The cost therefore does
not depend on the window length.

Three measures keep the sums exact for years.

- Phase is an integer, the running sum of the samples times 2^s, modulo 2⁶⁴. The rounding error of each sample is added
  to the next sample. A second difference x_k - 2x_{k-m} + x_{k-2m} is therefore exact to one unit of 2^-s, even if
  phase has wrapped around. A constant such as 9.81 m/s² has no effect. The exponent s is chosen so that full-scale
  input cannot overflow at the longest τ.
- The same integers give the same squares when a term is added and when the term is removed. S_m is stored as a double,
  and the rounding errors of all additions are summed in a second double (Knuth's TwoSum). After a transient has left
  the window, the remaining error is 2⁻¹⁰⁶ of the largest value of S_m.
- For each axis, a running count of missing samples shows whether all 2m samples of a term are present. Incomplete terms
  are neither added nor removed.

Each τ can use a smaller number of newest samples than the window contains (``spans``). All τ use the same ring buffer
of phase.

The rounding adds white phase noise of variance 2^-2s/12. With noise of standard deviation σ per sample, the relative
change of σ²(m) is about 2·2^-s/(σ √L) at every m. For an hour at 100 Hz and σ = 1e-4 rad/s or m/s², the relative change
is 1e-10. The exponents s are then 38 for rates and 36 for accelerations.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import Floats, Ints
from drivers.errors import ConfigError
from monitor.estimation.allan.window_kernel import (
    AXES,
    LANES,
    LAST_MISSING,
    LINE,
    NEWEST,
    RUN_SAMPLES,
    STAGE_SAMPLES,
    TOTAL,
    WIDTH,
    WindowBuffers,
    append_staged_samples,
    keep_newest,
    rate_slopes_per_axis_and_tau,
    view_window_arrays,
)

MIN_LENGTH: Final = 100
"""Minimum window length in samples. A shorter window gives no useful Allan deviation."""
MAX_LENGTH: Final = 10_000_000
"""Maximum window length in samples. Each sample takes 64 bytes, or 96 bytes once a sample has been missing."""
SKIP_BLOCK_ROWS: Final = 4096
"""Largest number of missing samples processed in one call."""
FULL_SCALE: Final = (70.0,) * 3 + (400.0,) * 3 + (1.0,) * 2
"""Full scale in rad/s and m/s² (4000 °/s, 40 g).

At the longest τ, the mean over τ may reach these values. At shorter τ, it may exceed them.
"""
QUICK_S: Final = 10.0
"""Shortest span of a displayed deviation in seconds.

With a shorter span, the displayed deviation at m = 1 fluctuates visibly. With 1000 samples at 100 Hz, the fluctuation
is 3 %.
"""
QUICK_CLUSTERS: Final = 16
"""Minimum number of clusters of length τ in a span.

16 clusters give 15 independent differences and an error of 20 %.
"""


def samples_per_displayed_tau(factors: Ints, rate_hz: float, window_samples: int) -> Ints:
    """Return the number of newest samples that each displayed deviation uses.

    The span of each τ is 16 τ, at least 10 s and at most the whole window. A change of N is then fully visible within a
    minute at τ up to 3 s, even with a window of an hour. Long τ keep the best possible confidence. The deviations are
    only for display. The spans differ, so a fit to these deviations finds spurious terms while the noise changes
    (``docs/windows.md``).

    Parameters
    ----------
    factors : ndarray of int64, shape (m,)
        Cluster sizes in samples.
    rate_hz : float
        Sample rate in Hz.
    window_samples : int
        Window length in samples.

    Returns
    -------
    ndarray of int64, shape (m,)
        Span of each cluster size in samples.

    >>> samples_per_displayed_tau(np.array([1, 100, 10_000]), 100.0, 100_000).tolist()
    [1000, 1600, 100000]
    """
    return np.minimum(np.maximum(QUICK_CLUSTERS * factors, round(QUICK_S * rate_hz)), window_samples)


def integer_phase_scale(largest_cluster: int) -> Floats:
    """Return the scale 2^s [LANES] from samples to integer phase, for clusters of up to ``largest_cluster`` samples.

    A second difference is at most 2 m times full scale. The scaled value must stay below 2⁶³.
    """
    bits = 62 - np.ceil(np.log2(2.0 * largest_cluster * np.array(FULL_SCALE)))
    return np.asarray(np.exp2(np.minimum(bits, 48.0)))


class AllanWindow:
    """Sliding window with the overlapping Allan variance of six axes at many cluster sizes.

    Parameters
    ----------
    length : int
        Length of the full window in samples, from ``MIN_LENGTH`` to ``MAX_LENGTH``.
    factors : ndarray of int64, shape (m,)
        Cluster sizes in samples, ascending, from 1 to length/2.
    spans : ndarray of int64, shape (m,), or None
        Number of samples that each row uses, from two clusters to ``length``. None means the whole window. If spans are
        given, the rows may have any order, and a cluster size may occur several times with different spans.

    Raises
    ------
    ConfigError
        If the length, a cluster size or a span is out of range.

    >>> window = AllanWindow(100, np.array([1, 2]))
    >>> window.append_samples(np.tile([[1.0], [2.0]], (50, 6)))   # 1, 2, 1, 2, … : σ²(1) = 1/2, σ²(2) = 0
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
        self._scale = integer_phase_scale(int(factors.max()))
        # Three arrays hold everything, because each array passed to the kernel costs 50 ns. See view_window_arrays.
        taus, places = self._taus, length + 1 + RUN_SAMPLES
        self._ints = _aligned(LANES + -(-2 * taus // LINE) * LINE + taus * LANES + places * LANES, np.int64)
        self._floats = _aligned((2 + 2 * RUN_SAMPLES + 2 * taus + STAGE_SAMPLES) * LANES, np.float64)
        self._missing = np.zeros(places * LANES, np.int32)
        arrays = view_window_arrays(self._ints, self._floats, self._missing, taus)
        self._state, self._phase, self._scaling = arrays.state, arrays.phase, arrays.scaling
        arrays.factors[:], arrays.spans[:] = self.factors, self.spans
        self._terms = arrays.terms.reshape(taus, LANES)
        self._sums, self._rest = arrays.sums.reshape(taus, LANES), arrays.rest.reshape(taus, LANES)
        self._stage = arrays.stage[: STAGE_SAMPLES * AXES].reshape(STAGE_SAMPLES, AXES)
        self.resets = -1  # number of times the window has been emptied; the call below sets it to 0
        self.discard_samples()

    @property
    def samples_in_window(self) -> int:
        """Number of samples in the window, including missing ones."""
        return min(int(self._state[TOTAL]), self.length)

    @property
    def samples_since_reset(self) -> int:
        """Number of samples since the last reset, including missing ones."""
        return int(self._state[TOTAL])

    def discard_samples(self) -> None:
        """Discard all samples.

        Phase and the running count of missing samples are kept, because only differences of them are used.
        """
        self.resets += 1
        self._terms[:] = 0
        self._floats[:] = 0
        self._scaling[:LANES] = self._scale
        self._state[[TOTAL, LAST_MISSING, WIDTH]] = (0, -(1 << 62), LANES)

    def append_samples(self, values: Floats) -> None:
        """Advance the window by samples.

        Parameters
        ----------
        values : ndarray of float, shape (n, 6)
            Samples in rad/s and m/s². NaN and values of 1e7 and more, which are too large for integer phase, count as
            missing.

        Raises
        ------
        ValueError
            If the shape is not (n, 6).
        """
        rows = np.asarray(values)
        shape = rows.shape
        if len(shape) != 2 or shape[1] != AXES:
            raise ValueError(f"samples of shape {shape}; expected is [n, {AXES}]")
        n = shape[0]
        if n > STAGE_SAMPLES:
            for start in range(0, n, STAGE_SAMPLES):
                self.append_samples(rows[start : start + STAGE_SAMPLES])
            return
        self._stage[:n] = rows  # A call of ``stage`` would slow down a single sample by 3 %.
        append_staged_samples(self._ints, self._floats, self._missing, self._taus, 0, n)

    def copy_to_input_buffer(self, values: Floats) -> None:
        """Copy up to ``STAGE_SAMPLES`` samples [n, 6] to the input buffer of compiled code (``buffers``)."""
        # A copy, because each new memory layout or access flag of an array triggers a compilation of seconds.
        self._stage[: len(values)] = values

    def kernel_buffers(self) -> WindowBuffers:
        """Return the arrays of the window for compiled code."""
        return WindowBuffers(self._ints, self._floats, self._missing, self._taus, self.length)

    def append_missing_samples(self, n: int) -> None:
        """Advance by n missing samples. If n exceeds the window length, the window is emptied."""
        if n > self.length:
            self.discard_samples()
            return
        # In blocks, so that a long outage does not need a long array.
        hole = np.full((min(n, SKIP_BLOCK_ROWS), AXES), np.nan)
        for start in range(0, n, SKIP_BLOCK_ROWS):
            self.append_samples(hole[: n - start])

    def keep_newest(self, axis: int, n: int) -> None:
        """Discard all but the newest samples of one axis, and count the older ones as missing.

        The cost is one pass over the window and the cost of n new samples.

        Parameters
        ----------
        axis : int
            Index of the axis.
        n : int
            Number of newest samples to keep.
        """
        if n < self.samples_in_window:
            keep_newest(self._ints, self._floats, self._missing, self._taus, axis, n)

    def avar(self) -> Floats:
        """Return the Allan variance [m, 6] in squared units of the axis; NaN where no term is complete."""
        sums = (self._sums + self._rest)[:, :AXES]
        m = self.factors[:, None] * self._scale[:AXES]
        terms = self._terms[:, :AXES]
        # Rounding alone makes second differences of up to one unit on a constant axis. This is not noise.
        sums = np.where(sums <= terms, 0.0, sums)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(terms > 0, sums / (2.0 * m * m * terms), np.nan)

    def rate_slopes_per_axis_and_tau(self, lengths: Ints | None = None) -> tuple[Floats, Floats]:
        """Return the slope of the rate of each axis, and the slope that contributes to the Allan variance at each τ.

        The definitions are those of ``batch.rate_slope_from_thirds`` and ``batch.rate_slope_per_tau``.

        Parameters
        ----------
        lengths : ndarray of int64, shape (6,), or None
            Number of newest samples of each axis, independent of ``spans``. None means all samples in the window.

        Returns
        -------
        slope : ndarray of float64, shape (6,)
            Slope in units of the axis per sample; NaN if too many samples are missing.
        slopes : ndarray of float64, shape (m, 6)
            Slope at each τ, in the same unit.
        """
        slope, slopes = np.empty(AXES), np.empty((self._taus, AXES))
        lengths = np.full(AXES, self.samples_in_window) if lengths is None else lengths
        rate_slopes_per_axis_and_tau(self._ints, self._floats, self._missing, self._taus, lengths, slope, slopes)
        return slope / self._scale[:AXES], slopes / self._scale[:AXES]

    def term_counts(self) -> Ints:
        """Return the number of second differences averaged, shape (m, 6)."""
        return self._terms[:, :AXES].copy()

    def newest_samples(self, axis: int, n: int) -> Floats:
        """Return up to n of the newest samples of one axis, computed from the phase; NaN means missing.

        Parameters
        ----------
        axis : int
            Index of the axis.
        n : int
            Maximum number of samples.
        """
        places = self._phase.size // LANES
        at = (int(self._state[NEWEST]) - np.arange(min(n, self.samples_in_window), -1, -1)) % places
        phase, missing = self._phase[at * LANES + axis], self._missing[at * LANES + axis]
        return np.where(np.diff(missing) > 0, np.nan, np.diff(phase) / self._scale[axis])

    def view_phase_ring(self) -> tuple[Ints, NDArray[np.int32], int, Floats]:
        """Return a view of the ring buffer of phase. The view is valid until the next update.

        Returns
        -------
        phase : ndarray of int64, shape (rows, LANES)
            Integer phase modulo 2⁶⁴. The first six columns are the axes.
        missing : ndarray of int32, shape (rows, LANES)
            Running count of missing samples before each point.
        first : int
            Row of the oldest of the n + 1 phase points of the window. The points continue at row 0 after the last row.
        unit : ndarray of float64, shape (6,)
            Size of one unit of phase in rad/s and m/s².
        """
        rows = (self._phase.size // LANES, LANES)
        phase, missing = self._phase.reshape(rows), self._missing.reshape(rows)
        phase.flags.writeable = missing.flags.writeable = False
        return phase, missing, (int(self._state[NEWEST]) - self.samples_in_window) % rows[0], 1.0 / self._scale[:AXES]


def _aligned(size: int, dtype: type[np.generic]) -> NDArray[Any]:
    """Return an array of zeros that begins at a cache line."""
    space = np.zeros(size + LINE, dtype)
    start = -(space.ctypes.data // space.itemsize) % LINE
    return space[start : start + size]
