"""Resampling of a recording to a regular time grid.

The times of recorded samples are assigned by the same clock as those of live samples. Missing samples become NaN.
Because the clock cannot distinguish a late sample from a missing one, ``missing_sample_count`` corrects the number of
missing samples.

Samples with the same values and the same time stamp as an earlier sample are removed. Samples that repeat the previous
values at a later time are kept. A sample rate that the user states takes precedence over the time stamps.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.data_types import AXES, NS_PER_S, Floats, Ints, SampleBlock, SenderTimedFormat
from drivers.errors import ConfigError, NotReady, RecordingError
from drivers.timing.arrival_regression import snap_to_standard_rate
from drivers.timing.arrival_timeline import JUMP_S
from drivers.timing.sample_clock import SampleClock
from drivers.timing.sender_time_gaps import FORWARD_JUMP_S
from drivers.validation.number_ranges import RATE_HZ
from monitor.common.unit_formatting import format_axis_value, format_two_significant_digits
from monitor.estimation.coarse_times import refine_coarse_times
from monitor.estimation.detection.coarse_quantization import QuantizationStepAndNoise, find_coarsely_quantized_axes
from monitor.estimation.detection.repeated_share import estimate_stale_sample_share
from monitor.estimation.missing_sample_count import count_missing_before_gaps

MIN_RATE_DEVIATION: Final = 0.002
"""Minimum relative deviation of the stated rate from the rate of the time stamps that is reported."""
LARGE_RATE_DEVIATION: Final = 0.02
"""Relative deviation of the stated rate that is reported even if the time stamps are irregular."""
STEP_TOLERANCE: Final = 0.02
"""Maximum relative difference between time steps that count as equal."""
MAX_CLOCK_NOTES: Final = 10
"""Maximum number of notes that the clock contributes."""
MIN_REPEATED_SHARE: Final = 0.01
"""Minimum share of repeated samples that is reported."""
MAX_GAP_SAMPLES: Final = 1_000_000
"""Maximum number of missing samples that are stored for one gap, at 48 bytes per sample.

