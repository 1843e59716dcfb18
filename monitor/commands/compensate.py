"""``compensate``: a recording in, the same recording without the drift of its gyros out, and how much that helped.

``adaptive`` is what the daemon does, sample by sample; ``fixed`` the same without its noise adapting; the others are
what finished recordings are treated with elsewhere. All are judged on the same stretches at rest: those after the first
third, from which whatever learns from a whole recording has learned.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.discovery import nearest
from drivers.errors import ConfigError, NotReady
from drivers.recordings import iter_blocks, load_samples
from drivers.recordings.writing import writing
from drivers.sample import AXES, Floats
from monitor.drift.compensation.arma import ORDERS, Order, identify
from monitor.drift.compensation.compensation_result import Axis, Result
from monitor.drift.compensation.compensation_score import at_rest
from monitor.drift.compensation.compensator import Compensator, Interval
from monitor.drift.compensation.reference_methods import VARIANTS, compensated
from monitor.drift.compensation.sage_husa import CONFIRMED, LEFT_OUT, STEPPED, USED
from monitor.estimation.regular_grid import with_temperature

METHODS: Final = ("adaptive", "fixed", *VARIANTS)
GYROS: Final = AXES[:3]
LEARNED: Final = 1.0 / 3.0
"""Of what is at rest: there whatever learns from a whole recording does so, and nothing is judged."""
ROWS: Final = 1 << 16

Tell = Callable[[str, float | None], None]
"""Told what is being done, and the share that is done where that is known."""


@dataclass(frozen=True, slots=True)
class Request:
    """What is to be compensated."""

    recording: Path
    out: Path
    method: str = "adaptive"
    rate_hz: float | None = None
    order: Order | None = None  # of the ARMA model of the drift; None: by criterion
    last_s: float | None = None  # the end of the recording alone


def make(request: Request, tell: Tell = lambda _what, _share: None) -> Result:
    """Compensate and write.

    Raises:
        ConfigError, RecordingError: no such method, no recording, no gyro in it, or a place that cannot be written
        NotReady: never at rest long enough; nothing is written
    """
    if request.method not in METHODS:
        raise ConfigError(f'--method: unknown method "{request.method}"{nearest(request.method, METHODS)}')
    tell("reading", None)
    found = load_samples(request.recording, request.rate_hz, request.last_s)
    axes = tuple(axis for axis in GYROS if axis in found.axes)
    if not axes:
        raise ConfigError(f"{request.recording}: no gyro axis in it; columns gx, gy, gz in rad/s are needed")
    values, temperature_c, rate_hz, notes = with_temperature(list(iter_blocks(found)), found.rate_hz)
    orders = ORDERS if request.order is None else (request.order,)
    live = Compensator(rate_hz, adapts=request.method != "fixed", orders=orders)
    out = _run(live, values, tell)
    intervals = tuple(live.take())
    rest = _at_rest(intervals, len(values), live.interval)
    learned, judged = _thirds(rest)
    if not judged.any():
        raise NotReady(
            f"{request.recording}: never at rest for {CONFIRMED * live.interval_s:g} s: no drift can be learned from it"
        )
    if request.method in VARIANTS:
        out = _treated(request.method, values, learned, axes, tell)
    tell("judging", None)
    judged_axes: dict[str, Axis] = {
        str(axis): _judge(AXES.index(axis), values, out, learned, judged, live, intervals) for axis in axes
    }
    start_s = 0.0 if found.t_s is None else float(found.t_s[0])
    _write(request.out, found.axes, start_s + np.arange(len(values)) / rate_hz, out, temperature_c, tell)
    return Result(
        recording=request.recording.name,
        out=request.out,
        method=request.method,
        rate_hz=rate_hz,
        samples=len(values),
        interval_s=live.interval_s,
        learned_s=float(learned.any(axis=1).sum() / rate_hz),
        judged_s=float(judged.any(axis=1).sum() / rate_hz),
        intervals=intervals,
        axes=judged_axes,
        notes=(*found.notes, *notes),
    )


def _run(live: Compensator, values: Floats, tell: Tell) -> Floats:
    """As the daemon does, but that a model is identified at once when it is due."""
    out = np.empty_like(values)
    size = live.interval
    for start in range(0, len(values), size):
        out[start : start + size] = live.update(values[start : start + size])
        live.identify()
        if start % (256 * size) == 0:
            tell("compensating", start / len(values))
    return out


def _at_rest(intervals: tuple[Interval, ...], n: int, size: int) -> NDArray[np.bool_]:
    """[n, 3] samples of the intervals that drift was learned from, once a bias was known."""
    mask = np.zeros((n, len(GYROS)), dtype=bool)
    for one in intervals:
        mask[one.end - size : one.end] = (one.became == USED) & np.isfinite(one.expected)
    return mask


def _thirds(rest: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """The first third of what is at rest, axis by axis, and the rest of it."""
    count = np.cumsum(rest, axis=0)
    first = count <= LEARNED * count[-1]
    return rest & first, rest & ~first


def _treated(method: str, values: Floats, learned: NDArray[np.bool_], axes: tuple[str, ...], tell: Tell) -> Floats:
    out = values.copy()
    for axis in axes:
        at = AXES.index(axis)
        tell(f"{method} {axis}", None)
        out[:, at] = compensated(values[:, at], values[learned[:, at], at], VARIANTS[method])
    return out


def _judge(
    at: int,
    values: Floats,
    out: Floats,
    learned: NDArray[np.bool_],
    judged: NDArray[np.bool_],
    live: Compensator,
    intervals: tuple[Interval, ...],
) -> Axis:
    """One axis, before and after."""
    before = values[:, at] - np.nanmean(values[learned[:, at], at])
    first = int(np.argmax(judged[:, at]))
    model = live.models[at]
    became = np.array([one.became[at] for one in intervals])
    return Axis(
        model=None if model is None else identify(*live.window(at), [model.order], intervals=True),
        before=at_rest(np.where(judged[:, at], before, np.nan)[first:], live.rate_hz),
        after=at_rest(np.where(judged[:, at], out[:, at], np.nan)[first:], live.rate_hz),
        left_out=int((became == LEFT_OUT).sum()),
        steps=int((became == STEPPED).sum()),
    )


def _write(path: Path, axes: tuple[str, ...], t_s: Floats, out: Floats, temperature_c: Floats, tell: Tell) -> None:
    """All rows that were recorded, on the grid they were found on."""
    there = np.flatnonzero(np.isfinite(out).any(axis=1))
    warm = bool(np.isfinite(temperature_c).any())
    with writing(path, axes, warm) as append:
        for start in range(0, there.size, ROWS):
            rows = there[start : start + ROWS]
            append(t_s[rows], out[rows], temperature_c[rows])
            tell("writing", start / there.size)
