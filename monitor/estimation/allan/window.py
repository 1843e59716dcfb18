"""Sliding window that updates the overlapping Allan variance of the last L samples with every new sample.

For every axis and cluster size m, the window stores the sum S and the number C of the squared second differences of
phase. The Allan variance of the rate is S / (2 m² C) ("Dynamic extraction of random drift error coefficients of MEMS
gyroscopes", equations 12 to 15). A new sample adds one second difference and removes the oldest one, so the cost does
not depend on the window length. NaN in the input means a missing sample. If samples of a cluster are missing, the mean
of the other samples is used, and the bias is corrected (``missing_samples``).

Three measures keep the sums of squares exact.

- Phase is an integer: the running sum of the samples times 2^s, modulo 2⁶⁴. The rounding error of each sample is
  carried over to the next sample. A second difference is therefore exact to one unit of 2^-s. The exponent s is chosen
  so that full-scale input cannot cause an overflow at the longest τ.
- A second difference of integer phase has exactly the same square when it is removed as when it was added. The rounding
  errors of the sums are accumulated in a second double-precision number (Knuth's TwoSum).
- A running count of missing samples gives the number of samples in each cluster. The contribution of missing samples is
  summed as an integer.

Rounding adds white phase noise of variance 2^-2s/12. For a window of one hour at 100 Hz and noise of 1e-4 rad/s or m/s²
per sample, the relative change of the Allan variance is 1e-10.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import Floats, Ints
from drivers.errors import ConfigError
from monitor.common.compiled_vectors import LANES
from monitor.estimation.allan.missing_samples import AllanVariances, variance_within_clusters
from monitor.estimation.allan.window_kernel import (
    AXES,
    EXCESS_UNIT,
    LAST_MISSING,
    LAST_PARTIAL,
    LINE,
    MAX_PHASE_STEP,
    NEWEST,
    STAGE_SAMPLES,
    TOTAL,
    WindowBuffers,
    append_staged_samples,
    copy_variances,
    drift_slopes_by_axis_and_tau,
    keep_newest,
    view_window_arrays,
    window_memory_size,
)

MIN_LENGTH: Final = 100
"""Minimum window length in samples."""
MAX_LENGTH: Final = 10_000_000
"""Maximum window length in samples. Each sample needs up to 96 bytes of memory."""
ONE_SAMPLE: Final = (1, AXES)
SKIP_BLOCK_ROWS: Final = 4096
"""Maximum number of missing samples that are appended at a time."""
FULL_SCALE: Final = (70.0,) * 3 + (400.0,) * 3 + (1.0,) * 2
"""Largest allowed mean over the longest τ, in rad/s (4000 °/s) and m/s² (40 g)."""
QUICK_S: Final = 10.0
"""Minimum duration of the samples from which a displayed Allan deviation is computed, in seconds.

