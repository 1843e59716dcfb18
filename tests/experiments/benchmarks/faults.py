"""Table of the lost samples and the status of a running service for each injected fault.

    python -m tests.experiments.benchmarks.faults [NAME…] --times 1000

For most faults, the sensor is a simulated board on a pseudo-terminal. It prints 200 lines per second with a counter and
a checksum, so every line is counted as received, lost or bad. ``tests/system/test_unattended.py`` injects the same
faults.
"""

import argparse
import contextlib
import errno
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from unittest import mock

import numpy as np

from drivers.recordings import segment_file
from monitor.common.device_health import Health
from monitor.daemon.device.device_worker import DeviceWorker
from monitor.daemon.outputs.output import Output
from monitor.daemon.service import Service
from monitor.settings import loading
from tests.support.ports import free_endpoint, free_port
from tests.support.terminal import LineTerminal
from tests.support.waiting import PATIENCE_S, wait_for

RATE: Final = 200
DEVICE: Final = """
[[device]]
name = "board"
rate = {rate}
window = "1min"
[device.driver]
link = "serial"
port = "{port}"
decoder = "text"
[device.driver.decoder_options]
columns = ["counter", "gx", "gy", "gz", "ax", "ay", "az"]
nmea = true
"""
CAN: Final = """
[[device]]
name = "board"
rate = {rate}
[device.driver]
link = "can"
interface = "virtual"
channel = "{channel}"
decoder = "dbc"
[device.driver.decoder_options]
file = "xsens_mti"
counter = "SampleTime.SampleTimeFine"
tick = 1e-4
[device.driver.decoder_options.signals]
gx = "RateOfTurn.RateX"
gy = "RateOfTurn.RateY"
gz = "RateOfTurn.RateZ"
"""
NO_ZENOH: Final = '[zenoh]\nmode = "none"\n'
NO_VIEWER: Final = '[viewer]\nmode = "none"\n'
ROUTER: Final = """
import json, sys, time, zenoh
config = zenoh.Config()
for key, value in {"mode": "router", "scouting/multicast/enabled": False, "listen/endpoints": [sys.argv[1]]}.items():
    config.insert_json5(key, json.dumps(value))
with zenoh.open(config):
    print("up", flush=True)
    time.sleep(600)
"""


@dataclass(frozen=True)
class Outcome:
    """Counts of samples and reported status for one fault."""

    injected: str
    sent: int
    received: int
    lost: int
    bad: int
    reported: str  # text of the status
    note: str = ""
    dropped: int = 0  # sent samples for which there was no port or no room

    @property
    def accounted(self) -> bool:
        """True if every sent sample is counted. Samples that are dropped at the end cannot be counted."""
        return self.received + max(self.lost + self.bad, self.dropped) >= self.sent


@dataclass
class StatusOutput(Output):
    """Output that stores all states and events."""

    healths: list[Health] = field(default_factory=list)
    events: list[str] = field(default_factory=list)  # texts of the events

    def publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
        self.healths.append(health)

    def publish_event(self, device: str, unix_s: float, received: int, event: Any) -> None:
        self.events.append(event.text)

    def texts(self) -> set[str]:
        """Return all texts so far of the device, its outputs and its events."""
        found = {health.text for health in self.healths}
        return found | set(self.events) | {text for health in self.healths for text in health.outputs.values()}

    def wait_for_text(self, words: str) -> str:
        """Wait for a text that contains ``words`` and return it."""
        return wait_for(lambda: next((text for text in self.texts() if words in text), ""), f'"{words}"')

    def newest(self) -> Health | None:
        return self.healths[-1] if self.healths else None


