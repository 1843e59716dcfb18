"""Detector of noise changes, bias steps and bursts of outliers, with a specified rate of false alarms.

Each axis is monitored in octaves of averaging time. Each octave has a reference variance, learned from the samples
since the last change. The detector returns a ``Change`` of one of three kinds.

- ``noise_changed`` contains the changed coefficients Q N B K, or a frequency band if no coefficient explains the
  change.
- ``bias_stepped`` contains the means before and after the step.
- ``outlier_burst`` contains the number and the size of the outliers.

``change_kernel`` computes the statistics, and ``changed_coefficients`` identifies the coefficients.

- **False alarms.** Of the false alarms on six axes with constant noise, eight tenths are allowed for noise changes, one
  tenth for steps and one tenth for bursts. The threshold for noise changes is h = ln(tests per day · RATE_AT_ZERO /
  alarms per day). ``RATE_AT_ZERO`` was measured at thresholds of 8 to 12, where alarms are frequent. It is extrapolated
  to the thresholds in use, which are 13 to 20 (``tests/experiments/benchmarks/changes.py``).
- **Learning.** An octave can raise an alarm when the reference has ``MIN_REFERENCE_TERMS`` terms and is at least
  ``LEARN_S`` old. The shortest octaves need a minute for this, and the longer octaves need the time of 128 clusters.
  Correlated terms need more time. A change during the learning time is not detected. Without a change, the reference is
  never discarded and becomes more accurate. A slow drift of the noise is eventually reported as a change, because new
  samples are compared with all earlier samples. Fluctuations of the noise that are slower than the learning time are
  reported as well.
- **After a change**, the samples since the onset are the new reference. Octaves that are too long for these
  samples start without a reference.
- **A burst** of outliers raises the share of extreme differences and does not change the median. After the end of a
  burst, the samples of the burst are removed from the reference.

``analyze`` and the live service share this detector. ``reconcile`` tests steps of the level and of the noise by the
likelihood ratio of the fitted model of the axis (``diagnostics.compute_level_step_gains``,
``poisson_steps_vs_single_steps``, ``variance_history``). The gain of a step must be comparable with the gains of all
other effects.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import floor, log, log2, sqrt
from statistics import NormalDist
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import AXES, Floats
from drivers.errors import ConfigError
from drivers.number_ranges import DAY_S
from monitor.common.units import format_rate
from monitor.estimation.detection.change_kernel import (
    AFTER,
    BEFORE,
    CLIP,
    DUE,
    EVIDENCE,
    FOUND,
    KIND,
    LIMIT,
    MIN_REFERENCE_TERMS,
    NEVER,
    NEXT_DUE,
    SEED,
    SEEDED,
    SINCE,
    START,
    STEP,
    TICK_SAMPLES,
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
from monitor.estimation.detection.changed_coefficients import HaarVariancesBeforeAfter, identify_noise_change

MAX_CLUSTER_S: Final = 300.0
"""Longest cluster in seconds.

Longer clusters would need days of learning and respond to temperature rather than noise.
"""
LEARN_S: Final = 60.0
"""Minimum learning time in seconds. Spectral lines of width 1/``LEARN_S`` are resolved in this time."""
MIN_DWELL_SAMPLES: Final = 256
"""Minimum number of samples between an alarm and its decision."""
MAX_DWELL_S: Final = 60.0
"""Maximum time between an alarm and its decision, in seconds."""
MAX_BURST_S: Final = 60.0
"""Maximum duration of a burst in seconds. After a longer burst, a new reference is learned."""
RATE_AT_ZERO: Final = 0.07
"""Number of alarms per tested z² and per e^−h, for all six variance ratios together.

Measured values are 0.053–0.065 (``tests/experiments/benchmarks/changes.py``).
"""
NOISE_SHARE: Final = 0.8
"""Share of the false alarms for noise changes."""
OTHER_SHARE: Final = 0.1
"""Share of the false alarms for steps. The share for bursts is the same."""
SKIP_BLOCK_ROWS: Final = 4096
"""Largest number of missing samples processed in one call."""
MAX_CLIPPED_RATIO: Final = 4.0
"""Ratio of the clipped variances above which clipping would bias the size of a change.

