"""When a verdict changes: not at one look, not at a burst, and back only when all is well."""

import numpy as np
import pytest

from drivers.data_types import Event
from monitor.estimation.detection.comparison_with_noise_model import MIN_SAMPLES, AxisModelComparison, ModelComparison
from monitor.estimation.detection.model_agreement_monitor import KIND, RENEWED_SHARE, ModelAgreementMonitor

STEP = 100  # samples from look to look
WINDOW = 40_000
HOLD = int(RENEWED_SHARE * WINDOW)
ONE = np.ones(4)


def axis_gap(axis: str, gap: float) -> AxisModelComparison:
    return AxisModelComparison(axis, 1.5 * ONE, ONE, gap * ONE, gap, (0.08, 0.32), 1, 2.8, 4.0, 4.5, WINDOW)


class Looks:
    """A device seen every STEP samples, 10 ms each."""

    def __init__(self) -> None:
        self.agreement = ModelAgreementMonitor()
        self.samples = WINDOW

    def see(self, samples: int, **gaps: float) -> list[Event]:
        events = []
        for _ in range(0, samples, STEP):
            self.samples += STEP
            axes = {axis: axis_gap(axis, gap) for axis, gap in gaps.items()}
            look = ModelComparison(self.samples * 10_000_000, 100.0, 400.0, self.samples, WINDOW, ONE, axes)
            events += self.agreement.update_decisions(look)
        return events


def test_a_gap_that_stays_is_told_once_with_where_and_how_much() -> None:
    looks = Looks()
    assert looks.see(1000, gz=2.0, gx=2.0) == []
    assert looks.see(HOLD, gz=6.0, gx=2.0) == []
    (event,) = looks.see(STEP, gz=6.0, gx=2.0)
    assert (event.kind, event.axis, event.sigma) == (KIND, "gz", 6.0)
    assert event.text == (
        "gz disagrees with its model at τ 0.08 to 0.32 s: the deviation is 1.5 times the deviation of the model, "
        "a gap of 6 σ with a threshold of 4.0 σ"
    )
    assert event.values == {
        "model": {"agrees": False, "gap": 6.0, "threshold": 4.0, "ratio": 1.5, "tau_lo": 0.08, "tau_hi": 0.32}
    }
    assert event.t_ns - (event.since_ns or 0) == HOLD * 10_000_000
    assert looks.agreement.agreement_by_axis == {"gz": False, "gx": True}
    assert looks.see(5 * HOLD, gz=6.0, gx=2.0) == []


def test_a_gap_that_comes_and_goes_is_no_event() -> None:
    looks = Looks()
    for _ in range(5):
        assert looks.see(HOLD, gz=6.0) == []
        assert looks.see(STEP, gz=2.0) == []
    assert looks.see(20 * HOLD, gz=4.3) == []  # above the threshold, below the alarm of many looks
    assert looks.agreement.agreement_by_axis == {"gz": True}


def test_what_is_beyond_all_chance_is_told_sooner() -> None:
    looks = Looks()
    looks.see(STEP, gz=2.0)
    assert looks.see(MIN_SAMPLES, gz=20.0) == []
    assert len(looks.see(STEP, gz=20.0)) == 1
    assert MIN_SAMPLES < HOLD


def test_it_agrees_again_only_below_the_lower_limit() -> None:
    looks = Looks()
    looks.see(MIN_SAMPLES + STEP, gz=20.0)
    assert looks.agreement.agreement_by_axis == {"gz": False}
    assert looks.see(10 * HOLD, gz=3.5) == []
    assert looks.see(HOLD, gz=1.5) == []
    (event,) = looks.see(STEP, gz=1.5)
    assert (event.kind, event.values["model"]["agrees"]) == (KIND, True)
    assert event.text == "gz agrees with its model again: the largest gap is 1.5 σ"
    assert looks.agreement.agreement_by_axis == {"gz": True}
    assert len(looks.see(2 * HOLD, gz=6.0)) == 1


def test_there_is_no_verdict_before_one_is_sure() -> None:
    looks = Looks()
    looks.see(MIN_SAMPLES, gz=20.0)
    assert looks.agreement.agreement_by_axis == {}
    assert len(looks.see(STEP, gz=20.0)) == 1


def test_an_axis_that_cannot_be_judged_for_a_while_keeps_its_verdict() -> None:
    looks = Looks()
    looks.see(MIN_SAMPLES + STEP, gz=20.0)
    assert looks.see(HOLD) == []
    assert looks.agreement.agreement_by_axis == {"gz": False}
    assert looks.see(HOLD, gz=20.0) == []


@pytest.mark.parametrize("gap", [4.4999, 4.5])
def test_the_alarm_itself_is_no_alarm(gap: float) -> None:
    assert Looks().see(3 * HOLD, gz=gap) == []
