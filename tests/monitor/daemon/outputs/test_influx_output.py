"""Tests of the output to InfluxDB, with a server on loopback and an independent parser of the line protocol."""

import base64
import json
import ssl
import threading
from collections.abc import Iterator, MutableMapping, Sequence
from contextlib import closing, contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
import trustme
from hypothesis import given
from hypothesis import strategies as st
from structlog.testing import capture_logs

from drivers.data_types import Event
from monitor.common.device_health import Health
from monitor.daemon.operations.prometheus_metrics import MetricsOutput
from monitor.daemon.outputs import influx_output
from monitor.daemon.outputs.influx_output import MEASUREMENT, InfluxOutput, escape_tag_value, format_lines
from monitor.daemon.outputs.newest_metrics import LabelledValue, NamedMetric, NewestMetrics
from monitor.daemon.outputs.output import Output
from monitor.daemon.service import Service
from monitor.settings.loading import MetricsAddress, load_config
from tests.monitor.publishing import example_results
from tests.support.ports import free_port
from tests.support.waiting import FOREVER_S, stays_true, wait_for

parse_line = pytest.importorskip("line_protocol_parser", reason="line-protocol-parser is not installed").parse_line

PATH = "/api/v2/write?org=lab&bucket=imu"
STATUS_S, ESTIMATE_S = 1.76e9 + 0.5, 1.76e9 + 0.25

Point = dict[str, Any]


