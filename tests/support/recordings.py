"""Real recordings for tests."""

import os
from pathlib import Path

import pytest


def recordings() -> Path:
    """Return the folder that ``IMU_MONITOR_DATA`` names, or skip the test if the variable is not set."""
    folder = os.environ.get("IMU_MONITOR_DATA")
    if not folder:
        pytest.skip("IMU_MONITOR_DATA is not set: this test reads real recordings")
    return Path(folder)
