"""Many IMUs on one service: samples lost, processor time and memory of the daemon.

    python -m tests.experiments.benchmarks.bench_devices [--devices 1 4 16 16:0.05] [--seconds 30]

Another process writes VectorNav binary frames at 1 kHz to one pseudo-terminal a device; the daemon reads them by its
serial link, with window and publishing as they are by default but for a window of ten minutes (a
window holds 64 bytes a sample, an hour of 16 devices at 1 kHz 3.7 GB); this process subscribes to all it
publishes. Processor time is taken from 5 s after the first sample to the last one. What is sent must be received, bad
or lost.
"""

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import zenoh

from tests.experiments.benchmarks.machine import Load, about, console, table
from tests.experiments.benchmarks.rig import PATIENCE_S, Daemon, Sensors, subscriber
from tests.support.waiting import wait_for

RATE_HZ: Final = 1000
WARM_UP_S: Final = 5.0
SETTLE_S: Final = 2.0
READ_TIMEOUT_S: Final = 0.01
"""The serial link's default: how long a byte may wait for others."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """One run."""

    sent: int
    received: int
    bad: int
    lost: int
    overflowed: int
    full: int
    cpu: float  # of one core
    memory: int  # bytes
    messages: int
    latency_p99_s: float  # from arrival to publication, the worst of the devices' last second
    others: str


class Heard:
    """What the daemon publishes: how many messages, and the newest status of each device."""

    def __init__(self) -> None:
        self.messages = 0
        self.status: dict[str, dict[str, Any]] = {}

    def take(self, sample: zenoh.Sample) -> None:
        """Called by zenoh."""
        self.messages += 1
        if str(sample.key_expr).endswith("/status"):
            payload = json.loads(sample.payload.to_bytes())
            self.status[payload["device"]] = payload

    def total(self, what: str) -> int:
        """Sum over the devices."""
        return sum(int(status[what]) for status in self.status.values())


def run(devices: int, read_timeout_s: float, seconds: float, folder: Path) -> Outcome:
    """One daemon, so many devices."""
    sensors = Sensors(folder, devices, RATE_HZ, WARM_UP_S + seconds)
    daemon = Daemon(folder, devices, RATE_HZ, "10min", read_timeout=read_timeout_s)
    heard = Heard()
    try:
        with subscriber(daemon.port) as session, session.declare_subscriber("imu/**", heard.take):
            wait_for(lambda: len(heard.status) == devices, "the first status")
            sensors.go()
            time.sleep(WARM_UP_S)
            load, begun_s, cpu_s, before = Load(), time.monotonic(), daemon.cpu_s(), heard.messages
            sent = sensors.wait(seconds + PATIENCE_S)
            cpu = (daemon.cpu_s() - cpu_s) / (time.monotonic() - begun_s)
            others, messages = load.said(), heard.messages - before
            p99_s = max(status["latency"]["p99"] or 0.0 for status in heard.status.values())
            time.sleep(SETTLE_S)
            memory = daemon.process.memory_info().rss
            return Outcome(
                sent=devices * sent["each"],
                received=heard.total("received"),
                bad=heard.total("bad"),
                lost=heard.total("lost"),
                overflowed=heard.total("overflowed"),
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
    given = parser.parse_args()
    console.print(about())
    shown = table(
        f"devices at {RATE_HZ} Hz on one service, {given.seconds:g} s after {WARM_UP_S:g} s",
        "devices", "read_timeout", "sent", "received", "bad", "lost", "over-flowed", "port full", "% of a core",
        "MB", "mes-sages/s", "p99 of status",
    )  # fmt: skip
    feet = []
    for word in given.devices:
        devices, read_timeout_s = int(word.partition(":")[0]), float(word.partition(":")[2] or READ_TIMEOUT_S)
        with TemporaryDirectory() as folder:
            got = run(devices, read_timeout_s, given.seconds, Path(folder))
        counts = [f"{count:,}" for count in (got.sent, got.received, got.bad, got.lost, got.overflowed, got.full)]
        shown.add_row(
            f"{devices}", f"{1e3 * read_timeout_s:g} ms", *counts, f"{100 * got.cpu:.0f}", f"{got.memory / 1e6:.0f}",
            f"{got.messages / given.seconds:.0f}", f"{got.latency_p99_s * 1e3:.1f} ms",
        )  # fmt: skip
        balance = got.received + got.bad + got.lost
        sign = "=" if balance == got.sent else "≠"
        feet.append(f"{word} devices: received + bad + lost = {balance:,} {sign} {got.sent:,} sent; {got.others}")
    console.print(shown)
    for foot in feet:
        console.print(foot)


if __name__ == "__main__":
    main()