class Database(ThreadingHTTPServer):
    """Server that stores the received requests, and answers with ``status`` after ``may_answer`` is set."""

    daemon_threads = True
    block_on_close = False

    def __init__(self, port: int = 0) -> None:
        super().__init__(("127.0.0.1", port), _Handler)
        self.requests: list[tuple[str, str | None, str]] = []
        self.status = 204
        self.message = ""
        self.location = ""
        self.may_answer = threading.Event()
        self.may_answer.set()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}{PATH}"

    @property
    def bodies(self) -> list[str]:
        return [body for _, _, body in self.requests]

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore clients that have closed the connection."""


class _Handler(BaseHTTPRequestHandler):
    server: Database

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"])).decode()
        self.server.requests.append((self.path, self.headers["Authorization"], body))
        self.server.may_answer.wait(FOREVER_S)
        self.send_response(self.server.status)
        if self.server.location:
            self.send_header("Location", self.server.location)
        self.send_header("Content-Length", str(len(self.server.message)))
        self.end_headers()
        self.wfile.write(self.server.message.encode())

    def log_message(self, *_: Any) -> None:
        """Write nothing."""


@contextmanager
def run_database(port: int = 0, context: ssl.SSLContext | None = None) -> Iterator[Database]:
    with Database(port) as server:
        if context is not None:
            server.socket = context.wrap_socket(server.socket, server_side=True)
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
        thread.start()
        try:
            yield server
        finally:
            server.may_answer.set()
            server.shutdown()
            thread.join()


@contextmanager
def run_output(url: str, token_file: Path | None = None, interval_s: float = 0.0) -> Iterator[InfluxOutput]:
    """Run an output that sends a batch after each status, unless there is an interval."""
    with closing(InfluxOutput(url, token_file, interval_s)) as output:
        output.start()
        yield output


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(influx_output, "MIN_RETRY_S", 0.01)
    monkeypatch.setattr(influx_output, "MAX_RETRY_S", 0.05)


def log_lines(log: Sequence[MutableMapping[str, Any]], host: str) -> list[tuple[str, str]]:
    """Return the level and the text of the lines about one server. Threads of other tests may still be closing."""
    return [(line["log_level"], line["text"]) for line in log if line["text"].startswith(f"{host}:")]


def publish_example(output: NewestMetrics) -> None:
    """Publish an estimate, events and a status of the device a, and the status of the device b."""
    output.publish_result("a", ESTIMATE_S, 0, example_results.make_estimate())
    output.publish_event("a", STATUS_S, 1, Event("link_lost", 0, ""))
    output.publish_health("b", None, example_results.make_health(state="waiting"))
    output.publish_health("a", STATUS_S, example_results.make_health(outputs={"zenoh": "ok", "hook": "off"}))


def publish_status(output: InfluxOutput, received: int) -> None:
    output.publish_health("a", STATUS_S + received, example_results.make_health(received=received))


def parse_batch(body: str) -> list[Point]:
    return [parse_line(line) for line in body.split("\n")]


def received_counts(bodies: list[str]) -> list[float]:
    """Return the number of received samples in each batch."""
    points = [point for body in bodies for point in parse_batch(body)]
    name = "imu_monitor_samples_received_total"
    return [point["fields"][name] for point in points if name in point["fields"]]


# --- values


def test_points_have_the_names_and_values_of_the_prometheus_metrics() -> None:
    pytest.importorskip("prometheus_client", reason="prometheus-client is not installed")
    prometheus = MetricsOutput(MetricsAddress("127.0.0.1", 0))
    publish_example(prometheus)
    expected = {
        (sample.name, frozenset(sample.labels.items())): sample.value
        for family in prometheus.collect()
        for sample in family.samples
        if sample.labels.get("device") != "b"  # the time of its status is unknown
    }
    with run_database() as database:
        with run_output(database.url, interval_s=FOREVER_S) as output:
            publish_example(output)
        (body,) = database.bodies  # sent at the end
    found = {}
    for point in parse_batch(body):
        assert point["measurement"] == MEASUREMENT
        is_coefficient = "letter" in point["tags"]
        assert point["time"] == round((ESTIMATE_S if is_coefficient else STATUS_S) * 1e9)
        for name, value in point["fields"].items():
            assert isinstance(value, float)
            found[name, frozenset(point["tags"].items())] = value
    assert found == expected
    assert ("imu_monitor_coefficient", frozenset({"device": "a", "axis": "gx", "letter": "N"}.items())) in found


def test_value_and_interval_of_a_coefficient_are_one_point() -> None:
    output = NewestMetrics()
    publish_example(output)
    (point,) = [
        point
        for point in map(parse_line, format_lines(output.read_metrics()))
        if (point["tags"].get("axis"), point["tags"].get("letter")) == ("gx", "N")
    ]
    assert set(point["fields"]) == {f"imu_monitor_coefficient{end}" for end in ("", "_lo", "_hi")}


@given(st.text(st.characters(exclude_categories=("Cc", "Cs"))).filter(lambda text: text and text[-1] != "\\"))
def test_tag_values_are_escaped(text: str) -> None:
    metric = NamedMetric("f", "", ("a", "b"), (LabelledValue((text, "x"), 1.5, 2.0),), False)
    (line,) = format_lines([metric])
    assert parse_line(line) == {
        "measurement": MEASUREMENT,
        "tags": {"a": text, "b": "x"},
        "fields": {"f": 1.5},
        "time": 2_000_000_000,
    }


def test_only_the_three_special_characters_of_tag_values_are_escaped() -> None:
    """The reference of the line protocol ("Special characters") names comma, equals sign and space."""
    assert escape_tag_value('a,b=c d"e\\f#ü') == 'a\\,b\\=c\\ d"e\\f#ü'


@given(st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=False))  # the parser refuses subnormal numbers
def test_numbers_keep_all_digits(value: float) -> None:
    (line,) = format_lines([NamedMetric("f", "", (), (LabelledValue((), value, 2.0),), False)])
    assert parse_line(line)["fields"]["f"] == value


def test_a_value_is_sent_once_and_only_at_the_interval() -> None:
    with run_database() as database, run_output(database.url) as output:
        publish_example(output)  # two batches, because there are two statuses and no interval
        wait_for(lambda: len(database.bodies) == 2)
        publish_status(output, 7)
        wait_for(lambda: len(database.bodies) == 3)
        assert not any("letter" in point["tags"] for point in parse_batch(database.bodies[2]))
    with run_database() as database, run_output(database.url, interval_s=FOREVER_S) as output:
        publish_example(output)
        assert stays_true(lambda: not database.requests)


def test_removed_device_is_not_sent() -> None:
    with run_database() as database:
        with run_output(database.url, interval_s=FOREVER_S) as output:
            publish_example(output)
            publish_status(output, 1)
            output.publish_health("c", STATUS_S, example_results.make_health())
            output.remove_device("a")
        (body,) = database.bodies
    assert {point["tags"].get("device") for point in parse_batch(body)} == {"c", None}


# --- requests


def test_request_contains_the_token_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "token"
    with run_database() as database, run_output(database.url, file) as output:
        publish_status(output, 1)
        wait_for(lambda: output.state == f"{file}: No such file or directory; trying again")
        file.write_text("s3cret==\n")
        wait_for(lambda: database.requests)
        file.write_text("n3w")
        publish_status(output, 2)
        wait_for(lambda: len(database.requests) == 2)
        assert [(path, token) for path, token, _ in database.requests] == [
            (PATH, "Token s3cret=="),
            (PATH, "Token n3w"),
        ]


def test_malformed_token_is_reported_and_not_shown(tmp_path: Path) -> None:
    file = tmp_path / "token"
    file.write_text("s3cret\nX-Header: 1")
    with run_database() as database, run_output(database.url, file) as output:
        publish_status(output, 1)
        state = f"{file}: must contain the token, as one word of ASCII characters; trying again"
        wait_for(lambda: output.state == state)
        assert not database.requests


def test_redirection_does_not_send_the_token_to_another_server(tmp_path: Path) -> None:
    file = tmp_path / "token"
    file.write_text("s3cret")
    with run_database() as other, run_database() as database, run_output(database.url, file) as output:
        database.status, database.location = 307, other.url
        publish_status(output, 1)
        wait_for(lambda: "HTTP 307 Temporary Redirect; trying again" in output.state)
        database.status, database.location = 302, other.url
        wait_for(lambda: "HTTP 302 Found; trying again" in output.state)
        assert not other.requests


def test_https_needs_a_trusted_certificate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    authority = trustme.CA()
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    authority.issue_cert("127.0.0.1").configure_cert(context)
    authority.cert_pem.write_to_path(str(tmp_path / "ca.pem"))
    with run_database(context=context) as database:
        url = database.url.replace("http:", "https:")
        with run_output(url) as output:
            publish_status(output, 1)
            wait_for(lambda: "CERTIFICATE_VERIFY_FAILED" in output.state)
        assert not database.requests
        monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "ca.pem"))
        with run_output(url) as output:
            publish_status(output, 2)
            wait_for(lambda: database.requests)
            assert output.state == "ok"


# --- failures


def test_values_wait_for_a_server_that_is_away() -> None:
    port = free_port()
    with capture_logs() as log, run_output(f"http://127.0.0.1:{port}{PATH}") as output:
        for i in range(3):
            publish_status(output, i)
        wait_for(lambda: output.state == f"127.0.0.1:{port}: Connection refused; trying again")
        with run_database(port) as database:
            wait_for(lambda: len(database.bodies) == 3)
            assert received_counts(database.bodies) == [0.0, 1.0, 2.0]
            wait_for(lambda: output.state == "ok")
    assert log_lines(log, f"127.0.0.1:{port}") == [
        ("warning", f"127.0.0.1:{port}: Connection refused; trying again"),
        ("info", f"127.0.0.1:{port}: writing continues"),
    ]


@pytest.mark.parametrize(
    ("status", "reason"), [(401, "Unauthorized"), (404, "Not Found"), (503, "Service Unavailable")]
)
def test_values_wait_for_a_server_that_refuses_every_request(status: int, reason: str) -> None:
    with run_database() as database, capture_logs() as log, run_output(database.url) as output:
        database.status, database.message = status, '{"message":\n"not now"}'
        publish_status(output, 1)
        wait_for(lambda: len(database.requests) > 3)
        host = database.url.split("/")[2]
        assert output.state == f'{host}: HTTP {status} {reason}: {{"message": "not now"}}; trying again'
        database.status, database.message = 204, ""
        publish_status(output, 2)
        wait_for(lambda: output.state == "ok" and received_counts(database.bodies)[-2:] == [1.0, 2.0])
    assert [level for level, _ in log_lines(log, host)] == ["warning", "info"]


@pytest.mark.parametrize("status", [400, 413, 422])
def test_refused_values_are_counted_and_do_not_block_later_values(status: int) -> None:
    with run_database() as database, run_output(database.url) as output:
        database.status = status
        publish_status(output, 1)
        wait_for(lambda: "these values are dropped" in output.state)
        (body,) = database.bodies
        count = len(parse_batch(body))
        assert output.state.endswith(f"; these values are dropped ({count} points not stored)")
        database.status = 204
        publish_status(output, 2)
        wait_for(lambda: output.state == f"ok, but {count} points not stored")
        assert received_counts(database.bodies) == [1.0, 2.0]


def test_full_queue_drops_the_oldest_values(monkeypatch: pytest.MonkeyPatch) -> None:
    with run_database() as database, run_output(database.url) as output:
        publish_status(output, 0)
        wait_for(lambda: database.bodies)
        size, count = len(database.bodies[0]), len(parse_batch(database.bodies[0]))
        monkeypatch.setattr(influx_output, "MAX_QUEUED_BYTES", 4 * size)
        database.status = 503
        for i in range(1, 10):
            publish_status(output, i)
        wait_for(lambda: f"({5 * count} points not stored)" in output.state)
        known = len(database.requests)
        wait_for(lambda: len(database.requests) > known)
        database.status = 204
        wait_for(lambda: received_counts(database.bodies)[-4:] == [6.0, 7.0, 8.0, 9.0])
        wait_for(lambda: output.state == f"ok, but {5 * count} points not stored")


def test_server_that_does_not_answer_blocks_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(influx_output, "CLOSE_TIMEOUT_S", 0.1)
    with run_database() as database, capture_logs() as log:
        database.may_answer.clear()
        with run_output(database.url) as output:
            monkeypatch.setattr(influx_output, "TIMEOUT_S", FOREVER_S)
            publish_status(output, 1)
            wait_for(lambda: database.requests)
            publish_status(output, 2)  # returns although the request is pending
        assert log[-1]["text"].endswith("not sent before the end of the service")  # the end does not wait either


def test_request_without_an_answer_is_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(influx_output, "TIMEOUT_S", 0.2)
    with run_database() as database, run_output(database.url) as output:
        database.may_answer.clear()
        publish_status(output, 1)
        wait_for(lambda: output.state.endswith(": timed out; trying again"))
        database.may_answer.set()
        wait_for(lambda: output.state == "ok")


TOKEN = "zk/Pq8+tR2_vN5wX1=="
ECHOES = {
    "plain": TOKEN,
    "percent": quote(TOKEN, safe=""),
    "JSON": json.dumps({"headers": {"Authorization": f"Token {TOKEN}"}}).replace("/", r"\/"),
    "base64": base64.b64encode(f"Token {TOKEN}".encode()).decode(),
    "cut off": "x" * (influx_output.MAX_ANSWER_BYTES - 12) + TOKEN,
}


@pytest.mark.parametrize("status", [400, 401])
@pytest.mark.parametrize("notation", ECHOES)
def test_token_that_the_server_echoes_is_neither_in_the_state_nor_in_the_log(
    tmp_path: Path, notation: str, status: int
) -> None:
    (tmp_path / "token").write_text(f"{TOKEN}\n")
    with run_database() as database, capture_logs() as log, run_output(database.url, tmp_path / "token") as output:
        database.status, database.message = status, ECHOES[notation]
        publish_status(output, 1)
        wait_for(lambda: output.state != "ok" and log_lines(log, database.url.split("/")[2]))
        texts = [output.state, *(text for _, text in log_lines(log, database.url.split("/")[2]))]
    assert len(texts) >= 2
    for text in texts:
        assert f"HTTP {status}" in text
        assert "***" in text
        assert not any(part in text for part in (TOKEN[:10], ECHOES["percent"][:10], ECHOES["base64"][12:22]))


# --- service


class StateRecorder(Output):
    """Records the state of the output in each status."""

    def __init__(self) -> None:
        self.states: set[str] = set()

    def publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Record the state."""
        self.states.add(health.outputs["influx"])


def test_service_sends_its_results_and_reports_the_state(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    recorder = StateRecorder()
    with run_database() as database:
        file.write_text(
            '[[device]]\nname = "bench-1"\nrate = 100.0\nwindow = 60.0\ndriver = { link = "virtual", seed = 1 }\n'
            f'[zenoh]\nmode = "none"\n[viewer]\nmode = "none"\n[influx]\nurl = "{database.url}"\ninterval = "1s"\n'
        )
        service = Service(load_config(file), [recorder])
        thread = threading.Thread(target=service.run)
        thread.start()
        try:
            wait_for(lambda: any("letter=N" in body for body in database.bodies))
            database.status = 503
            wait_for(lambda: any("HTTP 503" in state for state in recorder.states))
        finally:
            database.status = 204
            service.request_stop()
            thread.join()
    assert "ok" in recorder.states
    points = [point for body in database.bodies for point in parse_batch(body)]
    assert {point["tags"].get("device") for point in points} == {"bench-1", None}
