"""Folder of the real recordings, functions that simulate recordings, and tests of loading rejected and damaged
recordings."""

import os
import re
from pathlib import Path

import numpy as np
import pytest

from drivers.data_types import Floats, SampleBlock, make_block
from drivers.errors import ImuError
from drivers.recordings import ReadingOptions, load_samples


def recordings() -> Path:
    """Return the folder that ``IMU_MONITOR_DATA`` names, or skip the test if the variable is not set."""
    folder = os.environ.get("IMU_MONITOR_DATA")
    if not folder:
        pytest.skip("IMU_MONITOR_DATA is not set: this test reads real recordings")
    return Path(folder)


def white(n: int, seed: int = 0) -> Floats:
    """Return white noise of 1e-3 (SI units) around 9.81 on six axes, shape [n, 6]."""
    return 1e-3 * np.random.default_rng(seed).standard_normal((n, 6)) + 9.81


def float32_noise(n: int, seed: int = 1) -> Floats:
    """Return white noise and gravity, which 32-bit floats represent exactly, shape [n, 6]."""
    values = np.random.default_rng(seed).normal(size=(n, 6)) * 1e-2 + [0.0, 0.0, 0.0, 0.0, 0.0, 9.81]
    return values.astype(np.float32).astype(np.float64)


def load_refused(path: Path, topic: str | None = None) -> str:
    """Load a recording that is refused, and return the error, which is one line that begins with the path."""
    with pytest.raises(ImuError) as error:
        load_samples(path, options=ReadingOptions(topic=topic))
    return _check_error_line(path, error.value)


def load_damaged(path: Path) -> None:
    """Load a damaged recording, and check that the result has samples or that the error is one line."""
    try:
        assert len(load_samples(path)) > 0
    except ImuError as error:
        _check_error_line(path, error)


def _check_error_line(path: Path, error: ImuError) -> str:
    line = str(error)
    assert "\n" not in line
    assert re.match(rf"{re.escape(str(path))}(/\S+)?: ", line), line
    return line


def recorded_blocks(t_s: Floats, values: Floats | None = None, rows: int = 1000) -> list[SampleBlock]:
    """Return a recording with the times ``t_s`` (s) in blocks of ``rows`` samples; white noise without ``values``."""
    t_ns = np.rint(np.asarray(t_s) * 1e9).astype(np.int64)
    values = white(len(t_ns)) if values is None else values
    edges = range(0, len(t_ns), rows)
    return [make_block(t_ns[a : a + rows].copy(), values[a : a + rows].copy()) for a in edges]
