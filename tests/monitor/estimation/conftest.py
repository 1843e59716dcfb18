"""What several tests of the estimators read."""

from pathlib import Path

import pytest

from tests.support.recordings import recordings


@pytest.fixture
def reference() -> Path:
    """Folder of published data whose deviations are known, or a skip without ``IMU_MONITOR_DATA``."""
    return recordings() / "reference"