In 10 s at 100 Hz, the displayed Allan deviation at m = 1 fluctuates by 3 %.
"""
QUICK_CLUSTERS: Final = 16
"""Minimum number of clusters from which a displayed Allan deviation is computed. The error is then about 20 %."""


def newest_samples_per_displayed_tau(factors: Ints, rate_hz: float, window_samples: int) -> Ints:
    """Return the number of newest samples from which each displayed Allan deviation is computed.

    The duration of the samples is 16 τ, but at least 10 s and at most the whole window. A change of the white noise is
    therefore visible within a minute for τ up to 3 s. The displayed values are not used for fits, because a fit to them
    would find spurious noise terms (``docs/explanation/windows.md``).

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
        Number of newest samples for each cluster size.

    >>> newest_samples_per_displayed_tau(np.array([1, 100, 10_000]), 100.0, 100_000).tolist()
    [1000, 1600, 100000]
    """
    return np.minimum(np.maximum(QUICK_CLUSTERS * factors, round(QUICK_S * rate_hz)), window_samples)


def integer_phase_scale(largest_cluster: int) -> Floats:
    """Return the scale factors 2^s [LANES] that convert samples to integer phase.

    The factors are chosen so that second differences at the largest cluster size stay below 2⁶³.
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
        Number of newest samples that are used at each cluster size, from two clusters to ``length``. None means the
        whole window. If ``spans`` is given, a cluster size may occur several times.

    Raises
    ------
    ConfigError
        If the window length, a cluster size or a span is out of range.

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
        # the last rows are powers of two that the correction for missing samples needs
        within = variance_within_clusters(self.factors, self.spans)
        self._taus = int(within.factors.size)
        self._scale = integer_phase_scale(int(factors.max()))
        taus = self._taus
        self._memory = _aligned(window_memory_size(length, taus))
        arrays = view_window_arrays(self._memory, taus)
        self._state, self._phase, self._scaling = arrays.state, arrays.phase, arrays.scaling
        self._missing = arrays.missing
        arrays.factors[:], arrays.spans[:] = within.factors, within.spans
        arrays.order[:], arrays.first[:], arrays.weights[:] = within.order, within.first, within.weights.ravel()
        self._terms, self._excess = arrays.terms.reshape(taus, LANES), arrays.excess
        self._sums, self._rest = arrays.sums.reshape(taus, LANES), arrays.rest.reshape(taus, LANES)
        self._stage = arrays.stage[: STAGE_SAMPLES * AXES].reshape(STAGE_SAMPLES, AXES)
        self._first_staged = self._stage[:1]  # creating this view takes 0.1 µs
        self.resets = -1  # number of times the window has been emptied
        self.discard_samples()

    @property
    def samples_in_window(self) -> int:
        """Number of samples in the window, including missing samples."""
        return min(int(self._state[TOTAL]), self.length)

    @property
    def samples_since_reset(self) -> int:
        """Number of samples since the window was emptied, including missing samples."""
        return int(self._state[TOTAL])

    @property
    def largest_value(self) -> Floats:
        """Absolute values [6] in rad/s and m/s² from which samples count as missing, because the phase would overflow.

        The limits are inversely proportional to the resolution of the phase, and are smallest for short windows: at
        least 14 000 rad/s and 56 000 m/s², which no inertial sensor reaches.
        """
        return np.asarray(MAX_PHASE_STEP / self._scale[:AXES])

    def discard_samples(self) -> None:
        """Discard all samples in the window."""
        self.resets += 1
        self._terms[:], self._excess[:] = 0, 0
        self._sums[:] = self._rest[:] = 0.0
        self._scaling[:LANES], self._scaling[LANES:] = self._scale, 0.0
        self._state[[TOTAL, LAST_MISSING, LAST_PARTIAL]] = (0, -(1 << 62), -(1 << 62))

    def append_samples(self, values: Floats) -> None:
        """Append samples to the window. If the window is full, the oldest samples are removed.

        Parameters
        ----------
        values : ndarray of float, shape (n, 6)
            Samples in rad/s and m/s². NaN and values from ``largest_value`` on count as missing samples.

        Raises
        ------
        ValueError
            If the shape is not (n, 6).
        """
        rows = np.asarray(values)
        shape = rows.shape
        if shape == ONE_SAMPLE:
            self._first_staged[...] = rows
            append_staged_samples(self._memory, self._taus, 0, 1)
            return
        if len(shape) != 2 or shape[1] != AXES:
            raise ValueError(f"samples of shape {shape}; expected is [n, {AXES}]")
        for start in range(0, shape[0], STAGE_SAMPLES):
            part = rows[start : start + STAGE_SAMPLES]
            self._stage[: len(part)] = part
            append_staged_samples(self._memory, self._taus, 0, len(part))

    def copy_to_input_buffer(self, values: Floats) -> None:
        """Copy up to ``STAGE_SAMPLES`` samples [n, 6] to the input buffer of the compiled kernels."""
        # The samples are copied, because each new memory layout of an array would trigger a compilation of several
        # seconds.
        self._stage[: len(values)] = values

    def kernel_buffers(self) -> WindowBuffers:
        """Return the arrays of the window in the form that the compiled kernels expect."""
        return WindowBuffers(self._memory, self._taus, self.length)

    def append_missing_samples(self, n: int) -> None:
        """Append n missing samples. If n exceeds the window length, the window is emptied."""
        if n > self.length:
            self.discard_samples()
            return
        # The missing samples are appended in blocks, to limit the memory that a long outage needs.
        hole = np.full((min(n, SKIP_BLOCK_ROWS), AXES), np.nan)
        for start in range(0, n, SKIP_BLOCK_ROWS):
            self.append_samples(hole[: n - start])

    def keep_newest(self, axis: int, n: int) -> None:
        """Discard all but the newest n samples of one axis. No cluster that contains a discarded sample counts.

        Parameters
        ----------
        axis : int
            Index of the axis.
        n : int
            Number of newest samples to keep.
        """
        if n < self.samples_in_window:
            keep_newest(self._memory, self._taus, axis, n)

    def avar(self) -> Floats:
        """Return the Allan variance [m, 6] in squared units of the axis; NaN if too many samples are missing."""
        return np.maximum(self.variances().avar, 0.0)

    def variances(self) -> AllanVariances:
        """Return the Allan variances of six axes, corrected for missing samples."""
        shape = (self._taus, AXES)
        avar, terms, excess = np.empty(shape), np.empty(shape, np.int64), np.empty(shape)
        copy_variances(self._memory, self._taus, avar, terms, excess)
        shown = slice(self.factors.size)
        return AllanVariances(avar[shown], terms[shown], excess[shown])

    def drift_slopes_by_axis_and_tau(
        self, lengths: Ints | None = None, taus: int | None = None
    ) -> tuple[Floats, Floats]:
        """Return the slope of the rate of each axis, and the slope at each averaging time.

        The slopes are defined in ``batch.rate_slope_from_thirds`` and ``batch.rate_slope_per_tau``.

        Parameters
        ----------
        lengths : ndarray of int64, shape (6,), or None
            Number of newest samples that are used for each axis. None means all samples in the window.
        taus : int or None
            Number m of averaging times, from the first. None means all averaging times.

        Returns
        -------
        slope : ndarray of float64, shape (6,)
            Slope in units of the axis per sample; NaN if too many samples are missing.
        slopes : ndarray of float64, shape (m, 6)
            Slope at each τ in units of the axis per sample.
        """
        slope, slopes = np.empty(AXES), np.empty((AXES, taus or self.factors.size))
        lengths = np.full(AXES, self.samples_in_window) if lengths is None else lengths
        drift_slopes_by_axis_and_tau(self._memory, self._taus, lengths, slope, slopes)
        return slope, slopes.T

    def squared_difference_sums(self) -> tuple[Floats, Floats, Ints]:
        """Return the sums from which the Allan variances are computed, each of shape (m, 6).

        Returns
        -------
        squares : ndarray of float64
            Sums of the squared second differences of integer phase.
        extra : ndarray of float64
            Sums of m/n_A + m/n_B − 2, where n_A and n_B samples of the two clusters are present.
        terms : ndarray of int64
            Numbers of second differences.
        """
        own = np.s_[: self.factors.size, :AXES]
        extra = EXCESS_UNIT * self._excess.reshape(self._taus, LANES).astype(np.float64)
        return (self._sums + self._rest)[own], extra[own], self._terms[own].copy()

    def missing_samples(self, lengths: Ints) -> Ints:
        """Return the number [6] of missing samples among the newest ``lengths`` [6] samples of each axis."""
        oldest = (int(self._state[NEWEST]) - lengths) % (self._phase.size // LANES) * LANES + np.arange(AXES)
        newest = int(self._state[NEWEST]) * LANES + np.arange(AXES)
        return np.asarray((self._missing[newest] - self._missing[oldest]).astype(np.int64))  # the counts wrap around

    def newest_samples(self, axis: int, n: int) -> Floats:
        """Return up to n newest samples of one axis, reconstructed from the phase; NaN means missing.

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
        """Return a view of the phase in the ring buffer, which is valid until new samples are appended.

        Returns
        -------
        phase : ndarray of int64, shape (rows, LANES)
            Integer phase modulo 2⁶⁴. The first six columns are the axes.
        missing : ndarray of int32, shape (rows, LANES)
            Running count of the missing samples before each phase point.
        first : int
            Row of the oldest phase point in the window.
        unit : ndarray of float64, shape (6,)
            Value of one integer unit of phase in rad/s and m/s².
        """
        rows = (self._phase.size // LANES, LANES)
        phase, missing = self._phase.reshape(rows), self._missing.reshape(rows)
        phase.flags.writeable = missing.flags.writeable = False
        return phase, missing, (int(self._state[NEWEST]) - self.samples_in_window) % rows[0], 1.0 / self._scale[:AXES]


def _aligned(size: int) -> Ints:
    """Return an array of zeros [size] aligned to a cache line."""
    space = np.zeros(size + LINE, np.int64)
    start = -(space.ctypes.data // space.itemsize) % LINE
    return space[start : start + size]
