"""Folder of the real recordings, and simulated recordings as blocks of samples."""

import os
from pathlib import Path

import numpy as np
import pytest

from drivers.data_types import Floats, SampleBlock, make_block


def recordings() -> Path:
    """Return the folder that ``IMU_MONITOR_DATA`` names, or skip the test if the variable is not set."""
    folder = os.environ.get("IMU_MONITOR_DATA")
    if not folder:
        pytest.skip("IMU_MONITOR_DATA is not set: this test reads real recordings")
    return Path(folder)


def white(n: int, seed: int = 0) -> Floats:
    """Return white noise of 1e-3 (SI units) around 9.81 on six axes, shape [n, 6]."""
    return 1e-3 * np.random.default_rng(seed).standard_normal((n, 6)) + 9.81


def recorded_blocks(t_s: Floats, values: Floats | None = None, rows: int = 1000) -> list[SampleBlock]:
    """Return a recording with the times ``t_s`` (s) in blocks of ``rows`` samples; white noise without ``values``."""
    t_ns = np.rint(np.asarray(t_s) * 1e9).astype(np.int64)
    values = white(len(t_ns)) if values is None else values
    edges = range(0, len(t_ns), rows)
    return [make_block(t_ns[a : a + rows].copy(), values[a : a + rows].copy()) for a in edges]
