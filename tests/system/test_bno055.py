"""Test of a simulated BNO055 that answers requests over a pseudo-terminal, through the link and the whole service."""

import os
import struct
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.data_types import Chunk
from drivers.links.base import Link
from drivers.units import DEGREE
from monitor.estimation.allan.batch import overlapping_avar
from tests.support.waiting import wait_for
from tests.system.rig import PluggableTerminal, run_service

CONFIG = """
[[device]]
name = "bno055"
rate = {rate}
window = 60.0
restart = false
[device.driver]
link = "serial"
port = "{port}"
silence = 0.0
decoder = "bno055"
first_request = "AA 00 3D 01 05"
request = "AA 01 00 3C"
request_rate = {rate}
[zenoh]
mode = "none"
[viewer]
mode = "none"
"""
RATE_HZ = 500.0
SAMPLES = 1500
MODE_REQUEST, READ_REQUEST = bytes.fromhex("AA 00 3D 01 05"), bytes.fromhex("AA 01 00 3C")
IDENTIFIERS = bytes.fromhex("A0 FB 32 0F 11 03 15 00")


class RespondingSensor:
    """Sensor that answers each request to read registers with the next sample, an error or a damaged answer.

    The sensor is in CONFIGMODE until a request selects a mode. It falls silent after its last sample.
    """

    def __init__(self, terminal: PluggableTerminal, raw: np.ndarray, errors: set[int], damaged: set[int]) -> None:
        self.answered = 0
        self._terminal = terminal
        self._raw = raw
        self._errors = errors
        self._damaged = damaged
        self._mode = 0
        os.open(terminal.port, os.O_RDWR | os.O_NOCTTY)  # reading fails while no program has opened the terminal
        self._thread = threading.Thread(target=self._answer_requests, daemon=True)
        self._thread.start()

    def _answer_requests(self) -> None:
        received = b""
        while self.answered < len(self._raw):
            received += os.read(self._terminal.master, 4096)
            while received:
                if received.startswith(MODE_REQUEST):
                    received = received[len(MODE_REQUEST) :]
                    self._mode = 5
                    self._terminal.write(b"\xee\x01")
                elif received.startswith(READ_REQUEST):
                    received = received[len(READ_REQUEST) :]
                    assert self._mode == 5
                    if self.answered < len(self._raw):
                        self._terminal.write(self._make_answer(self.answered))
                        self.answered += 1
                else:
                    assert READ_REQUEST.startswith(received) or MODE_REQUEST.startswith(received), received
                    break

    def _make_answer(self, i: int) -> bytes:
        if i in self._errors:
            return b"\xee\x07"
        gyro, accel = self._raw[i, :3].tolist(), self._raw[i, 3:].tolist()
        answer = b"\xbb\x3c" + IDENTIFIERS + struct.pack("<3h6x3h26x", *accel, *gyro)
        answer += bytes([28, 0, 0x0F, 0, 0, 6, 0, 0x80])
        assert len(answer) == 62
        return b"\x00" + answer[1:] if i in self._damaged else answer


def stamp_by_answer(link: Link, sensor: RespondingSensor) -> None:
    """Set the time of each chunk to when its last answer is due according to the request rate.

    The answers have no counter, so a pause on a heavily loaded machine would be counted as lost samples.
    """
    begun_ns = time.monotonic_ns()
    read = link.wait_for_chunks_or_timeout

    def read_and_stamp(timeout_s: float) -> list[Chunk] | None:
        chunks = read(timeout_s)
        t_ns = begun_ns + round(sensor.answered / RATE_HZ * 1e9)
        return [replace(chunk, t_ns=t_ns) for chunk in chunks or ()] or None

    link.wait_for_chunks_or_timeout = read_and_stamp  # type: ignore[method-assign]


@pytest.mark.parametrize("faults", [0, 30])
def test_every_request_is_received_lost_or_bad(tmp_path: Path, faults: int) -> None:
    rng = np.random.default_rng(8)
    raw = rng.normal(0.0, 40.0, (SAMPLES, 6)).astype(np.int64) + np.array([0, 0, 0, 0, 0, 981])
    # an error answer just before a damaged answer would count as bad, so faults are not adjacent
    at = rng.choice(np.arange(100, SAMPLES - 100, 2), 2 * faults, replace=False)
    errors, damaged = set(at[:faults].tolist()), set(at[faults:].tolist())
    terminal = PluggableTerminal(tmp_path)
    sensor = RespondingSensor(terminal, raw, errors, damaged)
    with run_service(
        tmp_path,
        CONFIG.format(rate=RATE_HZ, port=terminal.port),
        prepare=lambda service: stamp_by_answer(service.workers[0].driver.link, sensor),
    ) as run:
        counts = run.worker("bno055").driver.counts
        wait_for(lambda: counts.received + counts.bad + counts.lost >= SAMPLES, lambda: (counts, sensor.answered))
    assert (counts.received, counts.bad, counts.lost) == (SAMPLES - 2 * faults, faults, faults)
    values = raw * np.repeat([DEGREE / 16.0, 0.01], 3)
    kept = np.delete(np.arange(SAMPLES), at)
    np.testing.assert_allclose(run.output.values("bno055"), values[kept], rtol=1e-14)
    if not faults:
        curve = run.output.estimates["bno055"].curve
        assert curve.n == SAMPLES
        avar, terms = overlapping_avar(values, curve.factors)
        np.testing.assert_array_equal(curve.terms, terms)
        np.testing.assert_allclose(np.sqrt(curve.avar), np.sqrt(avar), rtol=1e-9)
