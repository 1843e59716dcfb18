"""Faults that a service meets in a year, injected for real: every sample is accounted for, and the status says it."""

import os
import shutil
from pathlib import Path

import pytest

from tests.experiments.benchmarks import faults

SAYS = {
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
"""Frozen viewers and rubbish on the line have tests of their own, in ``test_faults``."""
needs_root = pytest.mark.skipif(
    os.geteuid() != 0 or not shutil.which("mount"), reason="only root can mount a small disk"
)


@pytest.mark.parametrize("name", [pytest.param(n, marks=needs_root) if n == "full_disk" else n for n in SAYS])
def test_every_sample_is_accounted_for(tmp_path: Path, name: str) -> None:
    outcome = faults.FAULTS[name](tmp_path, 20)
    assert outcome.received >= 100  # 50 before the fault and 50 after it are waited for
    assert SAYS[name] in outcome.said
    assert outcome.accounted, outcome
    if name in ("two_daemons", "full_disk", "slow_disk", "clock_back", "router"):
        # the board drops what the service does not fetch in time on a loaded machine; nothing else may be missing
        assert outcome.bad == 0
        assert outcome.lost <= outcome.dropped
        assert outcome.received == outcome.sent - outcome.dropped
