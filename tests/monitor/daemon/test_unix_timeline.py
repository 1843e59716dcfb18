"""Test of the Unix times of samples that are ahead of the host clock."""

import time

import numpy as np
import pytest

from drivers.data_types import ArrivalTimedFormat, make_block
from drivers.decoders.text_lines import text
from drivers.decoders.text_lines.text.settings import Settings
from drivers.driver import Driver
from drivers.timing.arrival_timeline import JUMP_S
from drivers.timing.sample_clock import SampleClock
from monitor.daemon.device.unix_timeline import DeviceTimeline
from tests.support.loopback_link import LoopbackLink
from tests.support.settings import read_settings

NS_PER_S = 1_000_000_000


@pytest.mark.parametrize("step_ns", [NS_PER_S, -NS_PER_S])
def test_slew_keeps_the_order_of_samples_ahead_of_the_host_clock(step_ns: int, monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns, unix_ns = 10**14, 17 * 10**17
    monkeypatch.setattr(time, "monotonic_ns", lambda: now_ns)
    monkeypatch.setattr(time, "time_ns", lambda: unix_ns)
    decoder = text.build(read_settings(Settings, {"columns": ["gx"]}))
    driver = Driver("a", LoopbackLink(), decoder, SampleClock(ArrivalTimedFormat(), None), lambda samples: None)
    timeline = DeviceTimeline(driver)
    times_ns = []
    for second in range(5):
        newest_ns = now_ns + round(JUMP_S * NS_PER_S)
        for first in (-200, -100):  # before and after the slew changes
            samples = make_block(newest_ns + first + 2 * np.arange(50), np.zeros((50, 6)), None, None)
            times_ns.append(samples.t_ns + timeline.unix_offsets_ns(samples))
            unix_ns += step_ns * (-1) ** second
            timeline.slew_to_host_clock()
        now_ns, unix_ns = now_ns + NS_PER_S, unix_ns + NS_PER_S
    assert (np.diff(np.concatenate(times_ns)) > 0).all()
