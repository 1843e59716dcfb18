"""Tests of the monitor that decides whether an axis agrees with its model, with hysteresis over time."""

import numpy as np
import pytest

from drivers.data_types import Event
from monitor.estimation.detection.comparison_with_noise_model import MIN_SAMPLES, AxisModelComparison, ModelComparison
from monitor.estimation.detection.model_agreement_monitor import KIND, RENEWED_SHARE, ModelAgreementMonitor

STEP = 100  # samples between two comparisons
WINDOW = 40_000
CONFIRMATION_SAMPLES = int(RENEWED_SHARE * WINDOW)
ONES = np.ones(4)


def make_axis_comparison(axis: str, gap: float) -> AxisModelComparison:
    return AxisModelComparison(axis, 1.5 * ONES, ONES, gap * ONES, gap, (0.08, 0.32), 1, 2.8, 4.0, 4.5, WINDOW)


class MonitoredDevice:
    """A device that is compared with its model every STEP samples of 10 ms."""

    def __init__(self) -> None:
        self.agreement = ModelAgreementMonitor()
        self.samples = WINDOW

    def add_samples(self, samples: int, **gaps: float) -> list[Event]:
        events = []
        for _ in range(0, samples, STEP):
            self.samples += STEP
            axes = {axis: make_axis_comparison(axis, gap) for axis, gap in gaps.items()}
            comparison = ModelComparison(self.samples * 10_000_000, 100.0, 400.0, self.samples, WINDOW, ONES, axes)
            events += self.agreement.update_decisions(comparison)
        return events


def test_lasting_gap_is_reported_once_with_location_and_size() -> None:
    device = MonitoredDevice()
    assert device.add_samples(1000, gz=2.0, gx=2.0) == []
    assert device.add_samples(CONFIRMATION_SAMPLES, gz=6.0, gx=2.0) == []
    (event,) = device.add_samples(STEP, gz=6.0, gx=2.0)
    assert (event.kind, event.axis, event.sigma) == (KIND, "gz", 6.0)
    assert event.text == (
        "gz disagrees with its model at τ 0.08 to 0.32 s: the deviation is 1.5 times the deviation of the model, "
        "a gap of 6 σ with a threshold of 4.0 σ"
    )
    assert event.values == {
        "model": {"agrees": False, "gap": 6.0, "threshold": 4.0, "ratio": 1.5, "tau_lo": 0.08, "tau_hi": 0.32}
    }
    assert event.t_ns - (event.since_ns or 0) == CONFIRMATION_SAMPLES * 10_000_000
    assert device.agreement.agreement_by_axis == {"gz": False, "gx": True}
    assert device.add_samples(5 * CONFIRMATION_SAMPLES, gz=6.0, gx=2.0) == []


def test_short_gaps_are_not_reported() -> None:
    device = MonitoredDevice()
    for _ in range(5):
        assert device.add_samples(CONFIRMATION_SAMPLES, gz=6.0) == []
        assert device.add_samples(STEP, gz=2.0) == []
    assert (
        device.add_samples(20 * CONFIRMATION_SAMPLES, gz=4.3) == []
    )  # above the threshold of one comparison, but below that of repeated comparisons
    assert device.agreement.agreement_by_axis == {"gz": True}


def test_very_large_gap_is_reported_earlier() -> None:
    device = MonitoredDevice()
    device.add_samples(STEP, gz=2.0)
    assert device.add_samples(MIN_SAMPLES, gz=20.0) == []
    assert len(device.add_samples(STEP, gz=20.0)) == 1
    assert MIN_SAMPLES < CONFIRMATION_SAMPLES


def test_agreement_returns_only_below_the_lower_limit() -> None:
    device = MonitoredDevice()
    device.add_samples(MIN_SAMPLES + STEP, gz=20.0)
    assert device.agreement.agreement_by_axis == {"gz": False}
    assert device.add_samples(10 * CONFIRMATION_SAMPLES, gz=3.5) == []
    assert device.add_samples(CONFIRMATION_SAMPLES, gz=1.5) == []
    (event,) = device.add_samples(STEP, gz=1.5)
    assert (event.kind, event.values["model"]["agrees"]) == (KIND, True)
    assert event.text == "gz agrees with its model again: the largest gap is 1.5 σ"
    assert device.agreement.agreement_by_axis == {"gz": True}
    assert len(device.add_samples(2 * CONFIRMATION_SAMPLES, gz=6.0)) == 1


def test_first_decision_needs_enough_samples() -> None:
    device = MonitoredDevice()
    device.add_samples(MIN_SAMPLES, gz=20.0)
    assert device.agreement.agreement_by_axis == {}
    assert len(device.add_samples(STEP, gz=20.0)) == 1


def test_axis_without_comparison_keeps_its_decision() -> None:
    device = MonitoredDevice()
    device.add_samples(MIN_SAMPLES + STEP, gz=20.0)
    assert device.add_samples(CONFIRMATION_SAMPLES) == []
    assert device.agreement.agreement_by_axis == {"gz": False}
    assert device.add_samples(CONFIRMATION_SAMPLES, gz=20.0) == []


@pytest.mark.parametrize("gap", [4.4999, 4.5])
def test_gap_equal_to_the_alarm_limit_is_no_alarm(gap: float) -> None:
    assert MonitoredDevice().add_samples(3 * CONFIRMATION_SAMPLES, gz=gap) == []
