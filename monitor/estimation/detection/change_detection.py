"""Detect noise changes, bias steps and bursts of outliers at a specified rate of false alarms.

The variance of each axis is monitored separately at averaging times of 1, 2, 4, … samples, which are called octaves.
The reference variance of an octave is learned from the samples since the last change. A ``Change`` describes a noise
change, a bias step or a burst of outliers.

- **False alarms.** Of the accepted false alarms, 70 % are assigned to noise changes, and 10 % each to bias steps,
  bursts and spectral lines (``line_onset_detection``). The threshold for noise changes is h = ln(tests per day ·
  RATE_AT_ZERO / alarms per day). The constant ``RATE_AT_ZERO`` was measured at thresholds of 8 to 12
  (``tests/experiments/benchmarks/changes.py``). Typical thresholds are 13 to 20.
- **Learning.** An octave can raise an alarm when its reference is older than ``NOISE_LEARN_S`` and contains
  ``MIN_REFERENCE_TERMS`` differences. Short octaves learn for eight seconds, and long octaves learn for 128 clusters.
  While the reference is shorter than ``LEARN_S``, the threshold is higher, above all after a change. Changes during
  the learning time are not detected. A slow drift of the noise is eventually reported as a change, because the
  reference contains all samples since the last change.
- **After a change**, the samples since the change become the new reference.
- **Bursts.** A burst of outliers increases the number of large differences between samples, but not the median
  difference. Samples in a burst are removed from the reference.

The command ``reconcile`` does not use this detector, because it compares the likelihood of a step with the likelihoods
of other effects.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import floor, log, log2, sqrt
from statistics import NormalDist
from typing import Final

import numpy as np

from drivers.data_types import AXES, Floats
from drivers.errors import ConfigError
from drivers.validation.number_ranges import DAY_S
from monitor.common.compiled import as_read_only
from monitor.common.unit_formatting import COEFFICIENT_NAMES, format_axis_value, sensor_kind
from monitor.estimation.detection.change_kernel import (
    AFTER,
    BEFORE,
    CLIP,
    DUE,
    EVIDENCE,
    FOUND,
    KIND,
    LIMIT,
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
    advance_until_decision,
    make_change_state,
    set_next_decision_sample,
)
from monitor.estimation.detection.changed_coefficient_identification import (
    HaarVariancesBeforeAfter,
    identify_changed_coefficients,
)
from monitor.estimation.detection.line_onset_detection import LineChange, LineOnsetDetector

MAX_CLUSTER_S: Final = 300.0
"""Maximum cluster length in seconds.

Longer clusters would need days of learning and would respond to changes of the temperature.
"""
LEARN_S: Final = 60.0
"""Minimum learning time in seconds before a bias step or a burst of outliers."""
NOISE_LEARN_S: Final = 8.0
"""Minimum learning time in seconds before a noise change."""
MIN_DWELL_SAMPLES: Final = 256
"""Minimum number of samples between an alarm and the decision about its cause."""
MAX_DWELL_S: Final = 60.0
"""Maximum time in seconds between an alarm and the decision about its cause."""
MAX_BURST_S: Final = 60.0
"""Maximum duration of a burst of outliers in seconds. After a longer burst, a new reference is learned."""
RATE_AT_ZERO: Final = 0.07
"""Number of false alarms per tested squared difference, divided by e^−h, for all six variance ratios together.

