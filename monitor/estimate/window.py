"""The sliding window: overlapping Allan variance of the last L samples, renewed with every sample.

Comes in: samples, missing ones included as NaN, in their places. Goes out: sums of squared second
differences S_m and their counts C_m for every cluster size m and axis, from which
σ²(m) = S_m / (2 m² C_m) (rate form; METHODS 1, `papers/000_…` eq. 12-15). Cost per sample: one added and one
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

The rounding is white phase noise of variance 2^-2s/12 and changes σ²(m) by about 2·2^-s/(σ √L) of itself at every m,
σ being the noise of a sample: for an hour at 100 Hz (s = 38, 36) and σ = 1e-4, 1e-10.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.errors import ConfigError
from drivers.sample import Floats, Ints
from monitor.compiled import compiled

MIN_LENGTH: Final = 100
"""Samples; a shorter window holds no Allan curve worth a name."""
MAX_LENGTH: Final = 10_000_000
"""Samples; 96 bytes each are kept."""
AXES: Final = 6
LANES: Final = 8
"""Columns kept a sample: six axes padded to a vector register."""
HOLE_ROWS: Final = 4096
SCALE, CARRY, SUMS = 0, 1, 2
"""Rows of the float workspace."""
RUN: Final = 64
"""Samples whose phase is written before the τ take their terms."""
FULL_SCALE: Final = (70.0,) * 3 + (400.0,) * 3 + (1.0,) * 2
"""rad/s and m/s²: the mean over τ may reach these at the longest τ (4000 °/s, 40 g), more at shorter ones."""


class AllanWindow:
    """Windowed overlapping Allan variance of six axes at many cluster sizes.

    Args:
        length: samples in the full window, MIN_LENGTH … MAX_LENGTH
        factors: cluster sizes m in samples, ascending, 1 ≤ m ≤ length/2

    >>> window = AllanWindow(100, np.array([1, 2]))
    >>> window.update(np.tile([[1.0], [2.0]], (50, 6)))   # 1, 2, 1, 2, … : σ²(1) = 1/2, σ²(2) = 0
    >>> window.avar()[:, 0].tolist()
    [0.5, 0.0]
    """

    def __init__(self, length: int, factors: Ints) -> None:
        if not MIN_LENGTH <= length <= MAX_LENGTH:
            raise ConfigError(f"window of {length} samples; possible are {MIN_LENGTH} to {MAX_LENGTH}")
        if factors.size == 0 or factors[0] < 1 or 2 * factors[-1] > length or (np.diff(factors) <= 0).any():
            raise ConfigError(f"cluster sizes {factors.tolist()} must ascend within 1 and {length // 2}")
        self.length = length
        self.factors = factors.astype(np.int64)
        # |second difference| ≤ 2 m · full scale must stay below 2^63
        bits = 62 - np.ceil(np.log2(2.0 * float(factors[-1]) * np.array(FULL_SCALE)))
        self._scale = np.exp2(np.minimum(bits, 48.0))
        self._phase = np.zeros((length + 1 + RUN) * LANES, np.int64)
        self._missing = np.zeros((length + 1 + RUN) * LANES, np.int32)
        self._terms = np.zeros((factors.size, LANES), np.int64)
        # scale, rounding not yet in phase, then a sum and the rest of its roundings for each τ
        self._sums = np.zeros((2 + 2 * factors.size, LANES))
        # samples since reset, place of the newest phase point, newest sample that was missing on any axis
        self._state = np.zeros(3, np.int64)
        self.reset()

    @property
    def n(self) -> int:
        """Samples in the window now, missing ones included."""
        return min(int(self._state[0]), self.length)

    @property
    def total(self) -> int:
        """Samples since the last reset, missing ones included."""
        return int(self._state[0])

    def reset(self) -> None:
        """Forget all samples."""
        for array in (self._phase, self._missing, self._terms, self._sums):
            array[:] = 0
        self._sums[SCALE] = self._scale
        self._state[:] = (0, 0, -(1 << 62))

    def update(self, values: Floats) -> None:
        """Advance by samples [n, 6], one by one; NaN, and what is beyond any phase (1e7 and more), = missing."""
        # one kind of array only: each layout and access flag would be compiled anew, for seconds
        rows = np.ascontiguousarray(values, np.float64).view()
        if rows.ndim != 2 or rows.shape[1] != AXES:
            raise ValueError(f"samples of shape {rows.shape}; expected is [n, {AXES}]")
        rows.flags.writeable = False
        _advance(rows, self.factors, self._phase, self._missing, self._terms, self._sums, self._state)

    def skip(self, n: int) -> None:
        """Advance by n missing samples; more than the window holds empty it at once."""
        if n > self.length:
            self.reset()
            return
        # in pieces, so that a long outage needs no array of its length
        hole = np.full((min(n, HOLE_ROWS), AXES), np.nan)
        for start in range(0, n, HOLE_ROWS):
            self.update(hole[: n - start])

    def avar(self) -> Floats:
        """Allan variance [m, 6] in unit² of the axis; NaN where no term is complete."""
        sums = (self._sums[SUMS::2] + self._sums[SUMS + 1 :: 2])[:, :AXES]
        m = self.factors[:, None] * self._scale[:AXES]
        terms = self._terms[:, :AXES]
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(terms > 0, np.maximum(sums, 0.0) / (2.0 * m * m * terms), np.nan)

    def terms(self) -> Ints:
        """Number of second differences averaged, [m, 6]."""
        return self._terms[:, :AXES].copy()


@compiled
def _advance(
    values: Floats,
    factors: Ints,
    phase: Ints,
    missing: NDArray[np.int32],
    terms: Ints,
    sums: Floats,
    state: Ints,
) -> None:
    """Advance sample by sample; see the module's head for the arithmetic.

    Phase is written for a run of up to RUN samples, then each τ takes its terms one by one along that run: few
    streams through memory at a time, which the processor fetches ahead, where a walk over all τ would need a hundred.
    """
    places = phase.size // LANES
    length = places - 1 - RUN
    scratch = np.empty((2, RUN * LANES))
    done = 0
    while done < values.shape[0]:
        run = min(RUN, values.shape[0] - done)
        first = state[1] + 1 if state[1] + 1 < places else 0
        for row in range(done, done + run):
            _append(values[row], sums[SCALE], sums[CARRY], phase, missing, state)
        count = state[0] - run  # samples before this run
        whole = count - state[2] > length
        for i in range(factors.size):
            row = max(0, 2 * factors[i] - 1 - count)  # the first whose term is complete
            while row < run:
                # as far as no stream comes to the ring's end, and the window is full throughout or not at all
                now = first + row if first + row < places else first + row - places
                leaving = count + row >= length
                end = run if leaving else min(run, length - count)
                row += _slide(
                    now, end - row, factors[i], length, leaving, whole,
                    phase, missing, scratch, terms, sums, i,
                )  # fmt: skip
        done += run


@compiled
def _append(sample: Floats, scale: Floats, carry: Floats, phase: Ints, missing: NDArray[np.int32], state: Ints) -> None:
    """Write one phase point and the running count of missing samples."""
    before = LANES * state[1]
    now = before + LANES if before + LANES < phase.size else 0
    state[0] += 1
    state[1] = now // LANES
    for lane in range(sample.size):
        y = sample[lane] * scale[lane] + carry[lane]
        if abs(y) < 4.0e18:  # false for NaN too
            step = np.rint(y)
            carry[lane] = y - step
            phase[now + lane] = phase[before + lane] + np.int64(step)
            missing[now + lane] = missing[before + lane]
        else:
            phase[now + lane] = phase[before + lane]
            missing[now + lane] = missing[before + lane] + 1
            state[2] = state[0]


@compiled
def _slide(
    now: int,
    rows: int,
    m: int,
    length: int,
    leaving: bool,
    whole: bool,
    phase: Ints,
    missing: NDArray[np.int32],
    scratch: Floats,
    terms: Ints,
    sums: Floats,
    i: int,
) -> int:
    """Add the terms that end at up to ``rows`` phase points from ``now`` on, evict as many when ``leaving``.

    Returns the rows done: fewer than asked where a stream comes to the end of the ring.
    """
    places = phase.size // LANES
    old = now - length - 1
    new1, new2 = _place(now - m, places), _place(now - 2 * m, places)
    old0, old1, old2 = _place(old + 2 * m, places), _place(old + m, places), _place(old, places)
    run = min(rows, places - max(now, new1, new2, old0, old1, old2))
    if run == 1 and whole and leaving:
        _swap(phase, now, new1, new2, old0, old1, old2, sums, i)
        return 1
    n = run * LANES
    added, evicted = scratch[0], scratch[1]
    _square(phase, now, new1, new2, n, added)
    if leaving:
        _square(phase, old0, old1, old2, n, evicted)
    else:
        evicted[:n] = 0.0
    if not whole:
        _strike(missing, now, new2, 1, n, added, terms[i])
        if leaving:
            _strike(missing, old0, old2, -1, n, evicted, terms[i])
    elif not leaving:
        terms[i] += run
    _exchange(added, evicted, n, sums[SUMS + 2 * i], sums[SUMS + 2 * i + 1], LANES)
    return run


@compiled
def _place(index: int, places: int) -> int:
    """Place in the ring of a phase point less than one turn back."""
    return index if index >= 0 else index + places


@compiled
def _square(phase: Ints, at0: int, at1: int, at2: int, n: int, out: Floats) -> None:
    """Squared second differences of n lanes; flat, so that it runs a vector register at a time."""
    i0, i1, i2 = np.uintp(at0 * LANES), np.uintp(at1 * LANES), np.uintp(at2 * LANES)
    for i in range(np.uintp(n)):
        d = float(phase[i0 + i] - 2 * phase[i1 + i] + phase[i2 + i])
        out[i] = d * d


@compiled
def _strike(missing: NDArray[np.int32], at0: int, at2: int, step: int, n: int, squares: Floats, terms: Ints) -> None:
    """Strike out the terms that touch a missing sample, count the others."""
    for i in range(n):
        if missing[at0 * LANES + i] == missing[at2 * LANES + i]:
            terms[i % LANES] += step
        else:
            squares[i] = 0.0


@compiled
def _exchange(added: Floats, evicted: Floats, n: int, sums: Floats, rest: Floats, lanes: int) -> None:
    """sums + rest += added - evicted, row by row, each rounding kept in rest.

    TwoSum: Knuth, TAOCP vol. 2, 4.2.2, theorem B. ``lanes`` is an argument so that the compiler makes one vector
    loop of it instead of eight scalar lines.
    """
    for row in range(0, n, lanes):
        for lane in range(lanes):
            s = sums[lane]
            t = s + added[row + lane]
            z = t - s
            first = (s - (t - z)) + (added[row + lane] - z)
            u = t - evicted[row + lane]
            z = u - t
            sums[lane] = u
            rest[lane] += first + ((t - (u - z)) - (evicted[row + lane] + z))


@compiled
def _swap(phase: Ints, at0: int, at1: int, at2: int, old0: int, old1: int, old2: int, sums: Floats, i: int) -> None:
    """The same for a single row, where setting up vector loops would cost more than the work."""
    i0, i1, i2 = np.uintp(at0 * LANES), np.uintp(at1 * LANES), np.uintp(at2 * LANES)
    j0, j1, j2 = np.uintp(old0 * LANES), np.uintp(old1 * LANES), np.uintp(old2 * LANES)
    at = SUMS + 2 * i
    for lane in range(np.uintp(LANES)):
        d = float(phase[i0 + lane] - 2 * phase[i1 + lane] + phase[i2 + lane])
        e = float(phase[j0 + lane] - 2 * phase[j1 + lane] + phase[j2 + lane])
        added, evicted = d * d, e * e
        s = sums[at, lane]
        t = s + added
        z = t - s
        first = (s - (t - z)) + (added - z)
        u = t - evicted
        z = u - t
        sums[at, lane] = u
        sums[at + 1, lane] += first + ((t - (u - z)) - (evicted + z))
