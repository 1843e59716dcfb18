"""A recording on a regular grid: by the same clock that stamps live samples, what is missing is NaN in its place.

The clock calls a step of two periods a hole, as the next sample has to be placed at once. A whole recording knows
better, hole by hole, what only came late. Rows that repeat others, time and values, are kept out. Rows that repeat the
one before while time goes on stay, as they are what the sensor's register held. A stated rate is believed, also where
the times say another. Everything found is said in notes, at most NOTES of one sort; so is a resolution of the values as
coarse as their noise.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from drivers.errors import ConfigError, NotReady, RecordingError
from drivers.quantities import RATE_HZ
from drivers.sample import AXES, Floats, Given, Ints, SampleBlock
from drivers.timing.arrival_regression import made_rate
from drivers.timing.duplicate_rows import NS
from drivers.timing.sample_clock import JUMP_S, LONG_S, SampleClock
from monitor.common.rates import amount, plain
from monitor.estimation.detection.repeated_samples import stale_share
from monitor.estimation.detection.resolution import Steps, coarse
from monitor.estimation.late_rows import truly_missing

OFF_RATE: Final = 0.002
"""A stated rate further than this from what the times say is told, where they say it that well."""
FAR_RATE: Final = 0.02
"""Further than this it is told in any case."""
STEADY: Final = 0.02
"""Steps that differ by less are alike."""
NOTES: Final = 10
"""Of the clock; what is beyond is counted."""
STALE: Final = 0.01
"""A share below this is not told."""
LONGEST_HOLE: Final = 1_000_000
"""Missing samples kept in place, 48 bytes each; one stands for a longer pause, and keeps terms from reaching across."""
STRETCHES: Final = 8
"""Of a recording, whose rates tell how well the mean of all is known."""
SURE: Final = 5.0
"""Standard errors of eight stretches."""
UNIT: Final = 0.05
"""Of a unit of times: what is nearer to a whole number of it is one."""
UNEVEN: Final = 0.5
"""Of a period: steps of which a fifth is further off than this are told."""


def on_grid(blocks: Sequence[SampleBlock], rate_hz: float | None) -> tuple[Floats, float, list[str]]:
    """Values [n, 6] at a steady rate, missing samples NaN in their places; the rate; what was found about the times.

    The values may be the blocks' own memory: to be read, not written.
    """
    stamped, lost, rate, notes = _timed(blocks, rate_hz)
    values = _placed(stamped, lost)
    return values, rate, [*notes, *_said_of_values(values), *_said_missing(lost, rate)]


def with_temperature(blocks: Sequence[SampleBlock], rate_hz: float | None) -> tuple[Floats, Floats, float, list[str]]:
    """As ``on_grid``, and the temperature [n] in °C between values and rate."""
    stamped, lost, rate, notes = _timed(blocks, rate_hz)
    values = _placed(stamped, lost)
    missing = np.where(lost > LONGEST_HOLE, 1, lost).tolist()
    parts = [
        part
        for samples, hole in zip(stamped, missing, strict=True)
        for part in (np.full(hole, np.nan), samples.temperature_c)
    ]
    notes = [*notes, *_said_of_values(values), *_said_missing(lost, rate)]
    return values, np.concatenate(parts), rate, notes


def _timed(blocks: Sequence[SampleBlock], rate_hz: float | None) -> tuple[list[SampleBlock], Ints, float, list[str]]:
    """Blocks as they follow each other, how many samples are missing before each, the rate, and what the times say."""
    clock = SampleClock(Given(), rate_hz)
    stamped = [one for samples in blocks for one in clock.stamp(samples)]
    told = [event.text for event in clock.take_events(ended=True)]
    t_ns = np.concatenate([samples.t_ns for samples in stamped])
    lost, late = _without_late(stamped, t_ns)
    steps = np.diff(t_ns)
    going = _going(stamped, t_ns, lost, steps)
    rate = rate_hz or _mean_rate(going)
    notes = told[:NOTES] + ([f"and {len(told) - NOTES} more notes on the times"] if len(told) > NOTES else [])
    return stamped, lost, rate, notes + _said_of_steps(steps, going, rate) + _said_late(late)


def _said_of_values(values: Floats) -> list[str]:
    return _said_stale(values) + _said_coarse(coarse(values))


def _without_late(stamped: Sequence[SampleBlock], t_ns: Ints) -> tuple[Ints, int]:
    """Samples missing before each block, and how many holes were none, as all that is missing only came late."""
    lost = np.array([samples.lost for samples in stamped], np.int64)
    short = (lost > 0) & (lost <= LONGEST_HOLE)
    rows = np.cumsum([0, *(len(samples) for samples in stamped[:-1])])
    short &= rows > 0  # nothing is known of what was before the first
    if not short.any():
        return lost, 0
    steps = np.diff(t_ns)
    jumps = np.flatnonzero((steps < -JUMP_S * NS) | (steps > LONG_S * NS)) + 1
    breaks = np.concatenate([rows[lost > LONGEST_HOLE], jumps])
    missing = lost.copy()
    missing[short] = truly_missing(t_ns, rows[short], lost[short], breaks)
    return missing, int((short & (missing == 0)).sum())


def _placed(stamped: Sequence[SampleBlock], lost: Ints) -> Floats:
    """All rows in one array [n, 6], NaN where samples are missing; not copied where blocks lie side by side."""
    missing = np.where(lost > LONGEST_HOLE, 1, lost)
    if not missing.any() and (whole := _side_by_side([samples.values for samples in stamped])) is not None:
        return whole
    values = np.empty((int(missing.sum()) + sum(len(samples) for samples in stamped), 6))
    row = 0
    for samples, hole in zip(stamped, missing.tolist(), strict=True):
        values[row : row + hole] = np.nan
        row += hole
        values[row : row + len(samples)] = samples.values
        row += len(samples)
    return values


def _side_by_side(parts: Sequence[Floats]) -> Floats | None:
    """The rows of the one array that these parts are, each beginning where the last ended; None where they are not."""
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


def _said_missing(lost: Ints, rate_hz: float) -> list[str]:
    long, short = lost[lost > LONGEST_HOLE], lost[(lost > 0) & (lost <= LONGEST_HOLE)]
    notes = [f"a pause of {n / rate_hz:.6g} s is too long to keep in place; no term reaches across" for n in long]
    if short.size:
        samples = "1 sample is" if short.sum() == 1 else f"{short.sum()} samples are"
        places = "1 place" if short.size == 1 else f"{short.size} places"
        notes.append(f"{samples} missing in {places}; terms that touch them are left out")
    return notes


def _said_late(late: int) -> list[str]:
    if not late:
        return []
    times = "once" if late == 1 else f"{late} times"
    return [
        f"a sample came late by a period or more {times}; later ones made good for it, so that none is missing there"
    ]


def _said_stale(values: Floats) -> list[str]:
    share = stale_share(values)
    if share < STALE:
        return []
    percent = 100.0 * share
    return [f"{percent:.2g} % of rows repeat the one before: the sensor updates slower than it is read; they are kept"]


def _said_coarse(found: Sequence[Steps]) -> list[str]:
    """By kind of sensor and size of the steps."""
    alike: dict[str, list[Steps]] = {}
    for one in found:
        alike.setdefault(amount(AXES[one.axis], one.step), []).append(one)
    notes = []
    for size, those in alike.items():
        axes = ", ".join(AXES[one.axis] for one in those)
        low, high = (plain(f(one.step / one.noise for one in those)) for f in (min, max))
        times = low if low == high else f"{low} to {high}"
        notes.append(
            f"values come in steps of {size} ({axes}), {times} times the noise from sample to sample: quantization "
            "shapes the shortest τ"
        )
    return notes


def _said_of_steps(steps: Ints, going: tuple[Floats, Floats] | None, rate_hz: float) -> list[str]:
    """Where times step unevenly; where they say another rate."""
    if not steps.size:
        return []
    if going is None:
        return [f"the rate used is {rate_hz:g} Hz; the times do not go on and say none"]
    uneven = _said_uneven(steps, rate_hz)
    mean_hz, known = _rate(*going)
    if abs(mean_hz / rate_hz - 1.0) < min(max(OFF_RATE, SURE * known), FAR_RATE):
        return uneven
    if _steady(steps):
        step_s = float(steps.mean()) / NS
        return [f"the rate used is {rate_hz:g} Hz, but the times step by {step_s:.6g} s, {1.0 / step_s:.6g} Hz"]
    return [*uneven, f"the rate used is {rate_hz:g} Hz, but by the times {mean_hz:.5g} samples came a second"]


def _said_uneven(steps: Ints, rate_hz: float) -> list[str]:
    if _steady(steps):
        return []
    low, middle, high = (np.quantile(steps, [0.1, 0.5, 0.9]) / NS).tolist()
    alike = middle > 0.0 and high - low <= STEADY * middle
    if alike or max(1.0 / rate_hz - low, high - 1.0 / rate_hz) <= UNEVEN / rate_hz:
        return []
    unit_s = _unit_s(steps)
    if unit_s > UNEVEN / rate_hz:
        return [f"times have a resolution of {unit_s:.3g} s; samples are taken to be even"]
    worst_s = float(steps[steps < LONG_S * NS].max()) / NS
    return [
        f"times step unevenly: by {middle:.3g} s in the median, {high:.3g} s at 90 %, {worst_s:.3g} s at worst; "
        "samples are taken to be even"
    ]


def _steady(steps: Ints) -> bool:
    """Return True if all steps are alike.

    The difference of two steps may exceed int64 where a time stamp is far off, so it is taken in floating point.
    """
    return float(steps.max()) - float(steps.min()) <= STEADY * float(steps.min())


def _unit_s(steps: Ints) -> float:
    """The unit that all steps are none or some of; 0 where there is none."""
    on = steps[steps > 0]
    if not on.size:
        return 0.0
    unit = float(on[on < 1.5 * on.min()].mean())  # a third of a second is not a whole number of nanoseconds
    whole = np.abs(steps / unit - np.rint(steps / unit)) < UNIT
    return unit / NS if whole.all() else 0.0


def _going(stamped: Sequence[SampleBlock], t_ns: Ints, lost: Ints, steps: Ints) -> tuple[Floats, Floats] | None:
    """Samples that came, missing ones too, and s that passed, by the ends of STRETCHES, where times do not jump."""
    rows = np.unique(np.linspace(0, steps.size, STRETCHES + 1).astype(np.int64))
    starts = np.cumsum([0, *(len(samples) for samples in stamped[:-1])])
    missing = np.cumsum(np.concatenate([[0], lost[1:]]))
    low, high = int(steps.min(initial=0)), int(steps.max(initial=0))
    jumps = np.zeros(0, np.int64)
    if low <= -JUMP_S * NS or high >= LONG_S * NS:
        jumps = np.flatnonzero((steps <= -JUMP_S * NS) | (steps >= LONG_S * NS)) + 1
    # what a jump skips is neither time nor samples
    over = np.concatenate([[0], np.cumsum(steps[jumps - 1])])[np.searchsorted(jumps, rows, "right")]
    at_jumps = np.where(np.isin(jumps, starts), lost[np.searchsorted(starts, jumps, "right") - 1], 0) + 1
    left_out = np.concatenate([[0], np.cumsum(at_jumps)])[np.searchsorted(jumps, rows, "right")]
    came = rows + missing[np.searchsorted(starts, rows, "right") - 1] - left_out
    passed_s = (t_ns[rows] - t_ns[0] - over) / NS
    return (came.astype(np.float64), passed_s) if came[-1] > 0 and passed_s[-1] > 0.0 else None


def _rate(came: Floats, passed_s: Floats) -> tuple[float, float]:
    """Samples a second over all, and its relative standard error by the scatter of stretches; 1 where there are few."""
    mean_hz = float(came[-1] / passed_s[-1])
    if came[-1] < 2 * STRETCHES or (np.diff(came) <= 0.0).any():
        return mean_hz, 1.0
    periods = np.diff(passed_s) / np.diff(came)
    return mean_hz, float(periods.std(ddof=1)) / STRETCHES**0.5 * mean_hz


def _mean_rate(going: tuple[Floats, Floats] | None) -> float:
    """The rate of a recording of which none is stated."""
    if going is None:
        raise NotReady("the times of the recording do not go on, so that its rate is unknown; state it with --rate HZ")
    rate_hz = made_rate(_rate(*going)[0])
    try:
        return RATE_HZ.check(rate_hz)
    except ConfigError as error:
        raise RecordingError(
            f"the times of the recording give a sample rate that is not supported: {error}; t must be in seconds, or "
            "state the rate with --rate HZ"
        ) from None