The measured values are 0.053 to 0.065 (``tests/experiments/benchmarks/changes.py``).
"""
NOISE_SHARE: Final = 0.7
"""Share of the accepted false alarms that is assigned to noise changes."""
OTHER_SHARE: Final = 0.1
"""Share of the accepted false alarms that is assigned to bias steps, to bursts of outliers and to spectral lines."""
SKIP_BLOCK_ROWS: Final = 4096
"""Maximum number of missing samples that are processed at a time."""
MAX_CLIPPED_RATIO: Final = 4.0
"""Maximum variance ratio that is computed from clipped squares. Clipping would reduce larger ratios."""

Q_OR_VIBRATION: Final = "quantization noise or vibration near Nyquist"
"""Description of a change of Q, which can be caused by quantization noise or by a vibration."""


@dataclass(frozen=True, slots=True)
class Change:
    """Detected change on one axis. Times are given in samples since the start of the detector."""

    kind: str  # noise_changed, bias_stepped, outlier_burst
    axis: int  # index into AXES
    since: int  # estimated time at which the change began
    found: int  # time of the alarm; the change is reported up to one minute later
    sigma: float  # significance in standard deviations
    what: Mapping[str, tuple[float, float]]  # SI values before and after the change, or band limits in Hz
    text: str  # description for users

    def values_before_and_after(self) -> dict[str, dict[str, float]]:
        """Return the contents of ``what`` as dictionaries with the keys ``before`` and ``after``.

        For a frequency band, the keys are ``from`` and ``to``.
        """
        return {
            name: {"from": first, "to": second} if name == "band" else {"before": first, "after": second}
            for name, (first, second) in self.what.items()
        }


class NoiseAndBiasChangeDetector:
    """Detector of noise changes, bias steps and bursts of outliers on six axes.

    Parameters
    ----------
    rate_hz : float
        Sample rate in Hz.
    alarms_per_day : float
        Accepted number of false alarms per day, for all six axes together.

    Raises
    ------
    ConfigError
        If the sample rate or the number of false alarms is not positive.

    >>> detector = NoiseAndBiasChangeDetector(100.0)
    >>> noise = 1e-3 * np.random.default_rng(1).standard_normal((30_000, 6))
    >>> noise[20_000:, 2] *= 1.5
    >>> detector.process_samples(noise)
    >>> [(change.kind, AXES[change.axis], list(change.what)) for change in detector.take_changes()]
    [('noise_changed', 'gz', ['N'])]
    """

    def __init__(self, rate_hz: float, alarms_per_day: float = 1.0 / 30.0) -> None:
        if not (0.0 < rate_hz < np.inf and 0.0 < alarms_per_day < np.inf):
            raise ConfigError(f"rate {rate_hz} Hz and {alarms_per_day} alarms a day must be positive")
        self.rate_hz = rate_hz
        self._octaves = min(max(floor(log2(MAX_CLUSTER_S * rate_hz)), 7), 20) + 1
        self._state = make_change_state(self._octaves)
        looks = DAY_S * rate_hz * len(AXES)  # number of squared differences and of block pairs per day
        # The lower quantile is negated, because 1 - p is rounded to 1 if p is below 1e-16.
        once = -NormalDist().inv_cdf(min(0.5 * OTHER_SHARE * alarms_per_day / looks, 0.01))
        self._state.levels[:] = (
            max(log(looks * RATE_AT_ZERO / (NOISE_SHARE * alarms_per_day)), 1.0),
            max(log(looks / TICK_SAMPLES / (OTHER_SHARE * alarms_per_day)), 1.0),
            once, MIN_DWELL_SAMPLES, max(MAX_DWELL_S * rate_hz, MIN_DWELL_SAMPLES),
            LEARN_S * rate_hz, NOISE_LEARN_S * rate_hz,
        )  # fmt: skip
        self._lines = LineOnsetDetector(rate_hz, OTHER_SHARE * alarms_per_day, LEARN_S)
        self._found: list[Change] = []

    @property
    def samples_since_start(self) -> int:
        """Number of samples since the start, including missing samples."""
        return int(self._state.clock[TOTAL])

    def process_samples(self, values: Floats) -> None:
        """Search samples for noise changes, bias steps and bursts of outliers.

        Parameters
        ----------
        values : ndarray of float, shape (n, 6)
            Samples in rad/s and m/s²; NaN means missing.

        Raises
        ------
        ValueError
            If ``values`` does not have six columns.
        """
        rows = as_read_only(np.ascontiguousarray(values, np.float64))
        if rows.ndim != 2 or rows.shape[1] != len(AXES):
            raise ValueError(f"samples of shape {rows.shape}; expected is [n, {len(AXES)}]")
        row, lines = 0, self._lines
        while row < len(rows):
            begin, row = row, advance_until_decision(self._state, rows[: row + lines.samples_to_segment_end], row)
            lines.append_samples(rows[begin:row])
            if self._state.clock[TOTAL] >= self._state.clock[NEXT_DUE]:
                for axis in np.flatnonzero(
                    (self._state.alarm[:, KIND] > 0) & (self._state.alarm[:, DUE] <= self.samples_since_start)
                ):
                    self._decide(int(axis))
                set_next_decision_sample(self._state)
            for line in lines.take_changes():
                self._report_line(line, self.samples_since_start - line.age, self.samples_since_start, line.evidence)

    def skip_missing_samples(self, n_samples: int) -> None:
        """Process the given number of missing samples."""
        hole = np.full((min(n_samples, SKIP_BLOCK_ROWS), len(AXES)), np.nan)
        for start in range(0, n_samples, SKIP_BLOCK_ROWS):
            self.process_samples(hole[: n_samples - start])

    def take_changes(self) -> list[Change]:
        """Return the changes that were detected since the last call, in the order of detection."""
        found, self._found = self._found, []
        return found

    def _decide(self, axis: int) -> None:
        s = self._state
        alarm = s.alarm[axis].copy()
        s.alarm[axis] = 0.0
        if alarm[KIND] == STEP:
            self._report_step(axis, alarm)
            return
        line = self._lines.identify_change(axis, self.samples_since_start - int(alarm[START]))
        if line is not None:
            self._report_line(line, int(alarm[START]), int(alarm[FOUND]), float(alarm[EVIDENCE]))
            return
        after = s.cum[axis] - self._cum_at(int(alarm[START]))[axis]  # [J, 5]
        n, total = s.band[axis, :, N], s.band[axis, :, S]
        before_n, before_s = n - after[:, UNIT_N], total - after[:, UNIT_S]
        if self._is_bulk_unchanged(axis, after[0], before_s[0] / before_n[0]):
            self._report_burst(axis, alarm, after, before_n, before_s)
        else:
            self._report_noise_change(axis, alarm, after, before_n, before_s)

    def _cum_at(self, sample: int) -> Floats:
        """Return the first stored sums [6, J, 5] at or after a sample. The older the sums, the larger the intervals."""
        at = self._state.snap_at
        later = np.where(at >= sample, at, NEVER)
        return np.asarray(self._state.snap[np.unravel_index(int(later.argmin()), at.shape)])

    def _is_bulk_unchanged(self, axis: int, after: Floats, before: float) -> bool:
        """Return True if the mean squared difference has risen much more than the median, as in a burst of outliers."""
        n, extremes = after[UNIT_N], after[UNIT_EXTREME]
        if extremes < 3 or not before > 0.0:
            return False
        return bool(self._bulk_variance_ratio(axis, after) < 1.0 + 0.5 * (after[UNIT_RAW] / n / before - 1.0))

    def _bulk_variance_ratio(self, axis: int, after: Floats) -> float:
        """Return the ratio of the variance after an alarm to the variance before it, without the effect of outliers.

        The variances are computed from the share of differences below a fixed limit, which outliers hardly affect. For
        Gaussian noise, this share determines the variance.
        """
        whole = self._state.cum[axis, 0] - after
        usual, now = whole[UNIT_INSIDE] / whole[UNIT_N], after[UNIT_INSIDE] / after[UNIT_N]
        if not 0.02 < usual < 0.98 or now >= 1.0:
            return 1.0
        # If a share p of Gaussian values satisfies |z| < q·σ, then q = Φ⁻¹((1 + p)/2).
        quantile = NormalDist().inv_cdf
        return float((quantile(0.5 + 0.5 * usual) / quantile(0.5 + 0.5 * max(now, 1e-3))) ** 2)

    def _report_noise_change(self, axis: int, alarm: Floats, after: Floats, before_n: Floats, before_s: Floats) -> None:
        s = self._state
        band = s.band[axis]
        with np.errstate(invalid="ignore", divide="ignore"):
            v0, spread = np.where(before_n > 0, before_s / before_n, 0.0), band[:, F]
            v1 = after[:, UNIT_S] / after[:, UNIT_N]
            if np.nanmax(np.where(v0 > 0, v1 / v0, np.nan)) > MAX_CLIPPED_RATIO:
                v1 = after[:, UNIT_RAW] / after[:, UNIT_N]
            v1 = np.where(after[:, UNIT_N] > 0, v1, 0.0)
        octaves = HaarVariancesBeforeAfter(v0, np.maximum(before_n, 0.0) / spread, v1, after[:, UNIT_N] / spread)
        what = identify_changed_coefficients(octaves, self.rate_hz)
        sigma = sqrt(2.0 * max(octaves.log_likelihood_ratio_of_change(), alarm[EVIDENCE]))
        text = f"{AXES[axis]} {_noise_text(AXES[axis], what)}"
        self._found.append(Change("noise_changed", axis, int(alarm[START]), int(alarm[FOUND]), sigma, what, text))
        self._restart_reference(axis, int(alarm[START]))
        keep = (after[:, UNIT_N] >= SEED) & (v1 > 0.0)
        band[keep, N], band[keep, S] = after[keep, UNIT_N], after[keep, UNIT_N] * v1[keep]
        band[keep, LIMIT], band[keep, SEEDED] = CLIP * v1[keep], SEED

    def _report_line(self, line: LineChange, since: int, found: int, evidence: float) -> None:
        axis = AXES[line.axis]
        what = {"amplitude": (line.before, line.after), "frequency": (line.frequency_hz, line.frequency_hz)}
        amplitude = format_axis_value(axis, line.after or line.before)
        change = {0.0: "began, amplitude "}.get(line.before, "ended, amplitude before " if not line.after else "")
        text = f"{axis} line at {line.frequency_hz:.3g} Hz {change or _format_change(line.before, line.after)}"
        text += amplitude if change else f", amplitude {amplitude}"
        since = max(since, int(self._state.born[line.axis]))
        self._found.append(Change("noise_changed", line.axis, since, found, sqrt(2.0 * evidence), what, text))
        self._restart_reference(line.axis, since)

    def _report_burst(self, axis: int, alarm: Floats, after: Floats, before_n: Floats, before_s: Floats) -> None:
        s = self._state
        now = self.samples_since_start
        latest = s.cum[axis, 0, UNIT_EXTREME] - self._cum_at(now - MIN_DWELL_SAMPLES // 2)[axis, 0, UNIT_EXTREME]
        lasting = now - alarm[START] >= max(MAX_BURST_S * self.rate_hz, 2 * MIN_DWELL_SAMPLES)
        if latest > 0 and not lasting:
            s.alarm[axis] = alarm
            s.alarm[axis, DUE] = now + MIN_DWELL_SAMPLES  # remains a multiple of TICK_SAMPLES
            return
        count, variance = after[0, UNIT_EXTREME], before_s[0] / before_n[0]
        # An outlier of size a contributes a²/2 to the sum of squared differences.
        scale = sqrt(2.0 * max(after[0, UNIT_RAW] - after[0, UNIT_S], 0.0) / max(count, 1.0))
        what = {"count": (0.0, float(count)), "scale": (sqrt(variance), scale)}
        text = f"{AXES[axis]} {count:.0f} outliers of about {format_axis_value(AXES[axis], scale)} within " + (
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
        before, after = (float(x) for x in self._state.step[axis, [BEFORE, AFTER]])
        text = f"{AXES[axis]} bias stepped by {format_axis_value(AXES[axis], after - before, sign=True)}"
        sigma = sqrt(2.0 * alarm[EVIDENCE])
        what = {"bias": (before, after)}
        self._found.append(Change("bias_stepped", axis, int(alarm[START]), int(alarm[FOUND]), sigma, what, text))
        self._clear_suspicion(axis)

    def _clear_suspicion(self, axis: int) -> None:
        """Reset the evidence of one axis, and skip blocks that contain samples from before and after the change."""
        s = self._state
        s.cusum[axis] = s.unit[axis] = 0.0
        s.cusum[axis, :, :, SINCE] = self.samples_since_start
        s.burst[axis] = 0.0, self.samples_since_start
        s.step[axis], s.step[axis, 0] = 0.0, -1.0
        under_way = self.samples_since_start % (2 << np.arange(self._octaves)) != 0
        s.fill[axis] = -under_way.astype(np.int64)

    def _restart_reference(self, axis: int, born: int | None = None) -> None:
        """Discard the reference and the evidence of one axis, but keep the block sums of the octaves."""
        s = self._state
        s.born[axis] = self.samples_since_start if born is None else born
        s.band[axis] = s.spread[axis] = 0.0
        s.band[axis, :, F] = 1.0
        s.alarm[axis] = 0.0
        self._lines.restart(axis)
        self._clear_suspicion(axis)


def _noise_text(axis: str, what: Mapping[str, tuple[float, float]]) -> str:
    names = COEFFICIENT_NAMES[sensor_kind(axis)] | {"Q": Q_OR_VIBRATION}
    letters = [f"{names[letter]} {_format_change(*what[letter])}" for letter in what if letter in names]
    if letters:
        return ", ".join(letters)
    if "band" not in what:
        return "noise changed"
    low, high = what["band"]
    return f"noise between {low:.2g} and {high:.2g} Hz {_format_change(*what['rms'])}"


def _format_change(before: float, after: float) -> str:
    if before == 0.0:
        return "appeared"
    if after == 0.0:
        return "vanished"
    ratio = after / before
    if not 0.5 < ratio < 2.0:
        return f"rose by a factor of {ratio:.3g}" if ratio > 1.0 else f"fell by a factor of {1.0 / ratio:.3g}"
    percent = 100.0 * (ratio - 1.0)
    digits = 0 if abs(percent) >= 9.5 else 1
    return f"{'rose' if percent > 0 else 'fell'} by {abs(percent):.{digits}f} %"
