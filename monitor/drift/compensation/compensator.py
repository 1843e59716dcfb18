"""Drift taken out of a gyro's rate, sample by sample, while the carrier may move.

One measured rate z = ω + drift + noise, and two things to be known of it. At rest ω is nothing: there, and only there,
the drift is learned, from means over intervals (``sage_husa`` on an ``arma`` model). In motion it is predicted, and
what is left of z is followed by filters that let motion pass (``manoeuvre``). A single filter of both would have to
share out every slow change between them; that rest is known is worth more than any share.

Whether a sample is of rest is known some blocks after it (``estimate.rest``), so what an interval taught holds from the
second block after it on, 0.5 s at most rates. The rate itself comes out at once: with sample k, of samples up to k. It
is the same however the stream is cut. Accelerometers pass as they are; they take part in telling rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from drivers.errors import NotReady
from drivers.sample import AXES, Floats, Ints
from monitor.common.compiled import compiled
from monitor.drift.compensation import sage_husa
from monitor.drift.compensation.arma import ORDERS, Arma, Order, identify
from monitor.drift.compensation.motion_filter_bank import LEAST, coast, follow, gains, learn, memories, shift
from monitor.estimation.detection import motion_kernel
from monitor.estimation.detection.motion_detection import block_size

GYROS: Final = 3
BLOCKS: Final = 4
"""Of ``estimate.rest`` in an interval: 1 s, at rates below 32 Hz longer."""
ENOUGH: Final = 2
"""Of them at rest."""
SLOTS: Final = 4
"""Blocks whose verdict is awaited."""
REMEMBERED: Final = 2048
"""Intervals that a model is identified from."""
FIRST: Final = 60
"""Intervals at rest after which a model is identified; then when there are half as many more, and every so many as are
remembered at the latest."""
LOUD: Final = (0.02,) * 3 + (0.3,) * 3
"""rad/s and m/s²: rms about the mean of a block that is no rest for certain, whatever the sensor has got used to: a car
that drives all day. Nothing is learned then, and rates come out nearly as they came in."""
LARGEST: Final = 0.35
"""rad/s, 20 °/s: no gyro's mean at rest is beyond."""
LONGEST_GAP: Final = 100_000
"""Intervals predicted over: after more nothing is known any more in any case."""

NUMBER, COUNT, ORIGIN, SUM, SQUARES = range(5)
"""Columns of ``waiting``: number of the block, samples, what sums are about, sums."""
MEAN, EXPECTED, ERROR, BECAME, DRIFT_ERROR, SCATTER = range(6)
"""Columns of what an interval taught: its mean (NaN = not at rest), what was expected, the deviation of that difference
that was expected, what became of it, the standard error of what was expected, and the variance of the mean by the
scatter within."""


class State(NamedTuple):
    """All that is remembered; arrays only."""

    rest: motion_kernel.State
    current: Ints  # [1] interval being filled; -1 = none yet
    learned: Ints  # [3] intervals at rest that filters learned from
    row: Floats  # [3 axes, …] of sage_husa
    bias: Floats  # [3] that is taken out now; NaN = not known yet
    bank: Floats  # [3, filters + 1, 5]
    ages: Ints  # [3, filters, 2]
    feedback: Floats  # [3, 1]
    waiting: Floats  # [SLOTS, 6, 5] blocks without a verdict
    sums: Floats  # [SLOTS, 3, filters + 1, 2] of ``follow``, for each
    means: Floats  # [3, BLOCKS] of blocks at rest in the interval; NaN = not at rest
    followed: Floats  # [3, filters + 1, 2] sums of those blocks
    samples: Floats  # [3] how many they are of
    table: Floats  # gains
    first: Ints
    verdicts: Ints  # [3, 4] scratch: blocks, whether they move; episodes are not used
    episodes: Floats


@dataclass(frozen=True, slots=True)
class Interval:
    """What an interval taught of the drift of three gyro axes, rad/s."""

    end: int  # index of the sample after its last, missing ones counted
    mean: Floats  # [3] measured at rest; NaN = in motion
    expected: Floats  # [3]
    error: Floats  # [3] standard deviation that mean less expected should have
    became: Ints  # [3] NOT_SEEN, USED, LEFT_OUT, STEPPED of sage_husa
    known: Floats  # [3] standard error of what was expected

    @property
    def innovation(self) -> Floats:
        """[3] mean less expected in standard deviations."""
        return (self.mean - self.expected) / self.error


