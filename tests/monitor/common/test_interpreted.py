"""Interpreted kernels: the results of compiled ones and a device that begins before it is compiled."""

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
from monitor.estimation.detection.signal_monitor import SignalMonitor
from monitor.estimation.estimator import MIN_SAMPLES, Estimator
from tests.support.waiting import PATIENCE_S

ROOT = Path(__file__).parents[3]
RATE_HZ = 100.0
INTERPRET = """
import pickle, sys
from monitor.common.compiled import interpret_uncompiled_kernels
from tests.monitor.common.test_interpreted import compiled_kernels, results
with interpret_uncompiled_kernels():
    found = [results(seed) for seed in range(int(sys.argv[1]))]
assert not compiled_kernels(), compiled_kernels()
sys.stdout.buffer.write(pickle.dumps(found))
"""


def compiled_kernels() -> list[str]:
    """Names of the kernels that have been compiled or loaded in this process."""
    modules = [module for name, module in sys.modules.items() if name.startswith("monitor.")]
    kernels = {one for module in modules for one in vars(module).values() if isinstance(one, Kernel)}
    return sorted(kernel.py_func.__qualname__ for kernel in kernels if kernel.signatures)


def signal(rng: np.random.Generator, n: int) -> Floats:
    """Noise of six axes on which much happens: gaps, outliers, steps, a tone, motion, a dead and a missing axis."""
    values = rng.standard_normal((n, 6)) * 10.0 ** rng.uniform(-6.0, 0.0, 6)
    values += np.cumsum(rng.standard_normal((n, 6)), axis=0) * 1e-3 * rng.uniform(0.0, 1.0, 6) * values.std(0)
    values[:, 2] += 9.81
    start, end = np.sort(rng.integers(0, n, 2))
    match rng.integers(0, 8):
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


def results(seed: int) -> list[Any]:
    """Process a random stream of samples and return all results as arrays and lists."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(200, 700))
    values = signal(rng, n)
    estimator = Estimator(RATE_HZ, float(rng.choice([2.0, 10.0, 60.0])), every_sample=seed % 4 == 0)
    watch, compensation = (
        SignalMonitor(RATE_HZ, bool(seed % 2), 10.0, keep_samples_at_rest=True),
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
        for part in watch.process_samples(samples):
            estimator.add_samples(part)
        for restart in watch.take_restart_requests():
            estimator.restart_axis(restart.axis, restart.samples)
        found += [compensation.compensate_block(samples).values, compensation.take_drift_updates()]
        if rng.random() < 0.2 and estimator.samples_in_window >= MIN_SAMPLES:
            found.append(estimator.get_estimate())
    found += [estimator.step_slow_statistics() for _ in range(3)]
    found += [
        watch.take_events(),
        watch.take_samples_with_motion_masked(),
        compensation.take_events(),
        apply_first_order_lag(values[:, 0], 0.5),
    ]
    return [plain(one) for one in found]


def plain(value: Any) -> Any:
    """Return the numbers in a result as arrays of floats, whatever type of number they have."""
    if is_dataclass(value) and not isinstance(value, type):
        return [plain(getattr(value, field.name)) for field in fields(value)]
    if isinstance(value, Mapping):
        return [[plain(key), plain(one)] for key, one in value.items()]
    if isinstance(value, (list, tuple)):
        return [plain(one) for one in value]
    if isinstance(value, (bool, int, float, np.generic, np.ndarray)):
        return np.asarray(value, float)
    return repr(value)


def assert_same(one: Any, other: Any) -> None:
    """Compare results of ``plain``; an exponential may differ in its last digit."""
    if isinstance(one, list):
        assert len(one) == len(other)
        for pair in zip(one, other, strict=True):
            assert_same(*pair)
    elif isinstance(one, np.ndarray):
        np.testing.assert_allclose(one, other, rtol=1e-12)
    else:
        assert one == other


def test_interpreted_kernels_give_the_results_of_compiled_ones(tmp_path: Path) -> None:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-W", "error", "-c", INTERPRET, "12"]
    run = subprocess.run(command, env=environment, cwd=ROOT, timeout=PATIENCE_S, stdout=subprocess.PIPE, check=True)
    for seed, found in enumerate(pickle.loads(run.stdout)):
        assert_same(found, results(seed))