Above it, squares are not clipped.
"""

Q_OR_VIBRATION: Final = "quantization noise or vibration near Nyquist"
"""Name of a change of Q. The two causes cannot be distinguished, see ``changed_coefficients``."""
NOISE_NAMES: Final = {
    "g": {"Q": Q_OR_VIBRATION, "N": "angle random walk", "B": "bias instability", "K": "rate random walk"},
    "a": {
        "Q": Q_OR_VIBRATION,
        "N": "velocity random walk",
        "B": "bias instability",
        "K": "acceleration random walk",
    },
}
"""Names of the coefficients of gyroscopes (g) and accelerometers (a)."""


@dataclass(frozen=True, slots=True)
class Change:
    """Change of one axis. Times are numbers of samples since the start of the detector."""

    kind: str  # noise_changed, bias_stepped, outlier_burst
    axis: int  # index into AXES
    since: int  # estimated onset
    found: int  # sample of the alarm; the change is returned up to a minute later, when the size has been estimated
    sigma: float  # significance in standard deviations
    what: Mapping[
        str, tuple[float, float]
    ]  # values before and after in SI: coefficients, band (from, to in Hz) and rms, …
    text: str  # description for users

    def sides(self) -> dict[str, dict[str, float]]:
        """Return ``what`` with the keys ``before`` and ``after``, or ``from`` and ``to`` for a band."""
        return {
            name: {"from": first, "to": second} if name == "band" else {"before": first, "after": second}
            for name, (first, second) in self.what.items()
        }


class ChangeDetector:
    """Detector of changes of noise and bias on six axes.

    Parameters
    ----------
    rate_hz : float
        Sample rate in Hz, which determines the learning times and the units of the results.
    alarms_per_day : float
        Accepted false alarms per day, of all axes together.

    Raises
    ------
    ConfigError
        If the rate or the number of alarms is not positive.

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
        self._octaves = min(max(floor(log2(MAX_CLUSTER_S * rate_hz)), 7), 20) + 1
        self._state = make_state(self._octaves)
        looks = DAY_S * rate_hz * len(AXES)  # z² per day, which is also the number of pairs of blocks per day
        # The lower tail is used, because 1 - p would be rounded to 1 for p below 1e-16.
        once = -NormalDist().inv_cdf(min(0.5 * OTHER_SHARE * alarms_per_day / looks, 0.01))
        self._state.levels[:] = (
            max(log(looks * RATE_AT_ZERO / (NOISE_SHARE * alarms_per_day)), 1.0),
            max(log(looks / TICK_SAMPLES / (OTHER_SHARE * alarms_per_day)), 1.0),
            once, MIN_DWELL_SAMPLES, max(MAX_DWELL_S * rate_hz, MIN_DWELL_SAMPLES), LEARN_S * rate_hz,
        )  # fmt: skip
        self._found: list[Change] = []

    @property
    def samples(self) -> int:
        """Number of samples since the start, including missing ones."""
        return int(self._state.clock[TOTAL])

    @property
    def watched_octaves(self) -> NDArray[np.bool_]:
        """True for octaves [J, 6] (clusters of 2^j samples) whose reference is long enough for an alarm."""
        band = self._state.band
        known = (band[:, :, N] >= MIN_REFERENCE_TERMS * band[:, :, F] ** 2) & (band[:, :, S] > 0.0)
        old_enough = self.samples - self._state.born >= LEARN_S * self.rate_hz
        return np.asarray((known & old_enough[:, None]).T)

    def update(self, values: Floats) -> None:
        """Process samples.

        Parameters
        ----------
        values : ndarray of float, shape (n, 6)
            Samples in rad/s and m/s²; NaN means missing.

        Raises
        ------
        ValueError
            If the shape is not (n, 6).
        """
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
                    self._decide(int(axis))
                set_due(self._state)

    def skip(self, n: int) -> None:
        """Process n missing samples."""
        hole = np.full((min(n, SKIP_BLOCK_ROWS), len(AXES)), np.nan)
        for start in range(0, n, SKIP_BLOCK_ROWS):
            self.update(hole[: n - start])

    def take(self) -> list[Change]:
        """Return the changes found since the last call, in the order of detection."""
        found, self._found = self._found, []
        return found

    def restart(self, axis: int | None = None) -> None:
        """Start a new reference of one axis, or of all axes."""
        for one in range(len(AXES)) if axis is None else (axis,):
            self._restart_reference(one)
        set_due(self._state)

    def _decide(self, axis: int) -> None:
        """Decide which change caused the alarm of one axis, after the waiting time."""
        s = self._state
        alarm = s.alarm[axis].copy()
        s.alarm[axis] = 0.0
        if alarm[KIND] == STEP:
            self._report_step(axis, alarm)
            return
        after = s.cum[axis] - self._cum_at(int(alarm[START]))[axis]  # [J, 5]
        n, total = s.band[axis, :, N], s.band[axis, :, S]
        before_n, before_s = n - after[:, UNIT_N], total - after[:, UNIT_S]
        if self._is_bulk_unchanged(axis, after[0], before_s[0] / before_n[0]):
            self._report_burst(axis, alarm, after, before_n, before_s)
        else:
            self._report_noise_change(axis, alarm, after, before_n, before_s)

    def _cum_at(self, sample: int) -> Floats:
        """Return the sums [6, J, 5] stored at or after a sample, at most a quarter of the sample's age later."""
        at = self._state.snap_at
        later = np.where(at >= sample, at, NEVER)
        return np.asarray(self._state.snap[np.unravel_index(int(later.argmin()), at.shape)])

    def _is_bulk_unchanged(self, axis: int, after: Floats, before: float) -> bool:
        """Return True if outliers explain the alarm, because the mean of z² has risen much more than the median."""
        n, extremes = after[UNIT_N], after[UNIT_EXTREME]
        if extremes < 3 or not before > 0.0:
            return False
        return bool(self._bulk_variance_ratio(axis, after) < 1.0 + 0.5 * (after[UNIT_RAW] / n / before - 1.0))

    def _bulk_variance_ratio(self, axis: int, after: Floats) -> float:
        """Return the ratio of the variances after and before the alarm, estimated from the share of small differences.

        For Gaussian noise, the share of differences below a fixed limit determines the variance. Outliers hardly affect
        it.
        """
        whole = self._state.cum[axis, 0] - after
        usual, now = whole[UNIT_INSIDE] / whole[UNIT_N], after[UNIT_INSIDE] / after[UNIT_N]
        if not 0.02 < usual < 0.98 or now >= 1.0:
            return 1.0
        # A share p of |z| lies below q·σ with q = Φ⁻¹((1 + p)/2).
        quantile = NormalDist().inv_cdf
        return float((quantile(0.5 + 0.5 * usual) / quantile(0.5 + 0.5 * max(now, 1e-3))) ** 2)

    def _report_noise_change(self, axis: int, alarm: Floats, after: Floats, before_n: Floats, before_s: Floats) -> None:
        """Report a noise change, and make the samples since the onset the new reference."""
        s = self._state
        band = s.band[axis]
        with np.errstate(invalid="ignore", divide="ignore"):
            v0, spread = np.where(before_n > 0, before_s / before_n, 0.0), band[:, F]
            v1 = after[:, UNIT_S] / after[:, UNIT_N]
            if np.nanmax(np.where(v0 > 0, v1 / v0, np.nan)) > MAX_CLIPPED_RATIO:
                v1 = after[:, UNIT_RAW] / after[:, UNIT_N]
            v1 = np.where(after[:, UNIT_N] > 0, v1, 0.0)
        octaves = HaarVariancesBeforeAfter(v0, np.maximum(before_n, 0.0) / spread, v1, after[:, UNIT_N] / spread)
        what = identify_noise_change(octaves, self.rate_hz)
        sigma = sqrt(2.0 * max(octaves.evidence(), alarm[EVIDENCE]))
        text = f"{AXES[axis]} {_noise_text(AXES[axis], what)}"
        self._found.append(Change("noise_changed", axis, int(alarm[START]), int(alarm[FOUND]), sigma, what, text))
        self._restart_reference(axis, int(alarm[START]))
        keep = (after[:, UNIT_N] >= SEED) & (v1 > 0.0)
        band[keep, N], band[keep, S] = after[keep, UNIT_N], after[keep, UNIT_N] * v1[keep]
        band[keep, LIMIT], band[keep, SEEDED] = CLIP * v1[keep], SEED

    def _report_burst(self, axis: int, alarm: Floats, after: Floats, before_n: Floats, before_s: Floats) -> None:
        """Report a burst of outliers after the end, and remove the samples of the burst from the reference."""
        s = self._state
        now = self.samples
        latest = s.cum[axis, 0, UNIT_EXTREME] - self._cum_at(now - MIN_DWELL_SAMPLES // 2)[axis, 0, UNIT_EXTREME]
        lasting = now - alarm[START] >= max(MAX_BURST_S * self.rate_hz, 2 * MIN_DWELL_SAMPLES)
        if latest > 0 and not lasting:
            s.alarm[axis] = alarm
            s.alarm[axis, DUE] = now + MIN_DWELL_SAMPLES  # a multiple of TICK_SAMPLES, like all decision times
            return
        count, variance = after[0, UNIT_EXTREME], before_s[0] / before_n[0]
        # An outlier of size a in one sample gives one z² of a²/2.
        scale = sqrt(2.0 * max(after[0, UNIT_RAW] - after[0, UNIT_S], 0.0) / max(count, 1.0))
        what = {"count": (0.0, float(count)), "scale": (sqrt(variance), scale)}
        text = f"{AXES[axis]} {count:.0f} outliers of about {format_rate(AXES[axis], scale)} within " + (
            f"{(now - alarm[START]) / self.rate_hz:.1f} s"
        )
        sigma = sqrt(2.0 * alarm[EVIDENCE])
        self._found.append(Change("outlier_burst", axis, int(alarm[START]), int(alarm[FOUND]), sigma, what, text))
        if lasting:
            self._restart_reference(axis)
            return
        enough = before_n >= SEED
        s.band[axis, enough, N], s.band[axis, enough, S] = before_n[enough], before_s[enough]
        self._clear_suspicion(axis)

    def _report_step(self, axis: int, alarm: Floats) -> None:
        """Report a step of the bias."""
        before, after = (float(x) for x in self._state.step[axis, [BEFORE, AFTER]])
        text = f"{AXES[axis]} bias stepped by {format_rate(AXES[axis], after - before, sign=True)}"
        sigma = sqrt(2.0 * alarm[EVIDENCE])
        what = {"bias": (before, after)}
        self._found.append(Change("bias_stepped", axis, int(alarm[START]), int(alarm[FOUND]), sigma, what, text))
        self._clear_suspicion(axis)

    def _clear_suspicion(self, axis: int) -> None:
        """Reset the evidence of changes of one axis, and skip the blocks that contain samples of the change."""
        s = self._state
        s.cusum[axis] = s.unit[axis] = 0.0
        s.cusum[axis, :, :, SINCE] = self.samples
        s.burst[axis] = 0.0, self.samples
        s.step[axis], s.step[axis, 0] = 0.0, -1.0
        under_way = self.samples % (2 << np.arange(self._octaves)) != 0
        s.fill[axis] = -under_way.astype(np.int64)

    def _restart_reference(self, axis: int, born: int | None = None) -> None:
        """Start a new reference of one axis, and reset the evidence. The block sums of the octaves are kept."""
        s = self._state
        s.born[axis] = self.samples if born is None else born
        s.band[axis] = s.spread[axis] = 0.0
        s.band[axis, :, F] = 1.0
        s.alarm[axis] = 0.0
        self._clear_suspicion(axis)


def _noise_text(axis: str, what: Mapping[str, tuple[float, float]]) -> str:
    """Describe a noise change with the names of the coefficients, or with the frequency band."""
    names = NOISE_NAMES[axis[0]]
    letters = [f"{names[letter]} {_format_change(*what[letter])}" for letter in what if letter in names]
    if letters:
        return ", ".join(letters)
    if "band" not in what:
        return "noise changed"
    low, high = what["band"]
    return f"noise between {low:.2g} and {high:.2g} Hz {_format_change(*what['rms'])}"


def _format_change(before: float, after: float) -> str:
    """Format a relative change in percent."""
    if before == 0.0:
        return "appeared"
    if after == 0.0:
        return "vanished"
    percent = 100.0 * (after / before - 1.0)
    digits = 0 if abs(percent) >= 9.5 else 1
    return f"{'rose' if percent > 0 else 'fell'} by {abs(percent):.{digits}f} %"
