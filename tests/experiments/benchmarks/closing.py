"""How long the service takes to end, and how long samples wait for their publication, while others misbehave.

    python -m tests.experiments.benchmarks.closing

The cases are those of ``tests/system/test_faults.py``, which asserts no time since it depends on the machine: nothing
wrong, a frozen viewer, and a zenoh subscriber that takes nothing.
"""

import signal
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.support.ports import free_endpoint
from tests.system import test_faults as faults
from tests.system.rig import Running, running


@contextmanager
def nothing_wrong(folder: Path) -> Iterator[Running]:
    """A service without a viewer and without zenoh."""
    with running(folder, faults.HEALTHY + faults.NO_ZENOH + faults.NO_VIEWER) as run:
        yield run


@contextmanager
def frozen_viewer(folder: Path) -> Iterator[Running]:
    """The process of the viewer is stopped (SIGSTOP)."""
    with running(folder, faults.HEALTHY + faults.viewer("web")) as run:
        faults.output_says(run, "viewer", lambda text: text == "ok")
        faults.viewer_child(run).send_signal(signal.SIGSTOP)
        faults.output_says(run, "viewer", lambda text: text.startswith("stalled"))
        yield run


@contextmanager
def stuck_subscriber(folder: Path) -> Iterator[Running]:
    """The callback of a subscriber never returns."""
    endpoint = free_endpoint()
    text = faults.HEALTHY + f'[zenoh]\nlisten = ["{endpoint}"]\n' + faults.NO_VIEWER
    with running(folder, text) as run:
        faults.output_says(run, "zenoh", lambda text: text == "ok")
        with faults.process(faults.SLOW, endpoint, "callback") as slow:
            assert faults.first_word(slow) == "ready"
            yield run


def main() -> None:
    """Measure and print."""
    print("| case | longest pause between two publications (s) | end of the service (s) |\n| --- | --- | --- |")
    for case in (nothing_wrong, frozen_viewer, stuck_subscriber):
        with tempfile.TemporaryDirectory() as folder, case(Path(folder)) as run:
            station = run.station("healthy")
            faults.goes_on(run)
            until_s, newest_s, seen, longest_s = (
                time.monotonic() + 10.0,
                time.monotonic(),
                station.publisher.published,
                0.0,
            )
            while (now_s := time.monotonic()) < until_s:
                if station.publisher.published != seen:
                    longest_s, newest_s, seen = max(longest_s, now_s - newest_s), now_s, station.publisher.published
                time.sleep(0.002)
            begun_s = time.monotonic()
            run.stop()
            print(
                f"| {case.__name__.replace('_', ' ')} | {longest_s:.3f} | {time.monotonic() - begun_s:.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
