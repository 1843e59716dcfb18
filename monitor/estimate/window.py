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

The rounding is white phase noise of variance 2^-2s/12 and changes σ²(m) by about 2·2^-s/(σ √L) of itself at every m,
σ being the noise of a sample: for an hour at 100 Hz (s = 38, 36) and σ = 1e-4, 1e-10.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.errors import ConfigError
from drivers.sample import Floats, Ints
from monitor.compiled import compiled

MIN_LENGTH: Final = 100
"""Samples; a shorter window holds no Allan curve worth a name."""
MAX_LENGTH: Final = 10_000_000
"""Samples; 64 bytes each are kept, 96 once any has been missing."""
AXES: Final = 6
LANES: Final = 8
"""Columns kept a sample: six axes padded to a vector register."""
HOLE_ROWS: Final = 4096
TOTAL, NEWEST, STRUCK, WIDTH = 0, 1, 2, 3
"""Of the state: samples since reset, place of the newest phase point, newest sample that was missing on any axis;
and LANES, from where the compiler cannot know it: it would make eight scalar lines of a vector loop."""
RUN: Final = 64
"""Samples whose phase is written before the τ take their terms."""
STAGE: Final = 512
"""Samples handed to the kernel at a time."""
LINE: Final = 8
"""Numbers of eight bytes in a cache line: a row of phase fills one, and must not lie across two."""
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
        self._taus = int(factors.size)
        # |second difference| ≤ 2 m · full scale must stay below 2^63
        bits = 62 - np.ceil(np.log2(2.0 * float(factors[-1]) * np.array(FULL_SCALE)))
        self._scale = np.exp2(np.minimum(bits, 48.0))
        # few arrays for all, as the interpreter takes 50 ns to hand one to the kernel; see _cut_ints, _cut_floats
        taus, places = self._taus, length + 1 + RUN
        self._ints = _aligned(LANES + -(-taus // LINE) * LINE + taus * LANES + places * LANES, np.int64)
        self._floats = _aligned((2 + 2 * RUN + 2 * taus + STAGE) * LANES, np.float64)
        self._missing = np.zeros(places * LANES, np.int32)
        self._state, _, terms, self._phase = _cut_ints(self._ints, taus)
        self._scaling, _, sums, rest, stage = _cut_floats(self._floats, taus)
        self._terms = terms.reshape(taus, LANES)
        self._sums, self._rest = sums.reshape(taus, LANES), rest.reshape(taus, LANES)
        self._stage = stage[: STAGE * AXES].reshape(STAGE, AXES)
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
        self._terms[:] = 0
        self._floats[:] = 0
        _cut_ints(self._ints, self._taus)[1][:] = self.factors
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
        # copied: each layout and access flag of an array would be compiled anew, for seconds
        self._stage[:n] = rows
        _advance(self._ints, self._floats, self._missing, self._taus, n)

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
        sums = (self._sums + self._rest)[:, :AXES]
        m = self.factors[:, None] * self._scale[:AXES]
        terms = self._terms[:, :AXES]
        # a constant axis shows second differences of up to one unit, the rounding of its phase: no noise at all
        sums = np.where(sums <= terms, 0.0, sums)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(terms > 0, sums / (2.0 * m * m * terms), np.nan)

    def slope(self) -> Floats:
        """Slope of the rate over the window [6], unit of the axis a sample; NaN where a sample is missing.

        Mean of the last third less that of the first, over two thirds of the window (``fit.slope_of_thirds``).
        """
        third = self.n // 3
        if third == 0:
            return np.full(AXES, np.nan)
        places = self._phase.size // LANES
        at = (int(self._state[NEWEST]) - third * np.arange(4)) % places * LANES
        phase = self._phase[at[:, None] + np.arange(AXES)]
        bent = (phase[0] - phase[1] - phase[2] + phase[3]) / self._scale[:AXES]
        missing = self._missing[at[:, None] + np.arange(AXES)]
        return np.where(missing[0] == missing[3], bent / (2.0 * third * third), np.nan)

    def terms(self) -> Ints:
        """Number of second differences averaged, [m, 6]."""
        return self._terms[:, :AXES].copy()


def _aligned(size: int, dtype: type[np.generic]) -> NDArray[Any]:
    """So many zeros that begin with a cache line."""
    space = np.zeros(size + LINE, dtype)
    start = -(space.ctypes.data // space.itemsize) % LINE
    return space[start : start + size]


@compiled
def _cut_ints(ints: Ints, taus: int) -> tuple[Ints, Ints, Ints, Ints]:
    """State, factors [m], terms [m · LANES], phase [places · LANES]."""
    terms = LANES + (taus + LINE - 1) // LINE * LINE
    phase = terms + taus * LANES
    return ints[:LANES], ints[LANES : LANES + taus], ints[terms:phase], ints[phase:]


@compiled
def _cut_floats(floats: Floats, taus: int) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Parts of the workspace.

    Scale and rounding not yet in phase [2 · LANES], two scratches for a run, sums and what their roundings left
    [m · LANES], and the stage [STAGE · AXES and more].
    """
    scratch, sums = 2 * LANES, (2 + 2 * RUN) * LANES
    rest, stage = sums + taus * LANES, sums + 2 * taus * LANES
    return floats[:scratch], floats[scratch:sums], floats[sums:rest], floats[rest:stage], floats[stage:]


@compiled
def _advance(ints: Ints, floats: Floats, missing: NDArray[np.int32], taus: int, n: int) -> None:
    """Advance by the first n staged samples; see the module's head for the arithmetic.

    Phase is written for a run of up to RUN samples, then each τ takes its terms one by one along that run: few
    streams through memory at a time, which the processor fetches ahead, where a walk over all τ would need a hundred.
    """
    state, factors, terms, phase = _cut_ints(ints, taus)
    scaling, scratch, sums, rest, stage = _cut_floats(floats, taus)
    places = phase.size // LANES
    length = places - 1 - RUN
    done = 0
    while done < n:
        run = min(RUN, n - done)
        first = state[NEWEST] + 1 if state[NEWEST] + 1 < places else 0
        for row in range(done, done + run):
            _append(stage[row * AXES : (row + 1) * AXES], scaling, phase, missing, state)
        done += run
        count = state[TOTAL] - run  # samples before this run
        whole = count - state[STRUCK] > length
        if run == 1 and whole and count >= length and taus <= RUN:
            _swap(first, factors, length, phase, scratch, sums, rest)
            continue
        for i in range(taus):
            row = max(0, 2 * factors[i] - 1 - count)  # the first whose term is complete
            own = slice(i * LANES, (i + 1) * LANES)
            while row < run:
                # as far as no stream comes to the ring's end, and the window is full throughout or not at all
                now = first + row if first + row < places else first + row - places
                leaving = count + row >= length
                end = run if leaving else min(run, length - count)
                row += _slide(
                    now, end - row, factors[i], length, leaving, whole,
                    phase, missing, scratch, terms[own], sums[own], rest[own], state[WIDTH],
                )  # fmt: skip


@compiled
def _append(sample: Floats, scaling: Floats, phase: Ints, missing: NDArray[np.int32], state: Ints) -> None:
    """Write one phase point and the running count of missing samples."""
    before = LANES * state[NEWEST]
    now = before + LANES if before + LANES < phase.size else 0
    state[TOTAL] += 1
    state[NEWEST] = now // LANES
    for lane in range(sample.size):
        y = sample[lane] * scaling[lane] + scaling[LANES + lane]
        if abs(y) < 4.0e18:  # false for NaN too
            step = np.rint(y)
            scaling[LANES + lane] = y - step
            phase[now + lane] = phase[before + lane] + np.int64(step)
            count = missing[before + lane]
        else:
            phase[now + lane] = phase[before + lane]
            count = missing[before + lane] + 1
            state[STRUCK] = state[TOTAL]
        if missing[now + lane] != count:  # not written while it stays 0, so that the system need not give the memory
            missing[now + lane] = count


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
    rest: Floats,
    lanes: int,
) -> int:
    """Add the terms that end at up to ``rows`` phase points from ``now`` on, evict as many when ``leaving``.

    Returns the rows done: fewer than asked where a stream comes to the end of the ring.
    """
    places = phase.size // LANES
    old = now - length - 1
    new1, new2 = _place(now - m, places), _place(now - 2 * m, places)
    old0, old1, old2 = _place(old + 2 * m, places), _place(old + m, places), _place(old, places)
    run = min(rows, places - max(now, new1, new2, old0, old1, old2))
    n = run * LANES
    added, evicted = scratch[: RUN * LANES], scratch[RUN * LANES :]
    _square(phase, now, new1, new2, n, added)
    if leaving:
        _square(phase, old0, old1, old2, n, evicted)
    else:
        evicted[:n] = 0.0
    if not whole:
        _strike(missing, now, new2, 1, n, added, terms)
        if leaving:
            _strike(missing, old0, old2, -1, n, evicted, terms)
    elif not leaving:
        terms += run
    _exchange(added, evicted, n, sums, rest, lanes)
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

    TwoSum: Knuth, TAOCP vol. 2, 4.2.2, theorem B. An index that could be negative, or a known number of
    ``lanes``, would make scalar lines of the inner loop: three times the cost.
    """
    for row in range(np.uintp(0), np.uintp(n), np.uintp(lanes)):
        for lane in range(np.uintp(lanes)):
            s = sums[lane]
            t = s + added[row + lane]
            z = t - s
            first = (s - (t - z)) + (added[row + lane] - z)
            u = t - evicted[row + lane]
            z = u - t
            sums[lane] = u
            rest[lane] += first + ((t - (u - z)) - (evicted[row + lane] + z))


@compiled
def _swap(now: int, factors: Ints, length: int, phase: Ints, scratch: Floats, sums: Floats, rest: Floats) -> None:
    """The same for a single sample of a full window without gaps: all τ in one go.

    Setting up vector loops for each τ would cost more than the work; so the differences are gathered one by one, and
    one loop exchanges them all.
    """
    places = phase.size // LANES
    added, evicted = scratch[: RUN * LANES], scratch[RUN * LANES :]
    old = now - length - 1
    at0, old2 = np.uintp(now * LANES), np.uintp(_place(old, places) * LANES)
    for i in range(factors.size):
        m = factors[i]
        at1, at2 = np.uintp(_place(now - m, places) * LANES), np.uintp(_place(now - 2 * m, places) * LANES)
        old0, old1 = np.uintp(_place(old + 2 * m, places) * LANES), np.uintp(_place(old + m, places) * LANES)
        out = np.uintp(i * LANES)
        for lane in range(np.uintp(AXES)):
            d = float(phase[at0 + lane] - 2 * phase[at1 + lane] + phase[at2 + lane])
            e = float(phase[old0 + lane] - 2 * phase[old1 + lane] + phase[old2 + lane])
            added[out + lane] = d * d
            evicted[out + lane] = e * e
    n = factors.size * LANES
    _exchange(added, evicted, n, sums, rest, n)