class Board:
    """Simulated board that prints lines to a pseudo-terminal. ``corrupt`` changes the printed bytes."""

    def __init__(self, folder: Path) -> None:
        self.port = folder / "tty"
        self.sent = 0
        self.corrupt: Callable[[bytes], bytes] = lambda data: data
        self._terminal = LineTerminal(self.port)
        self._plugging = threading.Lock()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        self._thread.join()
        self.pull()

    def plug(self) -> None:
        with self._plugging:
            self._terminal.plug()

    def pull(self) -> None:
        with self._plugging:
            self._terminal.pull()

    def stop(self) -> None:
        """Stop printing."""
        self._closing.set()
        self._thread.join()

    def _run(self) -> None:
        rng, begun = np.random.default_rng(1), time.monotonic()
        while not self._closing.wait(0.01):
            due = int((time.monotonic() - begun) * RATE)
            data = b"".join(_line(self.sent + i, rng.standard_normal(6) * 1e-3) for i in range(due - self.sent))
            self.sent = due
            self._write(self.corrupt(data))

    @property
    def dropped(self) -> int:
        """Number of lines for which there was no port or no room in its buffer."""
        return self._terminal.dropped

    def _write(self, data: bytes) -> None:
        with self._plugging:
            self._terminal.write(data)


def _line(count: int, values: Any) -> bytes:
    fields = ",".join([str(count), *(f"{value:.6f}" for value in values)]).encode()
    check = 0
    for byte in fields:
        check ^= byte
    return b"$" + fields + b"*%02X\r\n" % check


@dataclass
class ServiceWithBoard:
    """Board with a service that reads it and the output of the service."""

    folder: Path
    board: Board
    service: Service
    output: StatusOutput

    @property
    def worker(self) -> DeviceWorker:
        return self.service.workers[0]

    def wait_for_samples(self, more: int = 50) -> None:
        """Wait for new samples."""
        before = self.worker.driver.counts.received
        wait_for(lambda: self.worker.driver.counts.received >= before + more, "samples")

    def wait_for_clean_status(self) -> None:
        """Wait until the status reports no problem."""

        def is_clean() -> bool:
            newest = self.output.newest()
            return newest is not None and newest.state == "running" and not newest.text

        wait_for(is_clean, "a clean status")

    def finish(self, injected: str, reported: str, note: str = "") -> Outcome:
        """Stop the board, wait for its last line and return the counts."""
        self.wait_for_samples()
        self.board.stop()
        counts, sent, dropped = self.worker.driver.counts, self.board.sent, self.board.dropped
        with contextlib.suppress(AssertionError):  # the outcome contains the missing samples
            wait_for(lambda: counts.received + max(counts.lost + counts.bad, dropped) >= sent, "the last line")
        return Outcome(injected, sent, counts.received, counts.lost, counts.bad, reported, note, dropped)


@contextlib.contextmanager
def run_service(folder: Path, more: str = NO_ZENOH + NO_VIEWER) -> Iterator[ServiceWithBoard]:
    """Run a service with a board, which starts to print after the service has opened the port."""
    board, output = Board(folder), StatusOutput()
    path = folder / "faults.toml"
    path.write_text(DEVICE.format(rate=RATE, port=board.port) + more)
    service = Service(loading.load_config(path), [output])
    thread = threading.Thread(target=service.run)
    thread.start()
    rig = ServiceWithBoard(folder, board, service, output)
    try:
        wait_for(lambda: getattr(rig.worker.driver.link, "_port", None) is not None, "the port")
        board.start()
        rig.wait_for_samples()
        wait_for(lambda: output.healths and "compiling" not in output.healths[-1].text, "the kernels")
        yield rig
    finally:
        service.request_stop()
        thread.join(PATIENCE_S)
        board.close()


# --- the wire


def cable(folder: Path, times: int) -> Outcome:
    """Unplug the cable and plug it in repeatedly."""
    pauses = mock.patch.multiple("drivers.driver", MIN_RETRY_PAUSE_S=0.01, MAX_RETRY_PAUSE_S=0.05)
    with pauses, run_service(folder) as rig:
        for _ in range(times):
            rig.board.pull()
            wait_for(lambda: rig.worker.driver.state == "lost", "the loss")
            rig.board.plug()
            wait_for(lambda: rig.worker.driver.state == "running", "samples after it")
        reported = rig.output.wait_for_text("the device is gone")
        return rig.finish(f"cable unplugged and plugged in, {times} times", reported)


