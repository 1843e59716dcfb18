"""Lost samples, processor time and memory of a daemon with many IMUs.

    python -m tests.experiments.benchmarks.bench_devices [--devices 1 4 16 16:0.05] [--seconds 30]

Another process writes VectorNav binary frames at 1 kHz to one pseudo-terminal for each device. The daemon reads them
with its serial link and default settings, except for a window of ten minutes. (A window stores 64 bytes per sample, so
an hour of 16 devices at 1 kHz needs 3.7 GB.) This process subscribes to all messages of the daemon. The processor time
is measured from 5 s after the first sample to the last sample. Every sample must be received, bad or lost.
"""

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import zenoh

from tests.experiments.benchmarks.machine import Load, console, create_table, describe_machine
from tests.experiments.benchmarks.rig import PATIENCE_S, Daemon, Sensors, open_session
from tests.support.waiting import wait_for

RATE_HZ: Final = 1000
WARM_UP_S: Final = 5.0
SETTLE_S: Final = 2.0
READ_TIMEOUT_S: Final = 0.01
"""Default of the serial link: longest time that a byte waits for further bytes."""


@dataclass(frozen=True, slots=True)
class RunResult:
    """Result of one run."""

    sent: int
    received: int
    bad: int
    lost: int
    overflowed: int
    full: int
    cpu: float  # as a share of one core
    memory: int  # bytes
    messages: int
    latency_p99_s: float  # from arrival to publication, largest value of all devices in the last second
    others: str


class PublishedMessages:
    """Number of published messages, and the newest status of each device."""

    def __init__(self) -> None:
        self.messages = 0
        self.status: dict[str, dict[str, Any]] = {}

    def take(self, sample: zenoh.Sample) -> None:
        """Count a message and store a status. zenoh calls this method."""
        self.messages += 1
        if str(sample.key_expr).endswith("/status"):
            payload = json.loads(sample.payload.to_bytes())
            self.status[payload["device"]] = payload

    def total(self, what: str) -> int:
        """Return the sum of a count over the devices."""
        return sum(int(status[what]) for status in self.status.values())


def run(devices: int, read_timeout_s: float, seconds: float, folder: Path) -> RunResult:
    """Run a daemon with several devices and return the result."""
    sensors = Sensors(folder, devices, RATE_HZ, WARM_UP_S + seconds)
    daemon = Daemon(folder, devices, RATE_HZ, "10min", driver=f"read_timeout = {read_timeout_s}")
    published = PublishedMessages()
    try:
        with open_session(daemon.port) as session, session.declare_subscriber("imu/**", published.take):
            wait_for(lambda: len(published.status) == devices, "the first status")
            sensors.start()
            time.sleep(WARM_UP_S)
            load, start_s, cpu_s, before = Load(), time.monotonic(), daemon.cpu_s(), published.messages
            sent = sensors.wait(seconds + PATIENCE_S)
            cpu = (daemon.cpu_s() - cpu_s) / (time.monotonic() - start_s)
            others, messages = load.describe(), published.messages - before
            p99_s = max(status["latency"]["p99"] or 0.0 for status in published.status.values())
            time.sleep(SETTLE_S)
            memory = daemon.process.memory_info().rss
            return RunResult(
                sent=devices * sent["each"],
                received=published.total("received"),
                bad=published.total("bad"),
                lost=published.total("lost"),
                overflowed=published.total("overflowed"),
                full=sent["full"],
                cpu=cpu,
                memory=memory,
                messages=messages,
                latency_p99_s=p99_s,
                others=others,
            )
    finally:
        daemon.close()
        sensors.close()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--devices", nargs="+", default=["1", "4", "16", "16:0.05"], metavar="N[:READ_TIMEOUT]")
    parser.add_argument("--seconds", type=float, default=30.0)
    arguments = parser.parse_args()
    console.print(describe_machine())
    table = create_table(
        f"devices at {RATE_HZ} Hz on one service, {arguments.seconds:g} s after {WARM_UP_S:g} s",
        "devices",
        "read_timeout",
        "sent",
        "received",
        "bad",
        "lost",
        "over-flowed",
        "port full",
        "% of a core",
        "MB",
        "mes-sages/s",
        "p99 of status",
    )
    notes = []
    for word in arguments.devices:
        devices, read_timeout_s = int(word.partition(":")[0]), float(word.partition(":")[2] or READ_TIMEOUT_S)
        with TemporaryDirectory() as folder:
            result = run(devices, read_timeout_s, arguments.seconds, Path(folder))
        counts = [
            f"{count:,}"
            for count in (result.sent, result.received, result.bad, result.lost, result.overflowed, result.full)
        ]
        table.add_row(
            f"{devices}",
            f"{1e3 * read_timeout_s:g} ms",
            *counts,
            f"{100 * result.cpu:.0f}",
            f"{result.memory / 1e6:.0f}",
            f"{result.messages / arguments.seconds:.0f}",
            f"{result.latency_p99_s * 1e3:.1f} ms",
        )
        balance = result.received + result.bad + result.lost
        sign = "=" if balance == result.sent else "≠"
        notes.append(
            f"{word} devices: received + bad + lost = {balance:,} {sign} {result.sent:,} sent; {result.others}"
        )
    console.print(table)
    for note in notes:
        console.print(note)


if __name__ == "__main__":
    main()
