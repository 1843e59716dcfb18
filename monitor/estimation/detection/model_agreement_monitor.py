"""Monitor that decides whether each axis of a sensor agrees with the noise model, and reports changes as events.

The sliding window is compared with the noise model ten times per second, so successive comparisons are strongly
correlated. An axis disagrees with the model if the largest difference stays above ``AxisModelComparison.alarm`` until
1/8 of the window has been replaced. If the difference exceeds twice ``AxisModelComparison.threshold``, ``MIN_SAMPLES``
new samples are sufficient. An axis agrees again if the largest difference stays below ``null95`` until 1/8 of the
window has been replaced. In a simulation of 1600 windows of six axes with 128 comparisons each, a true model was
rejected three times.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from drivers.data_types import AXES, Event
from monitor.estimation.detection.comparison_with_noise_model import MIN_SAMPLES, AxisModelComparison, ModelComparison

KIND: Final = "model_disagrees"
RENEWED_SHARE: Final = 0.125
"""Share of the samples in the window that must be new before a decision changes."""
CLEAR_FACTOR: Final = 2.0
"""Ratio of the difference to ``threshold`` above which fewer new samples are sufficient for a disagreement."""


@dataclass(slots=True)
class _Axis:
    """Current decision for one axis, and the evidence against it."""

    agrees: bool | None = None  # None until the first decision
    since: tuple[int, int] | None = None  # sample count and time at the first contradicting comparison


class ModelAgreementMonitor:
    """Monitor of the agreement between the axes of one device and the noise model."""

    def __init__(self) -> None:
        self._axes = {axis: _Axis() for axis in AXES}

    @property
    def agreement_by_axis(self) -> Mapping[str, bool]:
        """Current decision for each axis, True if the axis agrees with the noise model. Undecided axes are omitted."""
        return {axis: one.agrees for axis, one in self._axes.items() if one.agrees is not None}

    def update_decisions(self, comparison: ModelComparison) -> list[Event]:
        """Process one comparison, and return an event for each axis whose decision changes."""
        found = (self._update_axis(self._axes[axis], gap, comparison) for axis, gap in comparison.axes.items())
        return [event for event in found if event is not None]

    def _update_axis(self, axis: _Axis, gap: AxisModelComparison, comparison: ModelComparison) -> Event | None:
        if axis.agrees is None and gap.gap <= gap.alarm:
            axis.agrees = True  # Initial agreement is not reported as an event.
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
    lo, hi = gap.tau_s
    tau = f"{lo:.3g} s" if lo == hi else f"{lo:.3g} to {hi:.3g} s"
    what = {
        "agrees": agrees,
        "gap": gap.gap,
        "threshold": gap.threshold,
        "ratio": gap.ratio,
        "tau_lo": lo,
        "tau_hi": hi,
    }
    if agrees:
        text = f"{gap.axis} agrees with its model again: the largest gap is {gap.gap:.1f} σ"
    else:
        text = (
            f"{gap.axis} disagrees with its model at τ {tau}: "
            f"the deviation is {gap.ratio:.3g} times the deviation of the model, "
            f"a gap of {gap.gap:.3g} σ with a threshold of {gap.threshold:.1f} σ"
        )
    return Event(KIND, t_ns, text, gap.axis, {"model": what}, since_ns, gap.gap)
