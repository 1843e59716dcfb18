"""Tests that the warm-up compiles every kernel exactly once and leaves nothing to compile at a start."""

import json
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import monitor.common.compiled
from monitor.daemon.kernels.kernel_compilation import COMPILER
from tests.support.waiting import PATIENCE_S

USE_ALL_KERNELS = """
    import json, sys

    import numpy as np

    from drivers.data_types import make_block
    from monitor.daemon.kernels import kernel_groups
    from monitor.common.compiled import Kernel
    from monitor.drift.compensation.gyro_drift_compensator import Compensator
    from monitor.drift.thermal import interval_regression, thermal_response
    from monitor.estimation.detection.motion_and_change_monitor import MotionAndChangeMonitor
    from monitor.estimation.estimator import Estimator


    def count_signatures():
        found = {
            f"{kernel.__module__}.{kernel.__name__}": kernel
            for module in list(sys.modules.values())
            for kernel in vars(module).values()
            if module.__name__.startswith("monitor.") and isinstance(kernel, Kernel)
        }
        return {name: (len(kernel.signatures), len(kernel.intermediate.signatures)) for name, kernel in found.items()}


    for part in kernel_groups.SERVICE.parts:
        part.prepare()
    before = count_signatures()

    rng = np.random.default_rng(1)
    values = 1e-3 * rng.standard_normal((12_000, 6))
    values[6000:6400, 0] += np.sin(np.arange(400) / 20)  # motion
    values[9000:, 1] *= 3.0  # a change of noise
    monitor = MotionAndChangeMonitor(100.0, remove_motion=True)
    estimators = [Estimator(100.0, 60.0), Estimator(100.0, 60.0, every_sample=True)]
    gyro = Compensator(100.0)
    for start in range(0, len(values), 50):
        samples = make_block(np.arange(start, start + 50), values[start : start + 50])
        gyro.compensate(samples.values, lost=3 if start == 5000 else 0)
        gyro.compensate(np.asfortranarray(values[start : start + 50]))
        for part in monitor.process_samples(samples):
            for estimator in estimators:
                estimator.add_samples(part)
                if start % 1000 == 0:
                    estimator.get_estimate()
        if start == 8000:
            gyro.identify_due_models()
    monitor.flush_delayed_samples()
    found = monitor.take_events()
    for estimator in estimators:
        estimator.restart_axis(2, 1000)
        while estimator.step_slow_statistics() is None:
            pass
    thermal_response.apply_first_order_lag(values[:, 0].copy(), 0.5)
    known = np.ones(50, bool)
    tested = interval_regression.f_test(values[:50, 0], values[:50, 1:2], values[:50, 2:3], known)
    interval_regression.estimate_white_noise(values[:50, 0], known, tested.noise)
    print(json.dumps([before, count_signatures(), len(found)]))
"""
LIST_COMPILATIONS = """
    from numba.core import event

    from monitor.daemon.kernels import kernel_groups

    with event.install_recorder("numba:compile") as recorder:
        for group in kernel_groups.GROUPS:
            for part in group.parts:
                part.prepare()
    print([str(each.data["dispatcher"]) for _, each in recorder.buffer if each.is_start])
"""


@pytest.mark.long
def test_warm_up_compiles_every_kernel_once_and_leaves_nothing_to_compile(tmp_path: Path) -> None:
    def run_program(*command: str) -> "subprocess.CompletedProcess[str]":
        root = Path(monitor.common.compiled.__file__).parents[2]
        cold = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}  # otherwise inner functions would not be compiled
        timeout_s = 2.0 * PATIENCE_S  # one process compiles all kernels of the service
        done = subprocess.run(
            command, cwd=root, env=cold, timeout=timeout_s, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return done

    before, after, found = json.loads(run_program(sys.executable, "-c", textwrap.dedent(USE_ALL_KERNELS)).stdout)
    assert found, "the samples must contain motion and changes"
    assert {name: counts for name, counts in after.items() if counts != before.get(name)} == {}
    assert {name: counts for name, counts in after.items() if max(counts) > 1} == {}
    assert after["monitor.estimation.allan.window_kernel.append_staged_samples"] == [1, 1]

    # The kernels of the service are in the cache now. The command compiles the kernels for recordings.
    command = COMPILER[:-1]
    first, second = run_program(*command), run_program(*command)
    compiled, _, cache_folder = first.stdout.partition("; kernels are kept in ")
    assert compiled.startswith("compiled ")
    assert "compiling 2 of " in first.stderr
    assert (second.stdout, second.stderr) == (f"nothing to compile; kernels are kept in {cache_folder}", "")
    assert run_program(sys.executable, "-c", textwrap.dedent(LIST_COMPILATIONS)).stdout == "[]\n"
