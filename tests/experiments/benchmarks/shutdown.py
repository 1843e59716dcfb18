"""Measure how long the service takes to end, and how long samples wait for publication, during a fault.

    python -m tests.experiments.benchmarks.shutdown

The cases are a service without a fault, a frozen viewer, and a zenoh subscriber that reads nothing. The tests in
``tests/system/test_faults.py`` cover the same faults. They check no times, because times depend on the machine.
"""

import signal
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.support.ports import free_endpoint
from tests.system import test_faults as faults
from tests.system.rig import RunningService, run_service


@contextmanager
def no_fault(folder: Path) -> Iterator[RunningService]:
    """Run a service without a viewer and without zenoh."""
    with run_service(folder, faults.HEALTHY_DEVICE + faults.NO_ZENOH + faults.NO_VIEWER) as run:
        yield run


@contextmanager
def frozen_viewer(folder: Path) -> Iterator[RunningService]:
    """Run a service whose viewer process is stopped (SIGSTOP)."""
    with run_service(folder, faults.HEALTHY_DEVICE + faults.viewer_config("web")) as run:
        faults.wait_for_output_state(run, "viewer", lambda text: text == "ok")
        faults.get_viewer_process(run).send_signal(signal.SIGSTOP)
        faults.wait_for_output_state(run, "viewer", lambda text: text.startswith("stalled"))
        yield run


@contextmanager
def stuck_subscriber(folder: Path) -> Iterator[RunningService]:
    """Run a service with a subscriber whose callback never returns."""
    endpoint = free_endpoint()
    text = faults.HEALTHY_DEVICE + f'[zenoh]\nlisten = ["{endpoint}"]\n' + faults.NO_VIEWER
    with run_service(folder, text) as run:
        faults.wait_for_output_state(run, "zenoh", lambda text: text == "ok")
        with faults.start_python(faults.SLOW_SUBSCRIBER, endpoint, "callback") as slow:
            assert faults.read_line(slow) == "ready"
            yield run


def main() -> None:
    """Measure and print."""
    print("| case | longest pause between two publications (s) | end of the service (s) |\n| --- | --- | --- |")
    for case in (no_fault, frozen_viewer, stuck_subscriber):
        with tempfile.TemporaryDirectory() as folder, case(Path(folder)) as run:
            worker = run.worker("healthy")
            faults.check_healthy_device_continues(run)
            until_s, newest_s, seen, longest_s = (
                time.monotonic() + 10.0,
                time.monotonic(),
                worker.publisher.published,
                0.0,
            )
            while (now_s := time.monotonic()) < until_s:
                if worker.publisher.published != seen:
                    longest_s, newest_s, seen = max(longest_s, now_s - newest_s), now_s, worker.publisher.published
                time.sleep(0.002)
            begun_s = time.monotonic()
            run.stop()
            print(
                f"| {case.__name__.replace('_', ' ')} | {longest_s:.3f} | {time.monotonic() - begun_s:.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
