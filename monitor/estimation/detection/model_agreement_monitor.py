"""Decisions whether the axes of a sensor agree with the noise model, and events when a decision changes.

The window is compared with the model ten times per second, and successive results are strongly correlated. Several
results above the threshold are therefore not independent evidence. In addition, some of many windows exceed the
threshold by chance. A model is rejected only if every comparison exceeds the stricter limit
``AxisModelComparison.alarm`` until an eighth of the window and at least ``MIN_SAMPLES`` samples have been replaced. If
the gap is above twice the threshold, chance is excluded, and ``MIN_SAMPLES`` new samples are sufficient. A rejected
model is accepted again if the gap stays below ``null95`` until the same share of the window has been replaced. Between
the two limits, the decision does not change. In a simulation of 1600 windows of six axes with 128 comparisons each, a
true model was rejected three times.

A rejection and a renewed acceptance are reported as ``model_disagrees`` events. The field ``agrees`` of the event is
the new decision.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from drivers.data_types import AXES, Event
from monitor.estimation.detection.model_comparison import MIN_SAMPLES, AxisModelComparison, ModelComparison

KIND: Final = "model_disagrees"
RENEWED_SHARE: Final = 0.125
"""Share of the window that must be replaced while a gap persists."""
CLEAR_FACTOR: Final = 2.0
"""Multiple of the threshold above which chance is excluded."""


@dataclass(slots=True)
class _Axis:
    """State of the decision for one axis."""

    agrees: bool | None = None  # None until the first decision
    since: tuple[int, int] | None = None  # samples and t_ns of the first comparison that contradicts the decision


class ModelAgreementMonitor:
    """Decisions whether the axes of one device agree with the noise model."""

    def __init__(self) -> None:
        self._axes = {axis: _Axis() for axis in AXES}

    @property
    def agreement_by_axis(self) -> Mapping[str, bool]:
        """Current decision for each decided axis, True if the axis agrees with the model."""
        return {axis: one.agrees for axis, one in self._axes.items() if one.agrees is not None}

    def update_decisions(self, comparison: ModelComparison) -> list[Event]:
        """Process one comparison, and return an event for each axis whose decision changes."""
        found = (self._update_axis(self._axes[axis], gap, comparison) for axis, gap in comparison.axes.items())
        return [event for event in found if event is not None]

    def _update_axis(self, axis: _Axis, gap: AxisModelComparison, comparison: ModelComparison) -> Event | None:
        """Update the decision for one axis, and return an event if it changed."""
        if axis.agrees is None and gap.gap <= gap.alarm:
            axis.agrees = True  # a first decision for agreement is not reported
        contradicted = gap.gap < gap.null95 if axis.agrees is False else gap.gap > gap.alarm
        if not contradicted:
            axis.since = None
            return None
        if axis.since is None:
            axis.since = comparison.samples, comparison.t_ns
        samples, since_ns = axis.since
        clear = axis.agrees is not False and gap.gap > CLEAR_FACTOR * gap.threshold
        if comparison.samples - samples < max(MIN_SAMPLES, 0 if clear else round(RENEWED_SHARE * gap.samples)):
            return None
        axis.agrees, axis.since = axis.agrees is False, None
        return _event(gap, axis.agrees, comparison.t_ns, since_ns)


def _event(gap: AxisModelComparison, agrees: bool, t_ns: int, since_ns: int) -> Event:
    """Build the event for a changed decision."""
    lo, hi = gap.tau_s
    tau = f"{lo:.3g} s" if lo == hi else f"{lo:.3g} to {hi:.3g} s"
    what = {
        "agrees": agrees,
        "gap": gap.gap,
        "threshold": gap.threshold,
        "ratio": gap.measured_to_model_ratio,
        "tau_lo": lo,
        "tau_hi": hi,
    }
    if agrees:
        text = f"{gap.axis} agrees with its model again: the largest gap is {gap.gap:.1f} σ"
    else:
        text = (
            f"{gap.axis} disagrees with its model at τ {tau}: "
            f"the deviation is {gap.measured_to_model_ratio:.3g} times the deviation of the model, "
            f"a gap of {gap.gap:.3g} σ with a threshold of {gap.threshold:.1f} σ"
        )
    return Event(KIND, t_ns, text, gap.axis, {"model": what}, since_ns, gap.gap)
