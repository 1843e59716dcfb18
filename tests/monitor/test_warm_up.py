"""Test that the warm-up leaves nothing to compile at a start.

The kernels come from the cache that the start of the test session has filled. ``tests.support.kernels`` checks there
that each kernel is compiled only once.
"""

import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import monitor.common.compiled
from tests.support.waiting import PATIENCE_S

USE_ALL_KERNELS = """
    import numpy as np
    from numba.core import event

    from drivers.data_types import make_block
    from monitor.daemon.kernels import kernel_groups
    from monitor.drift.compensation.gyro_drift_compensator import Compensator
    from monitor.drift.thermal import interval_regression, thermal_response
    from monitor.estimation.detection.motion_and_change_monitor import MotionAndChangeMonitor
    from monitor.estimation.estimator import Estimator
    from tests.support.kernels import find_kernels


    def count_signatures():
        return {name: len(kernel.signatures) for name, kernel in find_kernels().items()}


    recorder = event.RecordingListener()
    event.register("numba:compile", recorder)
    for group in kernel_groups.GROUPS[::-1]:
        for part in group.parts:
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
    event.unregister("numba:compile", recorder)
    compiled = [str(each.data["dispatcher"]) for _, each in recorder.buffer if each.is_start]
    assert not compiled, compiled
    assert found, "the samples must contain motion and changes"
    added = {name: count for name, count in count_signatures().items() if count != before.get(name)}
    assert not added, added
"""


@pytest.mark.long
def test_warm_up_leaves_nothing_to_compile() -> None:
    root = Path(monitor.common.compiled.__file__).parents[2]
    command = [sys.executable, "-c", textwrap.dedent(USE_ALL_KERNELS)]
    done = subprocess.run(command, cwd=root, timeout=PATIENCE_S, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 0, done.stderr
