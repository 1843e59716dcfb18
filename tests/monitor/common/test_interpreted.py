"""Tests that interpreted kernels give the same results as compiled kernels."""

import os
import pickle
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivers.data_types import Floats, make_block
from monitor.common.compiled import Kernel
from monitor.drift.compensation.live_compensation import LiveDriftCompensation
from monitor.drift.thermal.thermal_response import apply_first_order_lag
from monitor.estimation.detection.motion_and_change_monitor import MotionAndChangeMonitor
from monitor.estimation.estimator import MIN_SAMPLES, Estimator
from tests.support.waiting import PATIENCE_S

ROOT = Path(__file__).parents[3]
RATE_HZ = 100.0
SIGNAL_KINDS = 8
"""Gap, missing samples, motion, larger noise, step, constant axis, outliers and missing accelerometer."""
INTERPRETING_PROGRAM = """
import pickle, sys
from monitor.common.compiled import interpret_uncompiled_kernels
from tests.monitor.common.test_interpreted import list_compiled_kernels, process_random_samples
with interpret_uncompiled_kernels():
    found = [process_random_samples(seed) for seed in range(int(sys.argv[1]))]
assert not list_compiled_kernels(), list_compiled_kernels()
sys.stdout.buffer.write(pickle.dumps(found))
"""


def list_compiled_kernels() -> list[str]:
    """Return the names of the kernels that have been compiled or loaded in this process."""
    modules = [module for name, module in sys.modules.items() if name.startswith("monitor.")]
    kernels = {value for module in modules for value in vars(module).values() if isinstance(value, Kernel)}
    return sorted(kernel.py_func.__qualname__ for kernel in kernels if kernel.signatures)


def draw_random_signal(rng: np.random.Generator, n: int, kind: int) -> Floats:
    """Draw noise of six axes with one of ``SIGNAL_KINDS`` disturbances."""
    values = rng.standard_normal((n, 6)) * 10.0 ** rng.uniform(-6.0, 0.0, 6)
    values += np.cumsum(rng.standard_normal((n, 6)), axis=0) * 1e-3 * rng.uniform(0.0, 1.0, 6) * values.std(0)
    values[:, 2] += 9.81
    start, end = np.sort(rng.integers(0, n, 2))
    match kind:
        case 0:
            values[start:end, rng.integers(0, 6)] = np.nan
        case 1:
            values[rng.random(n) < 0.02] = np.nan
        case 2:
            values[start:end] += 10.0 * values.std(0) * np.sin(np.arange(end - start) / 10.0)[:, None]
        case 3:
            values[start:end] *= 5.0
        case 4:
            values[start:] += 5.0 * values.std(0)
        case 5:
            values[:, rng.integers(0, 6)] = 0.25
        case 6:
            values[rng.integers(0, n, 5)] = 10.0 ** rng.integers(0, 300)
        case 7:
            values[:, 3:] = np.nan
    return values


def process_random_samples(seed: int) -> list[Any]:
    """Process a random stream of samples and return all results as arrays and lists."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(150, 400))
    values = draw_random_signal(rng, n, seed % SIGNAL_KINDS)
    estimator = Estimator(RATE_HZ, float(rng.choice([2.0, 10.0, 60.0])), every_sample=seed % 4 == 0)
    monitor, compensation = (
        MotionAndChangeMonitor(RATE_HZ, bool(seed % 2), 10.0, keep_samples_at_rest=True),
        LiveDriftCompensation(RATE_HZ),
    )
    found: list[Any] = []
    at = 0
    while at < n:
        size = int(rng.choice([1, 7, 50, 200]))
        lost = int(rng.integers(1, 30)) if rng.random() < 0.1 else 0
        piece = values[at : at + size]
        samples = make_block(np.arange(at, at + len(piece)) * 10_000_000, piece, lost=lost)
        at += size
        for part in monitor.process_samples(samples):
            estimator.add_samples(part)
        for restart in monitor.take_restart_requests():
            estimator.restart_axis(restart.axis, restart.samples)
        found += [compensation.compensate_block(samples).values, compensation.take_drift_updates()]
        if rng.random() < 0.2 and estimator.samples_in_window >= MIN_SAMPLES:
            found.append(estimator.get_estimate())
    found += [estimator.step_slow_statistics() for _ in range(3)]
    found += [
        monitor.take_events(),
        monitor.take_samples_with_motion_masked(),
        compensation.take_events(),
        apply_first_order_lag(values[:, 0], 0.5),
    ]
    return [convert_to_arrays(result) for result in found]


def convert_to_arrays(value: Any) -> Any:
    """Return the numbers in a result as arrays of floats, whatever type of number they have."""
    if is_dataclass(value) and not isinstance(value, type):
        return [convert_to_arrays(getattr(value, field.name)) for field in fields(value)]
    if isinstance(value, Mapping):
        return [[convert_to_arrays(key), convert_to_arrays(item)] for key, item in value.items()]
    if isinstance(value, (list, tuple)):
        return [convert_to_arrays(item) for item in value]
    if isinstance(value, (bool, int, float, np.generic, np.ndarray)):
        return np.asarray(value, float)
    return repr(value)


def assert_same_results(first: Any, second: Any) -> None:
    """Compare results of ``convert_to_arrays``; the last digit of an exponential may differ."""
    if isinstance(first, list):
        assert len(first) == len(second)
        for pair in zip(first, second, strict=True):
            assert_same_results(*pair)
    elif isinstance(first, np.ndarray):
        np.testing.assert_allclose(first, second, rtol=1e-12)
    else:
        assert first == second


def test_interpreted_kernels_give_the_results_of_compiled_ones(tmp_path: Path) -> None:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-W", "error", "-c", INTERPRETING_PROGRAM, str(SIGNAL_KINDS)]
    run = subprocess.run(command, env=environment, cwd=ROOT, timeout=PATIENCE_S, stdout=subprocess.PIPE, check=True)
    for seed, found in enumerate(pickle.loads(run.stdout)):
        assert_same_results(found, process_random_samples(seed))
