"""Has the noise changed, the bias stepped, or a burst of outliers come? At a stated rate of false alarms.

Samples in, ``Change`` out. Each axis is watched in octaves of averaging time, each by its own reference, learned from
the samples since its last change. Possible outcomes: ``noise_changed`` with the letters Q N B K that explain the
variances since the onset, or else the band of frequencies; ``bias_stepped`` with the means on both sides;
``outlier_burst`` with how many and how large. ``change_kernel`` holds the statistics, ``change_size`` the letters.

- **How often it errs.** ``alarms_per_day`` of six axes with unchanging noise, shared by noise (eight tenths), steps
  and bursts. The threshold for noise is h = ln(looks a day · RATE_AT_ZERO / alarms a day); the one constant was
  measured at thresholds of 8 to 12, where alarms are many, and is used at 13 to 20 (``tests/experiments/benchmarks/changes.py``).
- **Learning.** A band may accuse when its reference has LEARN terms and LEARN_S have passed: a minute for the
  shortest octaves, 128 clusters for the longer ones, more where terms are bound together. What changes within that
  time is not seen. A reference is never forgotten while nothing is found: it gets slowly more exact, and a slow drift
  of the noise is set against all the past, so it cannot hide, and is reported at some time, as a change. The price:
  noise that breathes more slowly than was learned is reported too.
- **After a change** the samples since the onset are the new reference; octaves too long to have any learn from nothing.
- **A burst** shows in extremes while the bulk of the differences stays; once over, it is taken out of the reference.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import floor, log, log2, sqrt
from statistics import NormalDist
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.errors import ConfigError
from drivers.sample import AXES, Floats
from monitor.common.rates import amount
from monitor.estimation.detection.change_kernel import (
    AFTER,
    BEFORE,
    CLIP,
    DUE,
    EVIDENCE,
    FOUND,
    KIND,
    LEARN,
    LIMIT,
    NEVER,
    NEXT_DUE,
    SEED,
    SEEDED,
    SINCE,
    START,
    STEP,
    TICK,
    TOTAL,
    UNIT_EXTREME,
    UNIT_INSIDE,
    UNIT_N,
    UNIT_RAW,
    UNIT_S,
    F,
    N,
    S,
    advance,
    make_state,
    set_due,
)
from monitor.estimation.detection.change_size import Octaves, named

LONGEST_S: Final = 300.0
"""The longest clusters; longer ones would learn for days, and show temperature rather than noise."""
LEARN_S: Final = 60.0
"""A line of the width 1/LEARN_S is seen by then for what it is."""
DWELL: Final = 256
"""Samples that a verdict waits for at least."""
LONGEST_DWELL_S: Final = 60.0
LONGEST_BURST_S: Final = 60.0
"""A burst that lasts longer is how the axis is now."""
RATE_AT_ZERO: Final = 0.07
"""Alarms a z², of six ratios, are this times e^−h: 0.053–0.065 measured (``tests/experiments/benchmarks/changes.py``)."""
NOISE_SHARE: Final = 0.8
OTHER_SHARE: Final = 0.1
HOLE_ROWS: Final = 4096
MANY: Final = 4.0
"""Times the clipped variance from which on clipping bends the size, and all squares are taken as they are."""

STEEP: Final = "quantization noise or vibration near Nyquist"
"""Octaves do not tell them apart (``change_size``)."""
NOISE_NAMES: Final = {
    "g": {"Q": STEEP, "N": "angle random walk", "B": "bias instability", "K": "rate random walk"},
    "a": {
        "Q": STEEP,
        "N": "velocity random walk",
        "B": "bias instability",
        "K": "acceleration random walk",
    },
}


@dataclass(frozen=True, slots=True)
class Change:
    """One change of one axis; times are counts of samples since the detector's start."""

    kind: str  # noise_changed, bias_stepped, outlier_burst
    axis: int  # index into AXES
    since: int  # when it began, as estimated
    found: int  # when the alarm was raised; handed out up to a minute later, when it is sized
    sigma: float  # how sure
    what: Mapping[str, tuple[float, float]]  # before, after in SI: letters; or band (Hz, from, to) and rms; bias; count
    text: str

    def sides(self) -> dict[str, dict[str, float]]:
        """``what`` as it leaves the process: ``before`` and ``after``, of a band ``from`` and ``to``."""
        return {
            name: {"from": first, "to": second} if name == "band" else {"before": first, "after": second}
            for name, (first, second) in self.what.items()
        }


