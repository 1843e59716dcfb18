"""The moment a sensor stops agreeing with its model, and the moment it agrees again: looks in, events out.

Looks at a sliding window follow each other ten times a second and are nearly the same: one look above its threshold is
no second witness of the one before, and of many windows some pass the threshold by chance. So the verdict changes when
the gap has been above ``alarm``, which is stricter, at every look while an eighth of the window's samples were renewed,
and FEWEST at least; past twice the threshold, where chance is out of the question, FEWEST will do. On the way back the
gap has to stay under ``null95`` as long: between the two the verdict stays as it is. In a simulation of 1600 windows of
six axes, looked at 128 times each, a true model was accused three times.

Both ways the event is a ``model_disagrees``, as that is the question; ``what`` says ``agrees``.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from drivers.sample import AXES, Event
from monitor.estimation.detection.model_gap import FEWEST, AxisGap, ModelGap

KIND: Final = "model_disagrees"
RENEWED: Final = 0.125
"""Of the window's samples, while a gap is held."""
CLEAR: Final = 2.0
"""Thresholds."""


@dataclass(slots=True)
class _Axis:
    agrees: bool | None = None  # None: not judged yet
    since: tuple[int, int] | None = None  # samples and t_ns of the first look that contradicts it


class Agreement:
    """The verdict on each axis of one device."""

    def __init__(self) -> None:
        self._axes = {axis: _Axis() for axis in AXES}

    @property
    def verdicts(self) -> Mapping[str, bool]:
        """axis -> whether it agrees with its model, of those that were judged."""
        return {axis: one.agrees for axis, one in self._axes.items() if one.agrees is not None}

    def update(self, look: ModelGap) -> list[Event]:
        """One look; the events that it brings."""
        found = (self._look(self._axes[axis], gap, look) for axis, gap in look.axes.items())
        return [event for event in found if event is not None]

    def _look(self, axis: _Axis, gap: AxisGap, look: ModelGap) -> Event | None:
        if axis.agrees is None and gap.gap <= gap.alarm:
            axis.agrees = True  # nothing to tell
        contradicted = gap.gap < gap.null95 if axis.agrees is False else gap.gap > gap.alarm
        if not contradicted:
            axis.since = None
            return None
        if axis.since is None:
            axis.since = look.samples, look.t_ns
        samples, since_ns = axis.since
        clear = axis.agrees is not False and gap.gap > CLEAR * gap.threshold
        if look.samples - samples < max(FEWEST, 0 if clear else round(RENEWED * gap.samples)):
            return None
        axis.agrees, axis.since = axis.agrees is False, None
        return _event(gap, axis.agrees, look.t_ns, since_ns)


def _event(gap: AxisGap, agrees: bool, t_ns: int, since_ns: int) -> Event:
    lo, hi = gap.tau_s
    what = {
        "agrees": agrees,
        "gap": gap.gap,
        "threshold": gap.threshold,
        "ratio": gap.ratio,
        "tau_lo": lo,
        "tau_hi": hi,
    }
    if agrees:
        text = f"{gap.axis} agrees with its model again: {gap.gap:.1f} σ apart at most"
    else:
        text = (
            f"{gap.axis} disagrees with its model at τ {place(gap)}: deviation {gap.ratio:.3g} times the model's, "
            f"{gap.gap:.3g} σ apart where chance stays below {gap.threshold:.1f}"
        )
    return Event(KIND, t_ns, text, gap.axis, {"model": what}, since_ns, gap.gap)


def place(gap: AxisGap) -> str:
    """The τ where it is, in words.

    >>> import numpy as np
    >>> one = np.ones(1)
    >>> place(AxisGap("gz", one, one, one, 9.0, (0.04, 1.28), 0, 2.0, 3.0, 3.5, 1000))
    '0.04 to 1.28 s'
    """
    lo, hi = gap.tau_s
    return f"{lo:.3g} s" if lo == hi else f"{lo:.3g} to {hi:.3g} s"
