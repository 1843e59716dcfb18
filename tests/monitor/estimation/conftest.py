"""Fixtures that several tests of the estimators use."""

from pathlib import Path

import pytest

from tests.support.recordings import recordings


@pytest.fixture
def reference() -> Path:
    """Return the folder of published data with known deviations; skip the test without ``IMU_MONITOR_DATA``."""
    return recordings() / "reference"
