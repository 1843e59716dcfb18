"""Processor time of the output to ROS 2 for one device, with a subscriber behind a router in another process.

``python -m tests.experiments.benchmarks.ros2`` prints the time of the thread that processes the samples, and the time
of the whole process.
"""

import multiprocessing
import time

import numpy as np
import zenoh

from drivers.data_types import make_block
from monitor.daemon.outputs.ros2_output import Ros2Output
from monitor.settings.loading import Device, Ros2Table
from tests.monitor.publishing import example_results
from tests.support.ports import free_endpoint
from tests.support.settings import read_settings
from tests.support.waiting import wait_for
from tests.support.zenoh_sessions import open_router

RATE_HZ = 1000
SECONDS = 10
BATCH = 100


def count_messages(endpoint: str, begun: "multiprocessing.Queue[None]", counted: "multiprocessing.Queue[int]") -> None:
    """Run a router with a subscriber, and count the samples of a device."""
    with open_router(endpoint) as router:
        subscriber = router.declare_subscriber("0/a/imu/**", zenoh.handlers.FifoChannel(RATE_HZ * SECONDS))
        begun.put(None)
        counted.put(sum(1 for _ in zip(range(RATE_HZ * SECONDS), subscriber, strict=False)))


def main() -> None:
    """Publish the samples and the status of one device in real time."""
    spawn, endpoint = multiprocessing.get_context("spawn"), free_endpoint()
    begun: multiprocessing.Queue[None] = spawn.Queue()
    counted: multiprocessing.Queue[int] = spawn.Queue()
    spawn.Process(target=count_messages, args=(endpoint, begun, counted), daemon=True).start()
    begun.get()
    device = read_settings(Device, {"name": "a", "driver": {"link": "virtual"}})
    output = Ros2Output(read_settings(Ros2Table, {"domain": 0, "connect": [endpoint], "imu": "raw"}), [device])
    output.start()
    wait_for(lambda: output.state == "ok")
    time.sleep(1.0)  # until the router has announced the subscriber
    output.publish_result("a", 1.0, 1, example_results.make_estimate())
    output.publish_health("a", 1.0, example_results.make_health())
    block = make_block(np.arange(BATCH) * 1_000_000, np.random.default_rng(1).normal(size=(BATCH, 6)))
    process_s, thread_s = time.process_time(), time.thread_time()
    for batch in range(RATE_HZ * SECONDS // BATCH):
        output.publish_samples("a", 1, block, time.time_ns())
        if batch * BATCH % RATE_HZ == 0:
            output.publish_diagnostics()
        time.sleep(BATCH / RATE_HZ)
    used_s = time.process_time() - process_s, time.thread_time() - thread_s
    print(f"{counted.get()} of {RATE_HZ * SECONDS} samples received in {SECONDS} s: "
          f"{used_s[0]:.3f} s of processor time, {used_s[1]:.3f} s in the thread of the samples")  # fmt: skip
    output.close()


if __name__ == "__main__":
    main()