def garbage(folder: Path, times: int) -> Outcome:
    """Send bursts of random bytes between and within the lines."""
    rng = random.Random(1)
    bursts = max(times // 5, 5)
    with run_service(folder) as rig:
        done = 0

        def corrupt(data: bytes) -> bytes:
            nonlocal done
            if done < bursts and data and rng.random() < 0.3:
                done += 1
                at = rng.randrange(len(data))
                return data[:at] + rng.randbytes(rng.randrange(1, 400)) + data[at:]
            return data

        rig.board.corrupt = corrupt
        wait_for(lambda: done >= bursts, "the bursts", 10.0 * PATIENCE_S)
        rig.board.corrupt = lambda data: data
        return rig.finish(f"{bursts} bursts of random bytes", _longest_status(rig))


def half_baud(folder: Path, times: int) -> Outcome:
    """Send the bytes that a port at half the baud rate receives."""
    with run_service(folder) as rig:
        rig.board.corrupt = read_at_half_baud_rate
        reported = rig.output.wait_for_text("bytes without a sample")
        rig.board.corrupt = lambda data: data
        rig.wait_for_clean_status()
        return rig.finish("half the baud rate, until the message", reported)


def read_at_half_baud_rate(data: bytes) -> bytes:
    """Return the bytes that result if the bits of the data are read with twice their length."""
    line: list[int] = []
    for byte in data:
        line += [0, *((byte >> i) & 1 for i in range(8)), 1]
    line += [1] * 20
    read, at = bytearray(), 0
    while at + 20 < len(line):
        if line[at]:
            at += 1
            continue
        bits = [line[min(at + 2 * i + 1, len(line) - 1)] for i in range(1, 9)]
        read.append(sum(bit << i for i, bit in enumerate(bits)))
        at += 19
    return bytes(read)


def two_daemons(folder: Path, times: int) -> Outcome:
    """Start a second daemon on the same serial port and zenoh endpoint."""
    both = f'[zenoh]\nlisten = ["{free_endpoint()}"]\n' + NO_VIEWER
    with run_service(folder, both) as rig:
        wait_for(lambda: rig.service.output_states()["zenoh"] == "ok", "the session")
        output = StatusOutput()
        second = Service(loading.load_config(folder / "faults.toml"), [output])
        thread = threading.Thread(target=second.run)
        thread.start()
        try:
            in_use = output.wait_for_text("held by another program")
            busy = output.wait_for_text("is busy")
            rig.wait_for_samples()
        finally:
            second.request_stop()
            thread.join(PATIENCE_S)
        assert second.workers[0].driver.counts.received == 0
        return rig.finish("two daemons on one port", f"the second: {in_use}; {busy}")


def no_descriptors(folder: Path, times: int) -> Outcome:
    """Plug the cable in while no further file can be opened."""
    with run_service(folder) as rig:
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        rig.board.pull()
        wait_for(lambda: rig.worker.driver.state == "lost", "the loss")
        rig.board.plug()
        free = os.open(os.devnull, os.O_RDONLY)
        os.close(free)
        try:
            resource.setrlimit(resource.RLIMIT_NOFILE, (free, hard))  # forbids the lowest free descriptor
            reported = rig.output.wait_for_text(os.strerror(errno.EMFILE))
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        rig.wait_for_clean_status()
        return rig.finish("out of file descriptors while the cable is put back", reported)


# --- CAN


def can_bus(folder: Path, times: int) -> Outcome:
    """Send error frames between the frames of a virtual bus, then bus-off."""
    import can

    channel = f"faults-{os.getpid()}"
    path, output = folder / "faults.toml", StatusOutput()
    path.write_text(CAN.format(rate=RATE, channel=channel) + NO_ZENOH + NO_VIEWER)
    service = Service(loading.load_config(path), [output])
    worker = service.workers[0]
    # python-can filters error frames by their identifier, which the kernel does not
    worker.driver.link.set_address_filter([])  # type: ignore[attr-defined]
    thread = threading.Thread(target=service.run)
    thread.start()
    sent = 0

    def send(samples: int, error: int = 0) -> None:
        nonlocal sent
        for _ in range(samples):
            time.sleep(1.0 / RATE)
            bus.send(
                can.Message(arbitration_id=5, data=(sent * 10_000 // RATE).to_bytes(4, "big"), is_extended_id=False)
            )
            bus.send(can.Message(arbitration_id=50, data=bytes([0, sent % 200] * 3), is_extended_id=False))
            sent += 1
            if error and sent % 10 == 0:
                bus.send(can.Message(is_error_frame=True, arbitration_id=error))

    try:
        with can.Bus(interface="virtual", channel=channel) as bus:
            wait_for(lambda: getattr(worker.driver.link, "_bus", None) is not None, "the bus")
            send(RATE)
            send(RATE, error=0x04)  # a controller's warning
            bus.send(can.Message(is_error_frame=True, arbitration_id=0x40))
            text = output.wait_for_text("bus off")
            while worker.driver.state != "running":
                send(10)
            send(RATE)
            counts = worker.driver.counts
            wait_for(lambda: counts.received + counts.lost + counts.bad >= sent - 1, "the last sample")
            injected = f"{RATE // 10} CAN error frames, then bus-off"
            return Outcome(
                injected, sent - 1, counts.received, counts.lost, counts.bad, text, "the last sample stays open"
            )
    finally:
        service.request_stop()
        thread.join(PATIENCE_S)


# --- disk


def full_disk(folder: Path, times: int) -> Outcome:
    """Fill the disk of the recording, which has half a megabyte."""
    small = folder / "small"
    small.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=512k", "tmpfs", str(small)], check=True, capture_output=True)
    try:
        ballast = small / "ballast"
        with run_service(folder, _storage(small / "store")) as rig:
            rig.wait_for_samples()
            with contextlib.suppress(OSError):
                ballast.write_bytes(bytes(1_000_000))
            reported = rig.output.wait_for_text("No space left")
            rig.wait_for_samples()
            ballast.unlink()
            wait_for(lambda: rig.service.output_states()["recording"] == "ok", "the recording")
            outcome = rig.finish("disk full, then free again", reported)
        _check_recording(small / "store", outcome)
        return outcome
    finally:
        subprocess.run(["umount", str(small)], check=True)


def slow_disk(folder: Path, times: int) -> Outcome:
    """Delay every write of the recording by two seconds."""
    write = segment_file.SegmentFileWriter.write_samples

    def write_slowly(writer: segment_file.SegmentFileWriter, *arguments: Any) -> None:
        time.sleep(2.0)
        write(writer, *arguments)

    with (
        mock.patch("drivers.recordings.segment_file.SegmentFileWriter.write_samples", write_slowly),
        run_service(folder, _storage(folder / "store")) as rig,
    ):
        for _ in range(4):
            rig.wait_for_samples(RATE)
        assert rig.service.recorder is not None
        outcome = rig.finish("every write takes 2 s", rig.service.recorder.state, "nothing is missing in the recording")
    _check_recording(folder / "store", outcome)
    return outcome


def _storage(folder: Path) -> str:
    return NO_ZENOH + NO_VIEWER + f'[storage]\nfolder = "{folder}"\ndisk_share = 1.0\nhistory = false\n'


def _check_recording(store: Path, outcome: Outcome) -> None:
    """Check that the recording contains all received samples."""
    ticks = [
        piece.samples
        for path in segment_file.list_segments(store / "board")
        for piece in segment_file.read_samples(path)
    ]
    rows = sum(len(one) for one in ticks)
    assert rows == outcome.received, f"{rows} rows of {outcome.received} received"


# --- clock, network


def clock_back(folder: Path, times: int) -> Outcome:
    """Set the clock of the host back by an hour."""
    true = time.time_ns
    with run_service(folder, _storage(folder / "store")) as rig:
        rig.wait_for_samples()
        with mock.patch("time.time_ns", side_effect=lambda: true() - 3600 * 10**9):
            for _ in range(5):
                rig.wait_for_samples(RATE)
            outcome = rig.finish("clock set back an hour", rig.output.wait_for_text("ahead of the host clock"))
    times_s = np.concatenate(
        [
            piece.samples.t_ns / 1e9
            for path in segment_file.list_segments(folder / "store" / "board")
            for piece in segment_file.read_samples(path)
        ]
    )
    steps = np.diff(times_s)
    assert steps.min() >= 0.0, "times went back"
    assert steps.max() < 0.5 + outcome.dropped / RATE, "a hole in the times"
    _check_recording(folder / "store", outcome)
    return outcome


def router(folder: Path, times: int) -> Outcome:
    """Kill and restart the router between daemon and subscriber."""
    import json

    import zenoh

    endpoint = free_endpoint()
    more = f'[zenoh]\nlisten = []\nconnect = ["{endpoint}"]\n' + NO_VIEWER
    process = _router(endpoint)
    received_s: list[float] = []
    config = zenoh.Config()
    for key, value in {
        "mode": "client", "scouting/multicast/enabled": False, "connect/endpoints": [endpoint]
    }.items():  # fmt: skip
        config.insert_json5(key, json.dumps(value))
    try:
        with run_service(folder, more) as rig, zenoh.open(config) as session:
            session.declare_subscriber("imu/board/status", lambda _: received_s.append(time.monotonic()))
            wait_for(lambda: received_s, "a status")
            process.kill()
            process.wait()
            reported = rig.output.wait_for_text("nobody at")
            rig.wait_for_samples()
            process = _router(endpoint)
            back = time.monotonic()
            wait_for(lambda: received_s[-1] > back, "a status after it")
            note = f"messages again {received_s[-1] - back:.1f} s after the router's start"
            return rig.finish("router killed and started again", reported, note)
    finally:
        process.kill()
        process.wait()


def _router(endpoint: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", ROUTER, endpoint]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    with process.stdout:
        assert process.stdout.readline().strip() == "up"
    return process


def viewer(folder: Path, times: int) -> Outcome:
    """Stop the process of the viewer (SIGSTOP) for some seconds."""
    more = NO_ZENOH + f'[viewer]\nmode = "web"\nport = {free_port()}\nweb_port = {free_port()}\n'
    with run_service(folder, more) as rig:
        assert rig.service.viewer is not None
        wait_for(lambda: rig.service.output_states()["viewer"] == "ok", "the viewer")
        child = rig.service.viewer._child
        assert child is not None
        os.kill(child.pid, signal.SIGSTOP)
        reported = rig.output.wait_for_text("stalled")
        rig.wait_for_samples(2 * RATE)
        os.kill(child.pid, signal.SIGCONT)
        wait_for(lambda: rig.service.output_states()["viewer"] == "ok", "the viewer again")
        return rig.finish("viewer frozen", f"viewer: {reported}")


def _longest_status(rig: ServiceWithBoard) -> str:
    """Return the longest text of the status, which reports the most problems."""
    texts = {health.text for health in rig.output.healths}
    return max(texts, key=len, default="") or "nothing"


FAULTS: Final = {
    fault.__name__: fault
    for fault in (
        cable, garbage, half_baud, can_bus, two_daemons, no_descriptors, full_disk, slow_disk, clock_back, router,
        viewer,
    )
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(FAULTS))
    parser.add_argument("--times", type=int, default=1000, help="number of repetitions")
    arguments = parser.parse_args()
    print("| fault | sent | received | lost | bad | status |\n| --- | --- | --- | --- | --- | --- |")
    for name in arguments.names or FAULTS:
        with tempfile.TemporaryDirectory() as folder:
            one = FAULTS[name](Path(folder), arguments.times)
        reported = one.reported.replace(folder, "…")
        note = f" ({one.note})" if one.note else ""
        print(
            f"| {one.injected}{note} | {one.sent} | {one.received} | {one.lost} | {one.bad} | {reported} |", flush=True
        )


if __name__ == "__main__":
    main()