class Compensator:
    """Three gyro axes of one sensor.

    Args:
        rate_hz: samples a second
        adapts: noise of the drift is estimated as time goes on; else as it was identified
        orders: ARMA orders to choose among

    >>> one = Compensator(100.0)
    >>> still = np.random.default_rng(0).normal(0.0, 1e-3, (3000, 6)) + 0.02
    >>> out = np.concatenate([one.update(still[k : k + 50]) for k in range(0, 3000, 50)])
    >>> bool(out[1000:, :3].std() < 2e-4), bool(np.array_equal(out[:, 3:], still[:, 3:]))
    (True, True)
    """

    def __init__(self, rate_hz: float, adapts: bool = True, orders: Sequence[Order] = ORDERS) -> None:
        self.rate_hz = rate_hz
        self.size = block_size(rate_hz)
        self.models: list[Arma | None] = [None] * GYROS
        self._orders = tuple(orders)
        self._state = _state(rate_hz, adapts)
        self.came = 0  # samples, missing ones included
        self._means = np.full((GYROS, REMEMBERED), np.nan)  # a ring of intervals
        self._scatter = np.full((GYROS, REMEMBERED), np.nan)
        self._kept = 0
        self._at_rest = np.zeros(GYROS, np.int64)
        self._due = np.full(GYROS, FIRST)
        self._taught: list[Interval] = []

    @property
    def interval(self) -> int:
        """Samples of a mean that the drift is learned from."""
        return BLOCKS * self.size

    @property
    def interval_s(self) -> float:
        """The same in seconds."""
        return self.interval / self.rate_hz

    @property
    def bias(self) -> Floats:
        """[3] rad/s that is taken out now; NaN = not known yet."""
        return self._state.bias.copy()

    @property
    def error(self) -> Floats:
        """[3] standard error of that."""
        known = [sage_husa.drift(row)[1] ** 0.5 for row in self._state.row]
        return np.where(np.isnan(self._state.bias), np.nan, known)

    def update(self, values: Floats, lost: int = 0) -> Floats:
        """Consecutive samples [n, 6] in SI, NaN = missing, ``lost`` more before them; the same, drift taken out.

        Until a bias is known, and where a sample is missing, a gyro's rate comes out as it came in.
        """
        if lost:
            for axis in range(GYROS):
                coast(self._state.bank[axis], self._state.ages[axis], lost)
            self.came += lost
        out = np.array(values, dtype=np.float64, order="C")
        # always contiguous and read-only, as each layout and access flag would be compiled anew
        values = np.ascontiguousarray(values, np.float64).view()
        values.flags.writeable = False
        # after a hole, verdicts on all blocks that waited come at once, and each may end an interval
        taught = np.empty((len(values) // self.interval + 2 + SLOTS, 1 + 6 * GYROS))
        filled = _advance(values, self.came, self.size, self._state, out, taught)
        self.came += len(values)
        for k in range(filled):
            self._learn(taught[k])
        return out

    def take(self) -> list[Interval]:
        """What the intervals since the last call taught."""
        taught, self._taught = self._taught, []
        return taught

    # --- identification

    @property
    def ahead(self) -> int:
        """Samples to the end of the interval: where models change there, they change at the same samples however the
        stream is cut."""
        return self.interval - self.came % self.interval

    @property
    def due(self) -> tuple[int, ...]:
        """Axes of which there is enough new to identify a model."""
        return tuple(np.flatnonzero(self._at_rest >= self._due).tolist())

    def window(self, axis: int) -> tuple[Floats, float]:
        """Means that a model of an axis is to be identified from, oldest first, and their white noise's variance."""
        z, scatter = self._remembered(axis)
        white = float(np.nanmean(scatter)) if np.isfinite(scatter).any() else 0.0
        return z, white

    def adopt(self, axis: int, model: Arma | None) -> None:
        """Take a model over, and go through what is remembered again with it; None: none was found, ask later."""
        self._due[axis] = self._at_rest[axis] + min(max(self._at_rest[axis], FIRST) // 2, REMEMBERED)
        if model is None:
            return
        self.models[axis] = model
        row = self._state.row[axis]
        count = row[sage_husa.COUNT]
        sage_husa.adopt(row, model)
        sage_husa.again(row, *self._remembered(axis), _least(self._state.rest.open, axis))
        row[sage_husa.COUNT] = count  # each interval once
        _renew(axis, self._state.row, self._state.bias, self._state.bank)

    def identify(self) -> None:
        """Models of all axes that are due."""
        for axis in self.due:
            try:
                self.adopt(axis, identify(*self.window(axis), self._orders))
            except NotReady:  # all the same, or far too few: asked again later
                self.adopt(axis, None)

    # --- inside

    def _remembered(self, axis: int) -> tuple[Floats, Floats]:
        count = min(self._kept, REMEMBERED)
        order = np.arange(self._kept - count, self._kept) % REMEMBERED
        return self._means[axis][order], self._scatter[axis][order]

    def _learn(self, taught: Floats) -> None:
        columns = taught[1:].reshape(GYROS, 6)
        at = self._kept % REMEMBERED
        became = columns[:, BECAME]
        self._means[became == sage_husa.STEPPED] = np.nan  # what was before belongs to another level
        used = (became == sage_husa.USED) | (became == sage_husa.STEPPED)
        self._means[:, at] = np.where(used, columns[:, MEAN], np.nan)
        self._scatter[:, at] = np.where(used, columns[:, SCATTER], np.nan)
        self._kept += 1
        self._at_rest += used
        self._taught.append(
            Interval(
                int(taught[0] + 1) * self.interval,
                columns[:, MEAN].copy(),
                columns[:, EXPECTED].copy(),
                columns[:, ERROR].copy(),
                columns[:, BECAME].astype(np.int64),
                columns[:, DRIFT_ERROR].copy(),
            )
        )


def _state(rate_hz: float, adapts: bool) -> State:
    each = memories(rate_hz)
    table, first = gains(each)
    filters = each.size
    return State(
        rest=motion_kernel.state(),
        current=np.full(1, -1, np.int64),
        learned=np.zeros(GYROS, np.int64),
        row=np.stack([sage_husa.unknown(adapts)] * GYROS),
        bias=np.full(GYROS, np.nan),
        bank=np.zeros((GYROS, filters + 1, 5)),
        ages=np.zeros((GYROS, filters, 2), np.int64),
        feedback=np.zeros((GYROS, 1)),
        waiting=np.full((SLOTS, len(AXES), 5), -1.0),
        sums=np.zeros((SLOTS, GYROS, filters + 1, 2)),
        means=np.full((GYROS, BLOCKS), np.nan),
        followed=np.zeros((GYROS, filters + 1, 2)),
        samples=np.zeros(GYROS),
        table=table,
        first=first,
        verdicts=np.zeros((2, SLOTS), np.int64),
        episodes=np.zeros((SLOTS, 5)),
    )


@compiled
def _advance(values, index, size, s, out, taught):  # type: ignore[no-untyped-def]
    """Consecutive rows; what intervals taught is filled in. Returns how many did."""
    keep = 0.5 / (2 << (s.ages.shape[1] - 1))
    filled, i, n = 0, 0, values.shape[0]
    while i < n:
        number = (index + i) // size
        end = min(n, (number + 1) * size - index)
        verdicts = motion_kernel.advance(
            values[i:end], index + i, size, False, s.rest, s.verdicts[0], s.verdicts[1], s.episodes
        )
        for v in range(verdicts[0]):
            filled += _judged(s.verdicts[0, v], s.verdicts[1, v] > 0, s, taught[filled])
        slot = number % SLOTS
        if s.waiting[slot, 0, NUMBER] != number:
            _begin_block(number, s.waiting[slot], s.sums[slot])
        for a in range(GYROS):
            _take_out(values[i:end, a], a, s.sums[slot, a], s, keep, out[i:end, a])
        for a in range(len(AXES)):
            _add(values[i:end, a], s.waiting[slot, a])
        i = end
    return filled


@compiled
def _begin_block(number, waiting, sums):  # type: ignore[no-untyped-def]
    """A slot is for another block now."""
    for a in range(len(AXES)):
        waiting[a, NUMBER] = number
        for column in range(COUNT, SQUARES + 1):
            waiting[a, column] = 0.0
    for a in range(GYROS):
        for j in range(sums.shape[1]):
            sums[a, j, 0] = sums[a, j, 1] = 0.0


@compiled
def _take_out(z, axis, sums, s, keep, out):  # type: ignore[no-untyped-def]
    """Samples of one gyro axis without its drift; NaN = missing."""
    bank, ages, feedback = s.bank[axis], s.ages[axis], s.feedback[axis]
    bias = s.bias[axis] if s.bias[axis] == s.bias[axis] else 0.0
    trusted = s.learned[axis] >= LEAST
    for k in range(z.size):
        if z[k] != z[k]:
            coast(bank, ages, 1)
            out[k] = z[k]
            continue
        rate = follow(z[k] - bias, bank, ages, s.table, s.first, sums, feedback, keep)
        if not trusted:
            rate, feedback[0] = z[k] - bias, 0.0
        out[k] = rate


@compiled
def _add(values, sums):  # type: ignore[no-untyped-def]
    """To the sums of a block; NaN = missing."""
    for k in range(values.size):
        if values[k] != values[k]:
            continue
        if sums[COUNT] == 0.0:
            sums[ORIGIN] = values[k]
        off = values[k] - sums[ORIGIN]
        sums[COUNT] += 1.0
        sums[SUM] += off
        sums[SQUARES] += off * off


@compiled
def _judged(number, moves, s, taught):  # type: ignore[no-untyped-def]
    """A verdict has become final: the interval learns from the block; one that is over is told. Returns whether."""
    interval = number // BLOCKS
    over = s.current[0] >= 0 and interval > s.current[0]
    if over:
        _over(s, taught)
        for _ in range(min(interval - s.current[0] - 1, LONGEST_GAP)):
            for a in range(GYROS):
                _forward(a, s)
    s.current[0] = interval
    slot = number % SLOTS
    if moves or s.waiting[slot, 0, NUMBER] != number or _loud(s.waiting[slot]):
        return over
    for a in range(GYROS):
        count = s.waiting[slot, a, COUNT]
        if count > 0.0:
            s.means[a, number % BLOCKS] = s.waiting[slot, a, ORIGIN] + s.waiting[slot, a, SUM] / count
            s.samples[a] += count
            for j in range(s.followed.shape[1]):
                s.followed[a, j, 0] += s.sums[slot, a, j, 0]
                s.followed[a, j, 1] += s.sums[slot, a, j, 1]
    return over


@compiled
def _loud(waiting):  # type: ignore[no-untyped-def]
    """Whether a block is no rest for certain."""
    for a in range(len(AXES)):
        n = waiting[a, COUNT]
        if n == 0.0:
            continue
        mean = waiting[a, SUM] / n
        if waiting[a, SQUARES] / n - mean * mean > LOUD[a] ** 2:
            return True
        if a < GYROS and abs(waiting[a, ORIGIN] + mean) > LARGEST:
            return True
    return False


@compiled
def _over(s, taught):  # type: ignore[no-untyped-def]
    """The interval is over: drift and filters learn from it, and the drift is predicted for the next."""
    taught[0] = s.current[0]
    for a in range(GYROS):
        told = taught[1 + 6 * a : 7 + 6 * a]
        known = s.bias[a] == s.bias[a]
        for column in range(6):
            told[column] = np.nan
        told[EXPECTED], told[BECAME] = s.bias[a], sage_husa.NOT_SEEN
        if known:
            told[DRIFT_ERROR] = np.sqrt(sage_husa.drift(s.row[a])[1])
        count, mean, scatter = _mean(s.means[a])
        if count >= ENOUGH:
            variance, became = sage_husa.measure(s.row[a], mean, scatter, _least(s.rest.open, a))
            told[MEAN], told[ERROR], told[BECAME], told[SCATTER] = mean, np.sqrt(variance), became, scatter
            if known and became == sage_husa.USED:
                s.learned[a] += 1
                learn(s.bank[a], s.followed[a], s.samples[a], s.learned[a])
        else:
            sage_husa.not_seen(s.row[a])
        _forward(a, s)
        for b in range(BLOCKS):
            s.means[a, b] = np.nan
        for j in range(s.followed.shape[1]):
            s.followed[a, j, 0] = s.followed[a, j, 1] = 0.0
        s.samples[a] = 0.0


@compiled
def _mean(means):  # type: ignore[no-untyped-def]
    """Blocks at rest of an interval, their mean, and the variance that half differences of neighbours give it."""
    count, total, apart, pairs = 0, 0.0, 0.0, 0
    for b in range(BLOCKS):
        if means[b] == means[b]:
            count, total = count + 1, total + means[b]
            if b and means[b - 1] == means[b - 1]:
                apart, pairs = apart + (means[b] - means[b - 1]) ** 2, pairs + 1
    return count, total / count if count else np.nan, 0.5 * apart / pairs / count if pairs else np.nan


@compiled
def _least(blocks, axis):  # type: ignore[no-untyped-def]
    """Variance of an interval's mean that rounding may hide; ``blocks`` is ``rest_kernel.State.open``."""
    return blocks[axis, motion_kernel.STEP] ** 2 / 12.0 / BLOCKS + motion_kernel.NOTHING


@compiled
def _forward(axis, s):  # type: ignore[no-untyped-def]
    """To the next interval, once a level is confirmed."""
    if s.row[axis, sage_husa.COUNT] >= sage_husa.CONFIRMED:
        sage_husa.forward(s.row[axis])
        _renew(axis, s.row, s.bias, s.bank)


@compiled
def _renew(axis, rows, biases, banks):  # type: ignore[no-untyped-def]
    """What is expected of the drift is what is taken out from now on; what filters follow moves with it."""
    now = sage_husa.drift(rows[axis])[0]
    before = biases[axis] if biases[axis] == biases[axis] else 0.0
    shift(banks[axis], now - before)
    biases[axis] = now
