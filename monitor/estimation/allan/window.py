"""Sliding window with the overlapping Allan variance of the last L samples, updated with every sample.

For every cluster size m and axis, the window holds the sum S_m of the squared second differences of phase and their
number C_m. The Allan variance of the rate is σ²(m) = S_m / (2 m² C_m) ("Dynamic extraction of random drift error
coefficients of MEMS gyroscopes", eq. 12-15). Missing samples are NaN in the input and keep their positions in time.
Each sample adds one term and evicts one term per τ and axis, so the cost does not depend on the window length.

The sums stay exact for years for three reasons:

- Phase is an integer, the running sum of y · 2^s modulo 2⁶⁴. The rounding error of each sample is added to the next
  sample. A second difference x_k - 2x_{k-m} + x_{k-2m} is therefore exact to one unit of 2^-s, even if phase has
  wrapped around. A constant such as 9.81 m/s² has no effect. The exponent s is chosen so that full-scale input cannot
  overflow at the longest τ.
- The same integers give the same squares when a term is added and when it is evicted. S_m is stored as a double
  together with the exact sum of its rounding errors (Knuth's TwoSum). The contribution of a transient is therefore
  removed again to 2⁻¹⁰⁶ of the largest sum ever held.
- A running count of missing samples per axis shows for every term whether all of its 2m samples are present. Only such
  terms are added, and the same count decides whether they are evicted.

A row can use fewer samples than the window holds (``spans``). All rows share one ring of phase.

The rounding is white phase noise of variance 2^-2s/12. It changes σ²(m) by a relative amount of about 2·2^-s/(σ √L) at
every m, where σ is the noise of one sample. For an hour at 100 Hz (s = 38, 36) and σ = 1e-4, this is 1e-10.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.errors import ConfigError
from drivers.sample import Floats, Ints
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
    advance,
    keep_newest,
    slopes_of_axes_and_taus,
    view_arrays,
)

MIN_LENGTH: Final = 100
"""Minimum window length in samples. A shorter window gives no useful Allan curve."""
MAX_LENGTH: Final = 10_000_000
"""Maximum window length in samples. Each sample takes 64 bytes, or 96 bytes once a sample has been missing."""
SKIP_BLOCK_ROWS: Final = 4096
"""Number of missing samples that are processed at a time."""
FULL_SCALE: Final = (70.0,) * 3 + (400.0,) * 3 + (1.0,) * 2
"""Full scale in rad/s and m/s² (4000 °/s, 40 g).

The mean over τ may reach these values at the longest τ, and larger ones at shorter τ.
"""
QUICK_S: Final = 10.0
"""Shortest span of a displayed deviation in seconds.

