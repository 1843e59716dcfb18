"""The warm-up compiles every kernel that the service calls, and each of them once."""

import json
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import monitor.common.compiled
from tests.support.waiting import PATIENCE_S

PROGRAM = """
    import json, sys

    import numpy as np

    from drivers.data_types import make_block
    from monitor.daemon.kernels import kernel_groups
    from monitor.common.compiled import Kernel
    from monitor.drift.compensation.compensator import Compensator
    from monitor.drift.thermal import thermal_response
    from monitor.estimation.detection.signal_monitor import SignalMonitor
    from monitor.estimation.estimator import Estimator


    def compiled():
        found = {
            f"{one.__module__}.{one.__name__}": one
            for module in list(sys.modules.values())
            for one in vars(module).values()
            if module.__name__.startswith("monitor.") and isinstance(one, Kernel)
        }
        return {name: (len(one.signatures), len(one.intermediate.signatures)) for name, one in found.items()}


    for part in kernel_groups.SERVICE.parts:
        part.prepare()
    before = compiled()

    rng = np.random.default_rng(1)
    values = 1e-3 * rng.standard_normal((12_000, 6))
    values[6000:6400, 0] += np.sin(np.arange(400) / 20)  # motion
    values[9000:, 1] *= 3.0  # a change of noise
    watch = SignalMonitor(100.0, remove_motion=True)
    estimators = [Estimator(100.0, 60.0), Estimator(100.0, 60.0, every_sample=True)]
    gyro = Compensator(100.0)
    for start in range(0, len(values), 50):
        samples = make_block(np.arange(start, start + 50), values[start : start + 50])
        gyro.compensate(samples.values, lost=3 if start == 5000 else 0)
        gyro.compensate(np.asfortranarray(values[start : start + 50]))
        for still in watch.process_samples(samples):
            for one in estimators:
                one.add_samples(still)
                if start % 1000 == 0:
                    one.get_estimate()
        if start == 8000:
            gyro.identify_due_models()
    watch.flush_delayed_samples()
    found = watch.take_events()
    for one in estimators:
        one.restart_axis(2, 1000)
        while one.step_slow_statistics() is None:
            pass
    gyro.bias_standard_error
    thermal_response.apply_first_order_lag(values[:, 0].copy(), 0.5)
    print(json.dumps([before, compiled(), len(found)]))
"""


@pytest.mark.long
def test_after_the_warm_up_nothing_more_is_compiled_and_each_kernel_has_one_signature(tmp_path: Path) -> None:
    root = Path(monitor.common.compiled.__file__).parents[1]
    command = [sys.executable, "-c", textwrap.dedent(PROGRAM)]
    cold = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}  # else inner functions would not be compiled at all
    timeout_s = 2.0 * PATIENCE_S  # everything is compiled, by one process
    done = subprocess.run(command, cwd=root, env=cold, timeout=timeout_s, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    before, after, found = json.loads(done.stdout)
    assert found, "the samples must lead through what follows motion and changes"
    assert {name: counts for name, counts in after.items() if counts != before.get(name)} == {}
    assert {name: counts for name, counts in after.items() if max(counts) > 1} == {}
    assert after["monitor.estimation.allan.window_kernel.append_staged_samples"] == [1, 1]