class ChangeDetector:
    """Watches six axes for changes of noise and bias.

    Args:
        rate_hz: samples a second, for times of learning and the units of what is found
        alarms_per_day: false alarms to bear, of all axes together
    Raises:
        ConfigError: a rate or a number of alarms that is not positive

    >>> detector = ChangeDetector(100.0)
    >>> noise = 1e-3 * np.random.default_rng(1).standard_normal((30_000, 6))
    >>> noise[20_000:, 2] *= 1.5
    >>> detector.update(noise)
    >>> [(change.kind, AXES[change.axis], list(change.what)) for change in detector.take()]
    [('noise_changed', 'gz', ['N'])]
    """

    def __init__(self, rate_hz: float, alarms_per_day: float = 1.0 / 30.0) -> None:
        if not (0.0 < rate_hz < np.inf and 0.0 < alarms_per_day < np.inf):
            raise ConfigError(f"rate {rate_hz} Hz and {alarms_per_day} alarms a day must be positive")
        self.rate_hz = rate_hz
        self._octaves = min(max(floor(log2(LONGEST_S * rate_hz)), 7), 20) + 1
        self._state = make_state(self._octaves)
        looks = 86_400.0 * rate_hz * len(AXES)  # z² a day, and pairs of blocks a day
        # by the lower tail: 1 - p would be rounded to 1 for p below 1e-16
        once = -NormalDist().inv_cdf(min(0.5 * OTHER_SHARE * alarms_per_day / looks, 0.01))
        self._state.levels[:] = (
            max(log(looks * RATE_AT_ZERO / (NOISE_SHARE * alarms_per_day)), 1.0),
            max(log(looks / TICK / (OTHER_SHARE * alarms_per_day)), 1.0),
            once, DWELL, max(LONGEST_DWELL_S * rate_hz, DWELL), LEARN_S * rate_hz,
        )  # fmt: skip
        self._found: list[Change] = []

    @property
    def samples(self) -> int:
        """Samples since the start, missing ones included."""
        return int(self._state.clock[TOTAL])

    @property
    def watched(self) -> NDArray[np.bool_]:
        """[J, 6]: octaves (clusters of 2^j samples) whose reference is long enough to accuse."""
        band = self._state.band
        known = (band[:, :, N] >= LEARN * band[:, :, F] ** 2) & (band[:, :, S] > 0.0)
        return np.asarray((known & self._old[:, None]).T)

    @property
    def learned(self) -> NDArray[np.bool_]:
        """[6]: axes of which at least the shortest octave is watched."""
        return np.asarray(self.watched[0])

    @property
    def _old(self) -> NDArray[np.bool_]:
        return np.asarray(self.samples - self._state.born >= LEARN_S * self.rate_hz)

    def update(self, values: Floats) -> None:
        """Advance by samples [n, 6] in SI; NaN = missing."""
        rows = np.ascontiguousarray(values, np.float64)
        if rows.ndim != 2 or rows.shape[1] != len(AXES):
            raise ValueError(f"samples of shape {rows.shape}; expected is [n, {len(AXES)}]")
        row = 0
        while row < len(rows):
            row = advance(self._state, rows, row)
            if self._state.clock[TOTAL] >= self._state.clock[NEXT_DUE]:
                for axis in np.flatnonzero(
                    (self._state.alarm[:, KIND] > 0) & (self._state.alarm[:, DUE] <= self.samples)
                ):
                    self._judge(int(axis))
                set_due(self._state)

    def skip(self, n: int) -> None:
        """Advance by n missing samples."""
        hole = np.full((min(n, HOLE_ROWS), len(AXES)), np.nan)
        for start in range(0, n, HOLE_ROWS):
            self.update(hole[: n - start])

    def take(self) -> list[Change]:
        """What was found since the last call, in order."""
        found, self._found = self._found, []
        return found

    def restart(self, axis: int | None = None) -> None:
        """Learn the reference of one axis, or of all, anew."""
        for one in range(len(AXES)) if axis is None else (axis,):
            self._forget(one)
        set_due(self._state)

    def _judge(self, axis: int) -> None:
        """The alarm of one axis has waited its time."""
        s = self._state
        alarm = s.alarm[axis].copy()
        s.alarm[axis] = 0.0
        if alarm[KIND] == STEP:
            self._stepped(axis, alarm)
            return
        after = s.cum[axis] - self._cum_at(int(alarm[START]))[axis]  # [J, 5]
        n, total = s.band[axis, :, N], s.band[axis, :, S]
        before_n, before_s = n - after[:, UNIT_N], total - after[:, UNIT_S]
        if self._bulk_is_the_same(axis, after[0], before_s[0] / before_n[0]):
            self._burst(axis, alarm, after, before_n, before_s)
        else:
            self._noise(axis, alarm, after, before_n, before_s)

    def _cum_at(self, sample: int) -> Floats:
        """Sums [6, J, 5] kept at or soon after a time; ages are known to a quarter."""
        at = self._state.snap_at
        later = np.where(at >= sample, at, NEVER)
        return np.asarray(self._state.snap[np.unravel_index(int(later.argmin()), at.shape)])

    def _bulk_is_the_same(self, axis: int, after: Floats, before: float) -> bool:
        """Outliers raise the mean of z² more than they move its median."""
        n, extremes = after[UNIT_N], after[UNIT_EXTREME]
        if extremes < 3 or not before > 0.0:
            return False
        return bool(self._bulk(axis, after) < 1.0 + 0.5 * (after[UNIT_RAW] / n / before - 1.0))

    def _bulk(self, axis: int, after: Floats) -> float:
        """Variance over reference by the share of small differences, as if Gaussian."""
        whole = self._state.cum[axis, 0] - after
        usual, now = whole[UNIT_INSIDE] / whole[UNIT_N], after[UNIT_INSIDE] / after[UNIT_N]
        if not 0.02 < usual < 0.98 or now >= 1.0:
            return 1.0
        # share p of |z| below a quantile q·σ: q = Φ⁻¹((1 + p)/2)
        quantile = NormalDist().inv_cdf
        return float((quantile(0.5 + 0.5 * usual) / quantile(0.5 + 0.5 * max(now, 1e-3))) ** 2)

    def _noise(self, axis: int, alarm: Floats, after: Floats, before_n: Floats, before_s: Floats) -> None:
        s = self._state
        band = s.band[axis]
        with np.errstate(invalid="ignore", divide="ignore"):
            v0, spread = np.where(before_n > 0, before_s / before_n, 0.0), band[:, F]
            v1 = after[:, UNIT_S] / after[:, UNIT_N]
            if np.nanmax(np.where(v0 > 0, v1 / v0, np.nan)) > MANY:
                v1 = after[:, UNIT_RAW] / after[:, UNIT_N]
            v1 = np.where(after[:, UNIT_N] > 0, v1, 0.0)
        octaves = Octaves(v0, np.maximum(before_n, 0.0) / spread, v1, after[:, UNIT_N] / spread)
        what = named(octaves, self.rate_hz)
        sigma = sqrt(2.0 * max(octaves.evidence(), alarm[EVIDENCE]))
        text = f"{AXES[axis]} {_noise_text(AXES[axis], what)}"
        self._found.append(Change("noise_changed", axis, int(alarm[START]), int(alarm[FOUND]), sigma, what, text))
        self._forget(axis, int(alarm[START]))
        keep = (after[:, UNIT_N] >= SEED) & (v1 > 0.0)
        band[keep, N], band[keep, S] = after[keep, UNIT_N], after[keep, UNIT_N] * v1[keep]
        band[keep, LIMIT], band[keep, SEEDED] = CLIP * v1[keep], SEED

    def _burst(self, axis: int, alarm: Floats, after: Floats, before_n: Floats, before_s: Floats) -> None:
        s = self._state
        now = self.samples
        latest = s.cum[axis, 0, UNIT_EXTREME] - self._cum_at(now - DWELL // 2)[axis, 0, UNIT_EXTREME]
        lasting = now - alarm[START] >= max(LONGEST_BURST_S * self.rate_hz, 2 * DWELL)
        if latest > 0 and not lasting:
            s.alarm[axis] = alarm
            s.alarm[axis, DUE] = now + DWELL  # a multiple of TICK, as all dues
            return
        count, variance = after[0, UNIT_EXTREME], before_s[0] / before_n[0]
        # an outlier a in one sample gives one z² = a²/2
        scale = sqrt(2.0 * max(after[0, UNIT_RAW] - after[0, UNIT_S], 0.0) / max(count, 1.0))
        what = {"count": (0.0, float(count)), "scale": (sqrt(variance), scale)}
        text = f"{AXES[axis]} {count:.0f} outliers of about {amount(AXES[axis], scale)} within " + (
            f"{(now - alarm[START]) / self.rate_hz:.1f} s"
        )
        sigma = sqrt(2.0 * alarm[EVIDENCE])
        self._found.append(Change("outlier_burst", axis, int(alarm[START]), int(alarm[FOUND]), sigma, what, text))
        if lasting:
            self._forget(axis)
            return
        enough = before_n >= SEED
        s.band[axis, enough, N], s.band[axis, enough, S] = before_n[enough], before_s[enough]
        self._doubt(axis)

    def _stepped(self, axis: int, alarm: Floats) -> None:
        before, after = (float(x) for x in self._state.step[axis, [BEFORE, AFTER]])
        text = f"{AXES[axis]} bias stepped by {amount(AXES[axis], after - before, sign=True)}"
        sigma = sqrt(2.0 * alarm[EVIDENCE])
        what = {"bias": (before, after)}
        self._found.append(Change("bias_stepped", axis, int(alarm[START]), int(alarm[FOUND]), sigma, what, text))
        self._doubt(axis)

    def _doubt(self, axis: int) -> None:
        """Suspect nothing of what lies behind; what is half done contains it."""
        s = self._state
        s.cusum[axis] = s.unit[axis] = 0.0
        s.cusum[axis, :, :, SINCE] = self.samples
        s.burst[axis] = 0.0, self.samples
        s.step[axis], s.step[axis, 0] = 0.0, -1.0
        under_way = self.samples % (2 << np.arange(self._octaves)) != 0
        s.fill[axis] = -under_way.astype(np.int64)

    def _forget(self, axis: int, born: int | None = None) -> None:
        """No reference, no suspicion; the cascade of sums goes on."""
        s = self._state
        s.born[axis] = self.samples if born is None else born
        s.band[axis] = s.spread[axis] = 0.0
        s.band[axis, :, F] = 1.0
        s.alarm[axis] = 0.0
        self._doubt(axis)


def _noise_text(axis: str, what: Mapping[str, tuple[float, float]]) -> str:
    """The change in the field's words."""
    names = NOISE_NAMES[axis[0]]
    letters = [f"{names[letter]} {_grew(*what[letter])}" for letter in what if letter in names]
    if letters:
        return ", ".join(letters)
    if "band" not in what:
        return "noise changed"
    low, high = what["band"]
    return f"noise between {low:.2g} and {high:.2g} Hz {_grew(*what['rms'])}"


def _grew(before: float, after: float) -> str:
    if before == 0.0:
        return "appeared"
    if after == 0.0:
        return "vanished"
    percent = 100.0 * (after / before - 1.0)
    digits = 0 if abs(percent) >= 9.5 else 1
    return f"{'rose' if percent > 0 else 'fell'} by {abs(percent):.{digits}f} %"
