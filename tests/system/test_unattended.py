"""Tests with injected faults: every sample is counted as received, lost or bad, and the status names the fault."""

import os
import shutil
from pathlib import Path

import pytest

from tests.experiments.benchmarks import faults

EXPECTED_STATUS = {
    "cable": "the device is gone",
    "half_baud": "bytes without a sample",
    "can_bus": "bus off",
    "two_daemons": "held by another program",
    "no_descriptors": "Too many open files",
    "full_disk": "No space left on device; recording stopped",
    "slow_disk": "ok",
    "clock_back": "ahead of the host clock",
    "router": "nobody at",
}
"""Part of the status for each fault. ``test_faults`` tests a frozen viewer and undecodable bytes."""
needs_root = pytest.mark.skipif(
    os.geteuid() != 0 or not shutil.which("mount"), reason="only root can mount a small disk"
)


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=needs_root) if n == "full_disk" else n for n in EXPECTED_STATUS]
)
def test_every_sample_is_accounted_for(tmp_path: Path, name: str) -> None:
    outcome = faults.FAULTS[name](tmp_path, 20)
    assert outcome.received >= 100  # the injection waits for 50 samples before and 50 after the fault
    assert EXPECTED_STATUS[name] in outcome.reported
    assert outcome.accounted, outcome
    if name in ("two_daemons", "full_disk", "slow_disk", "clock_back", "router"):
        # the board drops samples that a loaded machine does not read in time; no other sample may be missing
        assert outcome.bad == 0
        assert outcome.lost <= outcome.dropped
        assert outcome.received == outcome.sent - outcome.dropped
