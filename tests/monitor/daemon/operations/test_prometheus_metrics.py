"""Prometheus finds the newest numbers on loopback; whoever asks badly, or too often, holds up nobody."""

import socket
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from drivers.data_types import AXES, Event
from monitor.daemon.operations.prometheus_metrics import MAX_SCRAPES, MISSING_LIBRARY_TEXT, MetricsOutput
from monitor.estimation.fit.coefficient_values import SYMBOLS, Status
from monitor.settings.loading import MetricsAddress
from tests.monitor.publishing import made
from tests.support.waiting import PATIENCE_S, wait_for

pytest.importorskip("prometheus_client", reason="prometheus-client is not installed")

from prometheus_client.parser import text_string_to_metric_families

Numbers = dict[tuple[str, tuple[tuple[str, str], ...]], float]


@contextmanager
def serving(port: int = 0, host: str = "127.0.0.1") -> Iterator[MetricsOutput]:
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


def at(numbers: Numbers, name: str, **labels: str) -> float:
    return numbers[f"imu_monitor_{name}", tuple(sorted(labels.items()))]


def test_every_number_is_the_newest_one_in_si() -> None:
    estimate = made.estimate()
    health = made.health(outputs={"zenoh": "ok", "viewer": "stalled (3 dropped)", "hook": "off"}, crossed=("gz N",))
    with serving() as output:
        wait_for(lambda: output.state == "ok")
        output.publish_health("a", 0.0, made.health(received=1))
        output.publish_health("a", 0.0, health)
        output.publish_health("b", 0.0, replace(health, state="lost", rate_hz=None, latency_p50_s=None))
        output.publish_result("a", 0.0, 0, estimate)
        for _ in range(3):
            output.publish_event("a", 0.0, 1, Event("link_lost", 0, ""))
        numbers = scrape(output.port)
    for name in ("received", "lost", "bad", "overflowed", "repeated", "late"):
        assert at(numbers, f"samples_{name}_total", device="a") == getattr(health, name)
    assert at(numbers, "sample_rate_hertz", device="a") == health.rate_hz
    assert ("imu_monitor_sample_rate_hertz", (("device", "b"),)) not in numbers
    assert at(numbers, "latency_seconds", device="a", quantile="0.5") == health.latency_p50_s
    assert at(numbers, "latency_seconds", device="b", quantile="0.99") == health.latency_p99_s
    assert [at(numbers, "state", device="b", state=state) for state in ("running", "lost")] == [0.0, 1.0]
    assert at(numbers, "limits_crossed", device="a") == 1.0
    assert at(numbers, "memory_bytes") == health.memory_bytes
    assert (at(numbers, "output_up", output="zenoh"), at(numbers, "output_up", output="viewer")) == (1.0, 0.0)
    assert at(numbers, "events_total", device="a", kind="link_lost") == 3.0
    table = estimate.coefficients
    statuses = set()
    for row, letter in enumerate(SYMBOLS):
        for column, axis in enumerate(AXES):
            labels = {"device": "a", "axis": axis, "letter": letter}
            key = tuple(sorted(labels.items()))
            statuses.add(int(table.status[row, column]))
            for name, value in (("", table.value), ("_lo", table.lo), ("_hi", table.hi)):
                given = numbers.get((f"imu_monitor_coefficient{name}", key))
                wanted = value[row, column]
                assert given == (wanted if np.isfinite(wanted) else None)
    assert Status.ESTIMATED in statuses


def test_a_device_that_is_gone_has_no_numbers() -> None:
    with serving() as output:
        wait_for(lambda: output.state == "ok")
        for name in ("a", "b"):
            output.publish_health(name, 0.0, made.health())
            output.publish_result(name, 0.0, 0, made.estimate())
            output.publish_event(name, 0.0, 1, Event("moved", 0, ""))
        output.remove_device("a")
        devices = {dict(labels).get("device") for _, labels in scrape(output.port)}
    assert devices == {"b", None}


def test_nothing_is_served_before_there_is_anything_and_nothing_but_the_numbers() -> None:
    with serving() as output:
        wait_for(lambda: output.state == "ok")
        assert scrape(output.port) == {}
        with pytest.raises(urllib.error.HTTPError) as refused:
            scrape(output.port, "/etc/passwd")
        refused.value.close()
        assert refused.value.code == 404


def test_a_port_that_is_taken_is_said_and_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("monitor.daemon.operations.prometheus_metrics.RETRY_S", 0.05)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        output = MetricsOutput(MetricsAddress("127.0.0.1", port))
        output.start()
        said = f"127.0.0.1:{port}: Address already in use; trying again"
        wait_for(lambda: output.state == said)
    try:
        wait_for(lambda: output.state == "ok")
        assert scrape(port) == {}
    finally:
        output.close()
    with pytest.raises(urllib.error.URLError):
        scrape(port)


def test_those_who_connect_and_say_nothing_keep_nobody_out_for_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("monitor.daemon.operations.prometheus_metrics.TIMEOUT_S", 1.0)
    with serving() as output:
        wait_for(lambda: output.state == "ok")
        mute = [socket.create_connection(("127.0.0.1", output.port)) for _ in range(3 * MAX_SCRAPES)]
        try:
            wait_for(lambda: answers(output.port))
        finally:
            for one in mute:
                one.close()


def answers(port: int) -> bool:
    try:
        return scrape(port) == {}
    except (OSError, urllib.error.URLError):
        return False


def test_it_listens_on_the_address_that_was_said() -> None:
    if not socket.has_ipv6:
        pytest.skip("no IPv6")
    with serving(host="::1") as output:
        wait_for(lambda: output.state != "starting")
        if output.state != "ok":
            pytest.skip(f"no IPv6 on loopback: {output.state}")
        assert scrape(output.port, host="[::1]") == {}


def test_without_the_library_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "prometheus_client", None)
    with serving() as output:
        wait_for(lambda: output.state == MISSING_LIBRARY_TEXT)
