"""Tests of the Prometheus metrics: values, address, errors and clients that send nothing."""

import contextlib
import socket
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from drivers.data_types import AXES, Event
from monitor.daemon.operations.prometheus_metrics import MAX_CONNECTIONS, MISSING_LIBRARY_TEXT, MetricsOutput
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Status
from monitor.settings.loading import MetricsAddress
from tests.monitor.publishing import example_results
from tests.support.waiting import FOREVER_S, PATIENCE_S, wait_for

pytest.importorskip("prometheus_client", reason="prometheus-client is not installed")

from prometheus_client.parser import text_string_to_metric_families

Numbers = dict[tuple[str, tuple[tuple[str, str], ...]], float]


@contextmanager
def serve_metrics(port: int = 0, host: str = "127.0.0.1") -> Iterator[MetricsOutput]:
    output = MetricsOutput(MetricsAddress(host, port))
    output.start()
    try:
        yield output
    finally:
        output.close()


def scrape(port: int, path: str = "/metrics", host: str = "127.0.0.1") -> Numbers:
    with urllib.request.urlopen(f"http://{host}:{port}{path}", timeout=PATIENCE_S) as answer:
        assert answer.headers["Content-Type"].startswith("text/plain")
        text = answer.read().decode()
    found: Numbers = {}
    for family in text_string_to_metric_families(text):
        assert family.documentation
        for sample in family.samples:
            found[sample.name, tuple(sorted(sample.labels.items()))] = sample.value
    return found


def get_metric(numbers: Numbers, name: str, **labels: str) -> float:
    return numbers[f"imu_monitor_{name}", tuple(sorted(labels.items()))]


def test_metrics_are_the_newest_values_in_si_units() -> None:
    estimate = example_results.make_estimate()
    health = example_results.make_health(
        outputs={"zenoh": "ok", "viewer": "stalled (3 dropped)", "hook": "off"}, crossed=("gz N",)
    )
    with serve_metrics() as output:
        wait_for(lambda: output.state == "ok")
        output.publish_health("a", 0.0, example_results.make_health(received=1))
        output.publish_health("a", 0.0, health)
        output.publish_health("b", 0.0, replace(health, state="lost", rate_hz=None, latency_p50_s=None))
        output.publish_result("a", 0.0, 0, estimate)
        for _ in range(3):
            output.publish_event("a", 0.0, 1, Event("link_lost", 0, ""))
        numbers = scrape(output.port)
    for name in ("received", "lost", "bad", "overflowed", "repeated", "late"):
        assert get_metric(numbers, f"samples_{name}_total", device="a") == getattr(health, name)
    assert get_metric(numbers, "sample_rate_hertz", device="a") == health.rate_hz
    assert ("imu_monitor_sample_rate_hertz", (("device", "b"),)) not in numbers
    assert get_metric(numbers, "latency_seconds", device="a", quantile="0.5") == health.latency_p50_s
    assert get_metric(numbers, "latency_seconds", device="b", quantile="0.99") == health.latency_p99_s
    assert [get_metric(numbers, "state", device="b", state=state) for state in ("running", "lost")] == [0.0, 1.0]
    assert get_metric(numbers, "limits_crossed", device="a") == 1.0
    assert get_metric(numbers, "memory_bytes") == health.memory_bytes
    assert (get_metric(numbers, "output_up", output="zenoh"), get_metric(numbers, "output_up", output="viewer")) == (
        1.0,
        0.0,
    )
    assert get_metric(numbers, "events_total", device="a", kind="link_lost") == 3.0
    table = estimate.coefficients
    statuses = set()
    for row, letter in enumerate(SYMBOLS):
        for column, axis in enumerate(AXES):
            labels = {"device": "a", "axis": axis, "letter": letter}
            key = tuple(sorted(labels.items()))
            statuses.add(int(table.status[row, column]))
            for name, value in (("", table.value), ("_lo", table.lo), ("_hi", table.hi)):
                found = numbers.get((f"imu_monitor_coefficient{name}", key))
                expected = value[row, column]
                assert found == (expected if np.isfinite(expected) else None)
    assert Status.ESTIMATED in statuses


def test_removed_device_has_no_metrics() -> None:
    with serve_metrics() as output:
        wait_for(lambda: output.state == "ok")
        for name in ("a", "b"):
            output.publish_health(name, 0.0, example_results.make_health())
            output.publish_result(name, 0.0, 0, example_results.make_estimate())
            output.publish_event(name, 0.0, 1, Event("moved", 0, ""))
        output.remove_device("a")
        devices = {dict(labels).get("device") for _, labels in scrape(output.port)}
    assert devices == {"b", None}


def test_only_the_metrics_path_is_served_and_empty_at_first() -> None:
    with serve_metrics() as output:
        wait_for(lambda: output.state == "ok")
        assert scrape(output.port) == {}
        with pytest.raises(urllib.error.HTTPError) as refused:
            scrape(output.port, "/etc/passwd")
        refused.value.close()
        assert refused.value.code == 404


def test_used_port_is_reported_and_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("monitor.daemon.operations.prometheus_metrics.RETRY_S", 0.05)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        output = MetricsOutput(MetricsAddress("127.0.0.1", port))
        output.start()
        state = f"127.0.0.1:{port}: Address already in use; trying again"
        wait_for(lambda: output.state == state)
    try:
        wait_for(lambda: output.state == "ok")
        assert scrape(port) == {}
    finally:
        output.close()
    with pytest.raises(urllib.error.URLError):
        scrape(port)


def test_slow_clients_do_not_block_the_server(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("monitor.daemon.operations.prometheus_metrics.TIMEOUT_S", FOREVER_S)
    with serve_metrics() as output:
        wait_for(lambda: output.state == "ok")
        slow_clients = [socket.create_connection(("127.0.0.1", output.port)) for _ in range(3 * MAX_CONNECTIONS)]
        try:
            for client in slow_clients:
                with contextlib.suppress(OSError):  # the server has ended the oldest connections
                    client.sendall(b"GET /metrics HTTP/1.1\r\n")
            assert can_scrape(output.port)
            wait_for(lambda: count_server_threads() <= MAX_CONNECTIONS)
        finally:
            for client in slow_clients:
                client.close()


def count_server_threads() -> int:
    return sum("process_request_thread" in thread.name for thread in threading.enumerate())


def can_scrape(port: int) -> bool:
    try:
        return scrape(port) == {}
    except (OSError, urllib.error.URLError):
        return False


def test_server_listens_on_the_configured_address() -> None:
    if not socket.has_ipv6:
        pytest.skip("no IPv6")
    with serve_metrics(host="::1") as output:
        wait_for(lambda: output.state != "starting")
        if output.state != "ok":
            pytest.skip(f"no IPv6 on loopback: {output.state}")
        assert scrape(output.port, host="[::1]") == {}


def test_missing_library_is_reported_with_the_package_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "prometheus_client", None)
    with serve_metrics() as output:
        wait_for(lambda: output.state == MISSING_LIBRARY_TEXT)
