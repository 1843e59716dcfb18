"""Tests of samples received over zenoh, and of every zenoh key that the service publishes, through a router."""

import csv
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from drivers.zenoh.sample_message import decode_samples
from monitor.common import topics
from tests.support.ports import free_endpoint
from tests.support.recordings import recordings
from tests.support.waiting import PATIENCE_S, wait_for
from tests.support.zenoh_sessions import open_router, patient_file
from tests.system.rig import PluggableTerminal, run_service


@pytest.fixture
def router() -> Iterator[str]:
    endpoint = free_endpoint()
    with open_router(endpoint):
        yield endpoint


@pytest.mark.data
def test_recording_from_another_process_gives_the_published_allan_deviations(tmp_path: Path, router: str) -> None:
    folder = recordings()
    path = folder / "adis16405" / "run1.npz"
    with (folder / "reference" / "avar-package-allan-tables.csv").open() as file:
        wanted = ("adis", "Gyroscope", "X")
        rows = [row for row in csv.DictReader(file) if (row["key"], row["type"], row["axis"]) == wanted]
    table = {round(float(row["tau_as_listed_s"]) * 100): np.radians(float(row["adev"])) for row in rows}
    config = f"""[[device]]
name = "run1"
rate = 100.0
window = 10000.0
publish = "100 Hz"  # the publisher waits until its samples are published
restart = false  # the whole recording is compared
driver = {{ link = "zenoh", key = "lab/run1", mode = "client", connect = ["{router}"], silence = 30.0 }}
[zenoh]
mode = "none"
[viewer]
mode = "none"
"""
    with run_service(tmp_path, config) as run:
        counts = run.worker("run1").driver.counts
        worker = run.worker("run1")
        rows = min(20_000, worker.ring.capacity // 2)
        command = [sys.executable, "-m", "tests.system.publisher", str(path), "lab/run1", router, str(rows)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, text=True) as publisher:
            assert publisher.stdin is not None
            for allowed in range(rows, 1_000_000 + rows, rows):
                publisher.stdin.write("\n")
                publisher.stdin.flush()
                # a block that is not complete yet has not been sent
                wanted = min(allowed - allowed % 1000, 1_000_000)
                wait_for(lambda wanted=wanted: worker.publisher.published >= wanted, "the samples")  # type: ignore[misc]
            publisher.stdin.close()
            assert publisher.wait(PATIENCE_S) == 0
    assert (counts.received, counts.bad, counts.lost, run.worker("run1").ring.overflowed) == (1_000_000, 0, 0, 0)
    curve = run.output.estimates["run1"].curve
    shared = [(i, table[int(m)]) for i, m in enumerate(curve.factors) if int(m) in table]
    assert len(shared) >= 15
    indices, want = map(list, zip(*shared, strict=True))
    np.testing.assert_allclose(np.sqrt(curve.avar[indices, 0]), want, rtol=1e-5)


LISTENER = """
import sys, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("scouting/multicast/enabled", "false")
config.insert_json5("connect/endpoints", f'["{sys.argv[1]}"]')
with zenoh.open(config) as session:
    data = session.declare_subscriber("imu/**", zenoh.handlers.FifoChannel(10000))
    alive = session.liveliness().declare_subscriber("imu/**", zenoh.handlers.FifoChannel(100), history=True)
    print("ready", flush=True)
    for line in sys.stdin:
        for verb in line.split():
            for reply in session.get(f"imu/bench-1/command/{verb}", timeout=float(sys.argv[2])):
                answer = reply.ok or reply.err
                print("reply", bytes(answer.payload).hex(), str(answer.encoding), flush=True)
        for sample in iter(alive.try_recv, None):
            print("alive", sample.key_expr, sample.kind == zenoh.SampleKind.PUT, flush=True)
        for sample in iter(data.try_recv, None):
            print("data", sample.key_expr, sample.encoding, bytes(sample.payload).hex(), flush=True)
        print("done", flush=True)
"""


class Listener:
    """zenoh client in a separate process, which receives all messages of the service."""

    def __init__(self, endpoint: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", LISTENER, endpoint, str(PATIENCE_S)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == "ready\n"
        self.messages: dict[str, list[tuple[str, bytes]]] = {}
        self.alive: list[tuple[str, bool]] = []
        self.replies: list[tuple[str, Any]] = []

    def poll(self, *verbs: str) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(" ".join(verbs) + "\n")
        self._process.stdin.flush()
        for line in self._process.stdout:
            word, *rest = line.split()
            if word == "done":
                return
            if word == "alive":
                self.alive.append((rest[0], rest[1] == "True"))
            elif word == "reply":
                self.replies.append((rest[1], msgspec.json.decode(bytes.fromhex(rest[0]))))
            else:
                self.messages.setdefault(rest[0], []).append((rest[1], bytes.fromhex(rest[2])))

    def poll_and_check(self, condition: Any) -> bool:
        self.poll()
        return bool(condition())

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        assert self._process.wait(PATIENCE_S) == 0
        assert self._process.stdout is not None
        self._process.stdout.close()


def test_client_behind_a_router_receives_every_key(tmp_path: Path, router: str) -> None:
    config = f"""[[device]]
name = "bench-1"
rate = 100.0
model = "consumer-mems"
driver = {{ link = "virtual", silence = 300.0 }}  # an unplugged sensor is detected without this limit
[zenoh]
config = "{patient_file(tmp_path)}"
mode = "peer"
listen = ["{free_endpoint()}"]
connect = ["{router}"]
[viewer]
mode = "none"
"""
    wanted = [t for t in topics.TOPICS if t.when in ("batches", "publish", "event", "1 Hz")]
    keys = {topic.key("imu", "bench-1") for topic in wanted}
    listener = Listener(router)
    with run_service(tmp_path, config) as run:
        imu = run.worker("bench-1").simulated
        wait_for(
            lambda: listener.poll_and_check(lambda: "imu/bench-1/coefficients" in listener.messages), "coefficients"
        )
        wait_for(lambda: listener.poll_and_check(lambda: listener.alive), "the token")
        assert listener.alive == [("imu/bench-1/alive", True)]
        imu.port.unplug()
        wait_for(lambda: listener.poll_and_check(lambda: len(listener.alive) == 2), "the token to go")
        imu.port.plug()
        wait_for(lambda: listener.poll_and_check(lambda: len(listener.alive) == 3), "the token to come back")
        assert listener.alive[1:] == [("imu/bench-1/alive", False), ("imu/bench-1/alive", True)]
        wait_for(lambda: listener.poll_and_check(lambda: len(event_kinds(listener)) >= 2), "both events")
        listener.poll("reset", "jump")
        wait_for(lambda: listener.poll_and_check(lambda: keys <= set(listener.messages)), "every key")
    listener.poll()
    listener.close()
    # only on a slow machine does the test last until the first total deviations
    assert keys <= set(listener.messages) <= keys | {topics.TOTAL.key("imu", "bench-1")}
    for topic in wanted:
        for encoding, payload in listener.messages[topic.key("imu", "bench-1")]:
            assert encoding == topic.encoding
            if topic.encoding == topics.JSON:
                content = msgspec.json.decode(payload)
                assert content["schema"] == topic.schema_name()
                assert content["device"] == "bench-1"
                assert content["t"] > 1.7e9
                assert content["samples"] >= 0
    batches = [decode_samples(payload) for _, payload in listener.messages["imu/bench-1/samples"]]
    # samples before the first batch were sent before the three zenoh sessions were connected
    assert sum(len(batch.block) for batch in batches[1:]) == batches[-1].total_samples - batches[0].total_samples
    assert batches[-1].total_samples == run.worker("bench-1").driver.counts.received
    assert {"link_lost", "link_back"} <= set(event_kinds(listener))
    (ok_encoding, ok), (error_encoding, error) = listener.replies
    assert ok_encoding == error_encoding == topics.JSON
    assert ok["device"] == "bench-1"
    assert "reset" in error["error"]


def event_kinds(listener: Listener) -> list[str]:
    return [msgspec.json.decode(payload)["kind"] for _, payload in listener.messages.get("imu/bench-1/event", [])]


def test_unplugged_cable_loses_only_the_incomplete_line(tmp_path: Path) -> None:
    """The bytes stop in the middle of a line. The partial line is discarded, and the next complete line is decoded."""
    terminal = PluggableTerminal(tmp_path)
    config = f"""[[device]]
name = "board"
rate = 100.0
driver = {{ link = "serial", port = "{terminal.port}", decoder = "text", decoder_options = {{ columns = ["gx"] }} }}
[zenoh]
mode = "none"
[viewer]
mode = "none"
"""
    with run_service(tmp_path, config) as run:
        worker = run.worker("board")
        wait_for(lambda: worker.driver.link._port is not None, "the port")
        terminal.write(b"0.1\n0.2\n0.3\n0.")
        wait_for(lambda: worker.driver.counts.received == 2, "two complete lines after the first")
        terminal.pull()
        wait_for(lambda: worker.driver.state == "lost", "the loss")
        terminal.plug()
        wait_for(lambda: worker.driver.link._port is not None, "the port again")
        terminal.write(b"4\n0.5\n0.6\n")
        wait_for(lambda: worker.driver.counts.received == 4, "two more lines")
    assert run.output.values("board")[:, 0].tolist() == [0.2, 0.3, 0.5, 0.6]
