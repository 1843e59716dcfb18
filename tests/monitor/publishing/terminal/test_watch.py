"""Tests of ``watch``: the lines of all kinds of messages, Allan deviations, and the end of the program."""

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.data_types import AXES, make_block
from drivers.zenoh.sample_message import encode_samples
from monitor.common import topics
from monitor.publishing.messages.results import AllanMessage, CoefficientsMessage, EventMessage, StatusMessage
from monitor.publishing.terminal.watch import RESULT_TOPICS, SAMPLE_TOPICS, json_line
from monitor.publishing.zenoh.publisher import ZenohPublisher
from monitor.publishing.zenoh.subscriber import ReceivedMessageOrLiveliness
from monitor.settings.loading import ZenohTable
from tests.monitor.publishing.example_results import make_estimate, make_health
from tests.monitor.publishing.messages.example_messages import EXAMPLES
from tests.support.ports import free_endpoint
from tests.support.waiting import PATIENCE_S

PROGRAM = [sys.executable, "-m", "imu_monitor", "watch"]


def make_samples() -> bytes:
    values = np.full((2, len(AXES)), np.nan)
    values[:, 2] = [1e-3, -0.1 - 0.2]
    return encode_samples("a", 17, make_block(np.array([10**18, 10**18 + 10**7]), values, lost=3))


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.json")), ids=lambda path: path.stem)
def test_line_contains_the_payload_as_received(path: Path) -> None:
    payload = json.dumps(json.loads(path.read_bytes()) | {"key of a newer daemon": [1, None]}, indent=2).encode()
    line = json_line(ReceivedMessageOrLiveliness("imu/a/status", payload))
    assert line.endswith("\n")
    assert line.count("\n") == 1
    assert json.loads(line) == {"key": "imu/a/status", "topic": "status", "message": json.loads(payload)}


def test_line_of_samples_contains_one_array_per_column() -> None:
    found = json.loads(json_line(ReceivedMessageOrLiveliness("lab/imu/a/compensated", make_samples())))
    assert (found["key"], found["topic"]) == ("lab/imu/a/compensated", "compensated")
    assert found["message"] == {
        "schema": "imu-monitor/compensated/1",
        "device": "a",
        "samples": 17,
        "lost": 3,
        "t": pytest.approx([1e9, 1e9 + 0.01], rel=1e-15),
        "gz": [1e-3, -0.1 - 0.2],
        **{name: [None, None] for name in ("gx", "gy", "ax", "ay", "az", "temperature")},
    }


@pytest.mark.parametrize(
    "payload",
    [b"", b"{", b"[1]", b"17", b'{"t": NaN}', b"\xff", b"[" * 100_000, b'{"t": "' + b" " * 1_000_000 + b'"}'],
    ids=lambda payload: ascii(payload[:8]),
)
@pytest.mark.parametrize("topic", ["status", "samples"])
def test_malformed_message_has_no_line(topic: str, payload: bytes) -> None:
    assert json_line(ReceivedMessageOrLiveliness(f"imu/a/{topic}", payload)) == ""


def test_every_published_topic_is_printed() -> None:
    published = [one for one in topics.TOPICS if one.when != "query" and one is not topics.ALIVE]
    assert {*RESULT_TOPICS, *SAMPLE_TOPICS} == {*published}


@contextlib.contextmanager
def run_daemon(endpoint: str, *messages: tuple[topics.ZenohTopic, bytes], period_s: float = 0.1) -> Iterator[None]:
    """Run a session that repeats messages."""
    publisher, ending = ZenohPublisher(ZenohTable(listen=(endpoint,)), ["a"]), threading.Event()

    def send_messages() -> None:
        while not ending.wait(period_s):
            for topic, payload in messages:
                publisher.put(topic, "a", payload)

    publisher.start()
    publisher.set_alive("a", True)
    sender = threading.Thread(target=send_messages)
    sender.start()
    try:
        yield
    finally:
        ending.set()
        sender.join()
        publisher.close()