A longer gap is replaced by one missing sample, a row of ``RegularGrid.pauses``, because no cluster may contain samples
from both sides of the gap.
"""
SEGMENTS: Final = 8
"""Number of segments into which a recording is divided to compute the standard error of the mean rate."""
RATE_SIGMA: Final = 5.0
"""Minimum deviation of the rate that counts as significant, in standard errors of the mean rate."""
UNEVEN_STEP_SHARE: Final = 0.5
"""Minimum reported deviation of the 10 % and 90 % quantiles of the time steps, as a fraction of the sample period."""


@dataclass(frozen=True, slots=True)
class RegularGrid:
    """Samples on a regular time grid. The arrays may share memory with the recording and must not be modified."""

    values: Floats  # [n, 6], rad/s and m/s²; NaN = missing
    temperature_c: Floats  # [n] °C; NaN = missing or not measured
    pauses: Ints  # rows that replace a gap of more than MAX_GAP_SAMPLES samples
    rate_hz: float
    notes: list[str]  # irregularities of the time stamps and the values, other than the missing samples
    missing: int  # rows without a sample

    def notes_with_missing(self) -> list[str]:
        """Return the notes, and a note on the share of missing samples if there are any."""
        share = format_two_significant_digits(100.0 * self.missing / len(self.values))
        return [*self.notes, *([f"{share} % of the samples are missing"] if self.missing else [])]


def place_samples_on_grid(blocks: Sequence[SampleBlock], rate_hz: float | None) -> RegularGrid:
    """Place the samples of a recording on a regular time grid, with NaN for missing samples.

    Parameters
    ----------
    blocks : sequence of SampleBlock
        Recording with time stamps.
    rate_hz : float or None
        Sample rate in Hz that the user has stated. If None, the rate is estimated from the time stamps.
    """
    stamped, lost, rate, notes = _stamp(blocks, rate_hz)
    paused = lost > MAX_GAP_SAMPLES
    missing = np.where(paused, 1, lost)
    values = _insert_missing([samples.values for samples in stamped], missing)
    temperature_c = _insert_missing([samples.temperature_c for samples in stamped], missing)
    notes += _repeated_notes(values) + _resolution_notes(find_coarsely_quantized_axes(values))
    notes += [
        f"a pause of {n / rate:.6g} s is too long to be kept and is replaced by one missing sample"
        for n in lost[paused]
    ]
    begins = np.cumsum([0, *(len(samples) for samples in stamped[:-1])])
    pauses = (begins + np.cumsum(missing) - missing)[paused]
    return RegularGrid(values, temperature_c, pauses, rate, notes, int(missing.sum()))


def _stamp(blocks: Sequence[SampleBlock], rate_hz: float | None) -> tuple[list[SampleBlock], Ints, float, list[str]]:
    blocks, resolution_s = refine_coarse_times(blocks)
    clock = SampleClock(SenderTimedFormat(), rate_hz)
    stamped = [one for samples in blocks for one in clock.assign_times(samples)]
    clock_notes = [event.text for event in clock.take_events(ended=True)]
    t_ns = np.concatenate([samples.t_ns for samples in stamped])
    lost, late = _count_missing(stamped, t_ns)
    steps = np.diff(t_ns)
    progress = _count_and_time(stamped, t_ns, lost, steps)
    rate = rate_hz or _mean_rate(progress)
    notes = clock_notes[:MAX_CLOCK_NOTES] + (
        [f"and {len(clock_notes) - MAX_CLOCK_NOTES} more notes on the times"]
        if len(clock_notes) > MAX_CLOCK_NOTES
        else []
    )
    if resolution_s:
        notes.append(f"times have a resolution of {resolution_s:.3g} s; equal time steps are assumed between pauses")
    return stamped, lost, rate, notes + _step_notes(steps, progress, rate) + _late_notes(late)


def _count_missing(stamped: Sequence[SampleBlock], t_ns: Ints) -> tuple[Ints, int]:
    """Return the number of missing samples before each block, and the number of gaps that only contain late samples."""
    lost = np.array([samples.lost for samples in stamped], np.int64)
    short = (lost > 0) & (lost <= MAX_GAP_SAMPLES)
    rows = np.cumsum([0, *(len(samples) for samples in stamped[:-1])])
    short &= rows > 0
    if not short.any():
        return lost, 0
    steps = np.diff(t_ns)
    jumps = np.flatnonzero((steps < -JUMP_S * NS_PER_S) | (steps > FORWARD_JUMP_S * NS_PER_S)) + 1
    breaks = np.concatenate([rows[lost > MAX_GAP_SAMPLES], jumps])
    missing = lost.copy()
    missing[short] = count_missing_before_gaps(t_ns, rows[short], lost[short], breaks)
    return missing, int((short & (missing == 0)).sum())


def _insert_missing(parts: Sequence[Floats], missing: Ints) -> Floats:
    """Join parts, with the given number of NaN rows before each. The result is no copy if the parts are contiguous."""
    if not missing.any() and (whole := _contiguous(parts)) is not None:
        return whole
    joined = np.full((int(missing.sum()) + sum(map(len, parts)), *parts[0].shape[1:]), np.nan)
    row = 0
    for part, hole in zip(parts, missing.tolist(), strict=True):
        row += hole
        joined[row : row + len(part)] = part
        row += len(part)
    return joined


def _contiguous(parts: Sequence[Floats]) -> Floats | None:
    """Return contiguous parts as a view of their common base array, or None if the parts are not contiguous."""
    whole = parts[0].base
    if len(parts) == 1:
        return parts[0]
    if not isinstance(whole, np.ndarray) or not whole.flags.c_contiguous or whole.dtype != parts[0].dtype:
        return None
    if whole.shape[1:] != parts[0].shape[1:]:
        return None
    begin = end = _address(parts[0])
    for part in parts:
        if part.base is not whole or not part.flags.c_contiguous or _address(part) != end:
            return None
        end += part.nbytes
    first = (begin - _address(whole)) // whole.strides[0]
    return np.asarray(whole[first : first + sum(len(part) for part in parts)])


def _address(array: Floats) -> int:
    return int(array.__array_interface__["data"][0])


def _late_notes(late: int) -> list[str]:
    if not late:
        return []
    times = "once" if late == 1 else f"{late} times"
    return [f"a sample was late by a period or more {times}; later times show that no sample is missing there"]


def _repeated_notes(values: Floats) -> list[str]:
    share = estimate_stale_sample_share(values)
    if share < MIN_REPEATED_SHARE:
        return []
    percent = 100.0 * share
    return [
        f"{percent:.2g} % of rows repeat the previous row, because the sensor updates more slowly than it is read; "
        "these rows are kept"
    ]


def _resolution_notes(found: Sequence[QuantizationStepAndNoise]) -> list[str]:
    alike: dict[str, list[QuantizationStepAndNoise]] = {}
    for one in found:
        alike.setdefault(format_axis_value(AXES[one.axis], one.step), []).append(one)
    notes = []
    for size, those in alike.items():
        axes = ", ".join(AXES[one.axis] for one in those)
        low, high = (format_two_significant_digits(f(one.step / one.noise for one in those)) for f in (min, max))
        times = low if low == high else f"{low} to {high}"
        notes.append(
            f"values have steps of {size} ({axes}), {times} times the noise from sample to sample; quantization "
            "affects the shortest τ"
        )
    return notes


def _step_notes(steps: Ints, progress: tuple[Floats, Floats] | None, rate_hz: float) -> list[str]:
    if not steps.size:
        return []
    if progress is None:
        return [f"the rate used is {rate_hz:g} Hz; the times do not increase and give no rate"]
    uneven = _uneven_notes(steps, rate_hz)
    mean_hz, known = _rate(*progress)
    if abs(mean_hz / rate_hz - 1.0) < min(max(MIN_RATE_DEVIATION, RATE_SIGMA * known), LARGE_RATE_DEVIATION):
        return uneven
    if _is_even(steps):
        step_s = float(steps.mean()) / NS_PER_S
        return [
            f"the rate used is {rate_hz:g} Hz, but the times increase in steps of {step_s:.6g} s, {1.0 / step_s:.6g} Hz"
        ]
    return [*uneven, f"the rate used is {rate_hz:g} Hz, but the times give a mean of {mean_hz:.5g} Hz"]


def _uneven_notes(steps: Ints, rate_hz: float) -> list[str]:
    if _is_even(steps):
        return []
    low, middle, high = (np.quantile(steps, [0.1, 0.5, 0.9]) / NS_PER_S).tolist()
    alike = middle > 0.0 and high - low <= STEP_TOLERANCE * middle
    if alike or max(1.0 / rate_hz - low, high - 1.0 / rate_hz) <= UNEVEN_STEP_SHARE / rate_hz:
        return []
    worst_s = float(steps[steps < FORWARD_JUMP_S * NS_PER_S].max()) / NS_PER_S
    return [
        f"time steps are uneven: median {middle:.3g} s, 90 % quantile {high:.3g} s, maximum {worst_s:.3g} s; "
        "equal time steps are assumed"
    ]


def _is_even(steps: Ints) -> bool:
    """Return True if all time steps are equal within ``STEP_TOLERANCE``."""
    return float(steps.max()) - float(steps.min()) <= STEP_TOLERANCE * float(steps.min())


def _count_and_time(
    stamped: Sequence[SampleBlock], t_ns: Ints, lost: Ints, steps: Ints
) -> tuple[Floats, Floats] | None:
    """Return the cumulative number of samples and the elapsed time in seconds at the segment boundaries.

    Missing samples are counted, and jumps of the time stamps are excluded. If no time passes, the result is None.
    """
    rows = np.unique(np.linspace(0, steps.size, SEGMENTS + 1).astype(np.int64))
    starts = np.cumsum([0, *(len(samples) for samples in stamped[:-1])])
    missing = np.cumsum(np.concatenate([[0], lost[1:]]))
    low, high = int(steps.min(initial=0)), int(steps.max(initial=0))
    jumps = np.zeros(0, np.int64)
    if low <= -JUMP_S * NS_PER_S or high >= FORWARD_JUMP_S * NS_PER_S:
        jumps = np.flatnonzero((steps <= -JUMP_S * NS_PER_S) | (steps >= FORWARD_JUMP_S * NS_PER_S)) + 1
    over = np.concatenate([[0], np.cumsum(steps[jumps - 1])])[np.searchsorted(jumps, rows, "right")]
    at_jumps = np.where(np.isin(jumps, starts), lost[np.searchsorted(starts, jumps, "right") - 1], 0) + 1
    left_out = np.concatenate([[0], np.cumsum(at_jumps)])[np.searchsorted(jumps, rows, "right")]
    came = rows + missing[np.searchsorted(starts, rows, "right") - 1] - left_out
    passed_s = (t_ns[rows] - t_ns[0] - over) / NS_PER_S
    return (came.astype(np.float64), passed_s) if came[-1] > 0 and passed_s[-1] > 0.0 else None


def _rate(came: Floats, passed_s: Floats) -> tuple[float, float]:
    mean_hz = float(came[-1] / passed_s[-1])
    if came[-1] < 2 * SEGMENTS or (np.diff(came) <= 0.0).any():
        return mean_hz, 1.0
    periods = np.diff(passed_s) / np.diff(came)
    return mean_hz, float(periods.std(ddof=1)) / SEGMENTS**0.5 * mean_hz


def _mean_rate(progress: tuple[Floats, Floats] | None) -> float:
    if progress is None:
        raise NotReady(
            "the times of the recording do not increase, so the rate is unknown; state the rate with --rate HZ"
        )
    rate_hz = snap_to_standard_rate(_rate(*progress)[0])
    try:
        return RATE_HZ.check(rate_hz)
    except ConfigError as error:
        raise RecordingError(
            f"the times of the recording give a sample rate that is not supported: {error}; check that t is in "
            "seconds, or state the rate with --rate HZ"
        ) from None
