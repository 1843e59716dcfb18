"""Test of an IIO device through the service, with missing and implausible samples, and an unplugged device."""

import struct
import time
from pathlib import Path

import numpy as np
import pytest

from drivers.decoders.messages.iio import AXIS_CHANNELS
from drivers.links import iio_link
from tests.support.fake_iio_device import FakeIioDevice
from tests.support.waiting import wait_for
from tests.system.rig import check_deviations_equal_batch, run_service

RATE_HZ = 200
SAMPLES = 2000
MISSING = (700, 701, 1203)  # samples that the kernel drops because its buffer is full
IMPLAUSIBLE = (400, 1500)
CHANNELS = {
    **dict.fromkeys(AXIS_CHANNELS, "be:s32/32>>0"),
    "in_temp0": "be:s16/16>>0",
    "in_timestamp": "le:s64/64>>0",
}
ATTRIBUTES = {"in_anglvel_scale": "1e-6", "in_accel_scale": "1e-5", "in_temp0_scale": "100"}
CONFIG = f"""
[[device]]
name = "imu"
rate = {RATE_HZ}.0
window = 60.0
restart = false
[device.driver]
link = "iio"
device = "adis16475-2"
enable = true
[zenoh]
mode = "none"
[viewer]
mode = "none"
"""


def make_scan(i: int, start_ns: int) -> bytes:
    rate = 2**31 - 1 if i in IMPLAUSIBLE else 1000 + i
    row = (rate, -i, 0, i, -2 * i, 980_665, 250)
    return struct.pack(">6ih6x", *row) + struct.pack("<q", start_ns + i * 10**9 // RATE_HZ)


def test_received_lost_and_bad_samples_add_up_and_the_device_can_be_unplugged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(iio_link, "ROOT", tmp_path)
    device = FakeIioDevice(tmp_path, "adis16475-2", CHANNELS, ATTRIBUTES)
    start_ns = time.time_ns()
    scans = [make_scan(i, start_ns) for i in range(SAMPLES) if i not in MISSING]
    with run_service(tmp_path, CONFIG) as run:
        driver = run.worker("imu").driver
        wait_for(lambda: device.read("buffer/enable") == "1", "the buffer to be enabled")
        data = b"".join(scans)
        for at in range(0, len(data), 1234):  # parts that end in the middle of a scan
            device.write(data[at : at + 1234])
        sent_and_kept = len(scans) - len(IMPLAUSIBLE)
        wait_for(lambda: driver.counts.received == sent_and_kept, lambda: f"{driver.text}, {driver.counts}")
        wait_for(lambda: driver.state == "running", lambda: driver.text)
        device.unplug()
        wait_for(lambda: driver.state == "lost", lambda: driver.text)
    counts = driver.counts
    assert (counts.received, counts.bad, counts.lost) == (sent_and_kept, len(IMPLAUSIBLE), len(MISSING))
    assert counts.received + counts.bad + counts.lost == SAMPLES
    index = np.array([i for i in range(SAMPLES) if i not in (*MISSING, *IMPLAUSIBLE)])
    expected = np.column_stack(
        [1e-6 * (1000 + index), -1e-6 * index, 0 * index, 1e-5 * index, -2e-5 * index, 0 * index + 9.80665]
    )
    assert run.output.values("imu") == pytest.approx(expected)
    check_deviations_equal_batch(run.output, "imu", index)
    t_ns = np.concatenate([block.t_ns for block in run.output.blocks["imu"]])
    assert t_ns.tolist() == (start_ns + index * (10**9 // RATE_HZ)).tolist()
    assert "iio:device" in driver.text or "no such device" in driver.text or "gone" in driver.text