@contextlib.contextmanager
def run_watch(*arguments: str) -> Iterator["subprocess.Popen[str]"]:
    command = [*PROGRAM, *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


EVENT = EventMessage(device="a", t=1.0, kind="moved", text="moved").encode()


def test_messages_arrive_line_by_line_until_an_interrupt() -> None:
    endpoint = free_endpoint()
    sent = [(topics.EVENT, EVENT), (topics.SAMPLES, make_samples())]
    sent += [(one, b'{"schema": 1}') for one in RESULT_TOPICS if one is not topics.EVENT]
    with run_daemon(endpoint, *sent), run_watch("--json", "imu/**", "--connect", endpoint) as process:
        assert process.stdout is not None
        seen: dict[str, object] = {}
        while seen.keys() < {
            "alive",
            *(one.name for one in RESULT_TOPICS),
        }:  # each line arrives although the program still runs
            line = json.loads(process.stdout.readline())
            seen[line["topic"]] = line["message"]
        process.send_signal(signal.SIGINT)
        rest, errors = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0
        assert errors == ""
        assert seen["alive"] == {"device": "a", "alive": True}
        assert seen["event"] == json.loads(EVENT)
        assert "samples" not in {json.loads(line)["topic"] for line in rest.splitlines()}


@pytest.mark.parametrize("topic", ["samples", "compensated"])
def test_samples_are_printed_if_the_key_expression_names_them(topic: str) -> None:
    endpoint = free_endpoint()
    sent = [(one, make_samples()) for one in SAMPLE_TOPICS]
    with run_daemon(endpoint, *sent), run_watch("--json", f"imu/*/{topic}", "--connect", endpoint) as process:
        assert process.stdout is not None
        found = json.loads(process.stdout.readline())
        assert found["topic"] == topic
        assert found["message"]["gz"] == [1e-3, -0.1 - 0.2]


@pytest.mark.parametrize(("keyexpr", "drawn"), [("imu/a", True), ("imu/**", False)])
def test_allan_deviations_are_drawn_if_the_key_expression_names_the_device(keyexpr: str, drawn: bool) -> None:
    endpoint = free_endpoint()
    sent = [
        (topics.STATUS, StatusMessage.from_result("a", 1.0, 100, make_health()).encode()),
        (topics.COEFFICIENTS, CoefficientsMessage.from_result("a", 1.0, 100, make_estimate()).encode()),
        (topics.ALLAN, AllanMessage.from_result("a", 1.0, 100, make_estimate()).encode()),
    ]
    with run_daemon(endpoint, *sent), run_watch(keyexpr, "--connect", endpoint) as process:
        assert process.stdout is not None
        tables = 0
        while tables < 3:  # the first table with coefficients may precede the first Allan deviations
            line = process.stdout.readline()
            tables += line.startswith("gx ")
            if drawn and line.startswith("Gyroscopes: Allan deviation"):
                return
            assert "Allan" not in line
        assert not drawn


def test_program_ends_when_the_reader_closes_the_pipe() -> None:
    endpoint = free_endpoint()
    with (
        run_daemon(endpoint, (topics.EVENT, EVENT), period_s=0.3),
        run_watch("--json", "imu/*/event", "--connect", endpoint) as process,
    ):
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())["topic"] == "event"
        process.stdout.close()
        assert process.wait(PATIENCE_S) == 0
        assert process.stderr is not None
        assert process.stderr.read() == ""


def test_program_notices_a_closed_pipe_without_further_messages() -> None:
    reading, writing = os.pipe()
    command = [*PROGRAM, "--json", "--connect", free_endpoint()]  # nothing listens at this address
    with subprocess.Popen(command, stdout=writing, stderr=subprocess.DEVNULL) as process:
        os.close(writing)
        time.sleep(1.0)
        assert process.poll() is None
        os.close(reading)
        assert process.wait(PATIENCE_S) == 0


def test_connection_problem_and_duration() -> None:
    endpoint = free_endpoint()
    with run_watch("--json", "--connect", endpoint, "--seconds", "1") as process:
        out, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert out == ""
    assert errors.startswith(f"imu-monitor: nobody at {endpoint}; trying again\n")


def test_full_disk_is_an_error() -> None:
    endpoint = free_endpoint()
    with run_daemon(endpoint, (topics.EVENT, EVENT)), Path("/dev/full").open("w") as disk:
        command = [*PROGRAM, "--json", "--connect", endpoint]
        found = subprocess.run(command, stdout=disk, stderr=subprocess.PIPE, text=True, timeout=PATIENCE_S, check=False)
    assert found.returncode == 1
    assert found.stderr == "imu-monitor: [Errno 28] No space left on device\n"


@pytest.mark.skipif(shutil.which("jq") is None, reason="jq is not installed")
def test_jq_filters_of_the_documentation() -> None:
    """The filters in docs/reference/messages.md print the numeric values in a message."""
    text = (Path(__file__).parents[4] / "docs" / "reference" / "messages.md").read_text()
    filters = re.findall(r"watch --json '(\S+/(\w+))' \| jq (-r )?'([^']+)'", text)
    assert [topic for _, topic, _, _ in filters] == ["coefficients", "samples"]
    coefficients = (EXAMPLES / "coefficients.json").read_bytes()
    message = json.loads(coefficients)
    payloads = {"coefficients": coefficients, "samples": make_samples()}
    expected = {
        "coefficients": [["bench-1", message["t"], message["axes"]["gz"]["N"]["value"]]],
        "samples": [[1e9, 1e-3], [1e9 + 0.01, -0.1 - 0.2]],
    }
    for _, topic, raw, jq_filter in filters:
        line = json_line(ReceivedMessageOrLiveliness(f"imu/bench-1/{topic}", payloads[topic]))
        command = ["jq", *raw.split(), jq_filter]
        found = subprocess.run(command, input=line, capture_output=True, text=True, check=True).stdout
        rows = [
            [float(cell) if cell[0] in "-0123456789" else cell for cell in re.split("[,\t]", row)]
            for row in found.splitlines()
        ]
        for row, numbers in zip(rows, expected[topic], strict=True):
            assert row[:-2] == numbers[:-2]
            assert row[-2:] == pytest.approx(numbers[-2:], rel=1e-15)