With a shorter span, the displayed deviation at one sample fluctuates visibly. 1000 samples at 100 Hz limit this to 3 %.
"""
QUICK_CLUSTERS: Final = 16
"""Minimum number of clusters of length τ in a span. It gives 15 independent differences and a deviation to ±20 %."""


def display_spans(factors: Ints, rate_hz: float, length: int) -> Ints:
    """Return the number of samples that each displayed deviation uses: max(10 s, 16 τ), at most the whole window.

    A change of N then shows within a minute at τ up to 3 s, while a window of an hour needs the hour. Long τ keep the
    best possible confidence. The curve is only for display. Its points cover different times, so a fit to it finds
    spurious terms while the noise changes (measured: ``docs/windows.md``).

    Parameters
    ----------
    factors : ndarray of int64, shape (m,)
        Cluster sizes in samples.
    rate_hz : float
        Sample rate in Hz.
    length : int
        Window length in samples.

    Returns
    -------
    ndarray of int64, shape (m,)
        Span of each cluster size in samples.

    >>> display_spans(np.array([1, 100, 10_000]), 100.0, 100_000).tolist()
    [1000, 1600, 100000]
    """
    return np.minimum(np.maximum(QUICK_CLUSTERS * factors, round(QUICK_S * rate_hz)), length)


def phase_scale(longest: int) -> Floats:
    """Return 2^s [LANES], the units of integer phase per unit of the axis and sample, for clusters up to ``longest``.

    The bound |second difference| ≤ 2 m · full scale must stay below 2^63.
    """
    bits = 62 - np.ceil(np.log2(2.0 * longest * np.array(FULL_SCALE)))
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
        given, the rows may have any order, and a cluster size may occur again with another span.

    Raises
    ------
    ConfigError
        If the length, a cluster size or a span is out of range.

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
        # only a few arrays, because passing one to the kernel takes 50 ns; see view_arrays
        taus, places = self._taus, length + 1 + RUN_SAMPLES
        self._ints = _aligned(LANES + -(-2 * taus // LINE) * LINE + taus * LANES + places * LANES, np.int64)
        self._floats = _aligned((2 + 2 * RUN_SAMPLES + 2 * taus + STAGE_SAMPLES) * LANES, np.float64)
        self._missing = np.zeros(places * LANES, np.int32)
        arrays = view_arrays(self._ints, self._floats, self._missing, taus)
        self._state, self._phase, self._scaling = arrays.state, arrays.phase, arrays.scaling
        arrays.factors[:], arrays.spans[:] = self.factors, self.spans
        self._terms = arrays.terms.reshape(taus, LANES)
        self._sums, self._rest = arrays.sums.reshape(taus, LANES), arrays.rest.reshape(taus, LANES)
        self._stage = arrays.stage[: STAGE_SAMPLES * AXES].reshape(STAGE_SAMPLES, AXES)
        self.resets = -1  # number of times the window has been emptied; the call below makes it 0
        self.reset()

    @property
    def samples_in_window(self) -> int:
        """Number of samples in the window, including missing ones."""
        return min(int(self._state[TOTAL]), self.length)

    @property
    def samples_since_reset(self) -> int:
        """Number of samples since the last reset, including missing ones."""
        return int(self._state[TOTAL])

    def reset(self) -> None:
        """Discard all samples.

        Phase and the count of missing samples are kept, because only their differences matter.
        """
        self.resets += 1
        self._terms[:] = 0
        self._floats[:] = 0
        self._scaling[:LANES] = self._scale
        self._state[[TOTAL, LAST_MISSING, WIDTH]] = (0, -(1 << 62), LANES)

    def update(self, values: Floats) -> None:
        """Advance the window by samples.

        Parameters
        ----------
        values : ndarray of float, shape (n, 6)
            Samples in rad/s and m/s². NaN and values too large for integer phase (1e7 and more) count as missing.

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
                self.update(rows[start : start + STAGE_SAMPLES])
            return
        self._stage[:n] = rows  # the same as ``stage``; calling it would slow down a single sample by 3 %
        advance(self._ints, self._floats, self._missing, self._taus, 0, n)

    def stage(self, values: Floats) -> None:
        """Copy up to ``STAGE_SAMPLES`` samples [n, 6] to the input buffer of compiled code (``buffers``)."""
        # copied, because each new memory layout or access flag of an array triggers a compilation of seconds
        self._stage[: len(values)] = values

    def buffers(self) -> WindowBuffers:
        """Return the memory with which compiled code advances the window."""
        return WindowBuffers(self._ints, self._floats, self._missing, self._taus, self.length)

    def skip(self, n: int) -> None:
        """Advance by n missing samples. If n exceeds the window length, the window is emptied."""
        if n > self.length:
            self.reset()
            return
        # in blocks, so that a long outage needs no array of its full length
        hole = np.full((min(n, SKIP_BLOCK_ROWS), AXES), np.nan)
        for start in range(0, n, SKIP_BLOCK_ROWS):
            self.update(hole[: n - start])

    def keep_newest(self, axis: int, n: int) -> None:
        """Discard all but the newest samples of one axis, and count the older ones as missing.

        The cost is one pass over the window plus the cost of n samples.

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
        # the second differences of a constant axis reach one unit by rounding alone, which is not noise
        sums = np.where(sums <= terms, 0.0, sums)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(terms > 0, sums / (2.0 * m * m * terms), np.nan)

    def slopes_of_axes_and_taus(self, lengths: Ints | None = None) -> tuple[Floats, Floats]:
        """Return the slope of the rate of each axis over its newest samples, and the slope that each τ sees.

        The slope of an axis is the mean of the last third minus the mean of the first third, divided by two thirds of
        the duration (``batch.slope_of_recording``). The slope that τ sees is the mean second difference of phase
        divided by m² (``batch.rate_slope_per_tau``).

        Parameters
        ----------
        lengths : ndarray of int64, shape (6,), or None
            Number of newest samples of each axis, independent of ``spans``. None means all samples in the window.

        Returns
        -------
        slope : ndarray of float64, shape (6,)
            Slope in units of the axis per sample; NaN if too many samples are missing.
        slopes : ndarray of float64, shape (m, 6)
            Slope that each τ sees, in the same unit.
        """
        slope, slopes = np.empty(AXES), np.empty((self._taus, AXES))
        lengths = np.full(AXES, self.samples_in_window) if lengths is None else lengths
        slopes_of_axes_and_taus(self._ints, self._floats, self._missing, self._taus, lengths, slope, slopes)
        return slope / self._scale[:AXES], slopes / self._scale[:AXES]

    def terms(self) -> Ints:
        """Return the number of second differences averaged, shape (m, 6)."""
        return self._terms[:, :AXES].copy()

    def newest_samples(self, axis: int, n: int) -> Floats:
        """Return up to n of the newest samples of one axis from its phase; NaN means missing.

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

    def view_ring(self) -> tuple[Ints, NDArray[np.int32], int, Floats]:
        """Return a view of the ring of phase without a copy. It is valid until the next update.

        Returns
        -------
        phase : ndarray of int64, shape (places, LANES)
            Integer phase modulo 2⁶⁴.
        missing : ndarray of int32, shape (places, LANES)
            Running count of missing samples before each point.
        first : int
            Row of the oldest of the n + 1 points of the window. The points wrap around the end of the ring.
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
