"""Tests of the history through the whole service: stored results, queries over Zenoh and damaged files."""

import json
import math
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.data_types import Event, SampleBlock
from drivers.recordings import save_samples
from monitor.common.shipped_config_paths import CONFIG_FOLDER
from monitor.common.unit_formatting import format_utc
from monitor.daemon.outputs.output import Output
from monitor.daemon.service import Service
from monitor.estimation.estimate import Estimate
from monitor.history import bucketed_history as past
from monitor.history.bucketed_history import HistoryTable
from monitor.history.sqlite_store import FILE_NAME, open_history
from monitor.history.stored_events import StoredEvent
from monitor.history.time_ranges import TimeRange
from monitor.noise.model_loading import read_model
from monitor.publishing.messages.history import decode_history
from monitor.settings import loading
from tests.support.ports import free_endpoint
from tests.support.waiting import FOREVER_S, PATIENCE_S, wait_for
from tests.support.zenoh_sessions import open_session

T0 = 1_600_000_020.0
SECONDS = 400
RATE_HZ = 50.0
MODEL = CONFIG_FOLDER / "models" / "consumer-mems.toml"
CONFIG_TEMPLATE = """
[[device]]
name = "bench-1"
rate = 50.0
window = "2min"
driver = {{ link = "replay", path = "{recording}", speed = {speed} }}
[zenoh]
{zenoh}
[viewer]
mode = "none"
[storage]
folder = "kept"
record = false
"""


class OutputCollector(Output):
    """Collects all published results."""

    def __init__(self) -> None:
        self.estimates: list[tuple[float, Estimate]] = []
        self.events: list[tuple[float, Event]] = []
        self.received = 0

    def publish_samples(self, device: str, received: int, samples: SampleBlock, offset_ns: int) -> None:
        self.received = received

    def publish_result(self, device: str, unix_s: float, received: int, result: Any) -> None:
        if isinstance(result, Estimate):
            self.estimates.append((unix_s, result))

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        self.events.append((unix_s, event))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Simulate a recording with a gap of two seconds."""
    path = tmp_path_factory.mktemp("recording") / "r.npz"
    n = round(SECONDS * RATE_HZ)
    drawn = read_model(MODEL).start_stream(RATE_HZ, 3).draw_samples_with_temperature(n)
    rows = np.delete(np.arange(n), slice(5000, 5100))
    save_samples(path, T0 + rows / RATE_HZ, drawn.values[rows], 20.0 + rows / 1000.0)
    return path


def write_and_load_config(
    folder: Path, recording: Path, zenoh: str = 'mode = "none"', speed: float = 100.0
) -> loading.Config:
    path = folder / "config.toml"
    path.write_text(CONFIG_TEMPLATE.format(recording=recording, zenoh=zenoh, speed=speed))
    return loading.load_config(path)


def read_stored_history(folder: Path, step_s: int | None = 60) -> HistoryTable:
    with open_history(folder / "kept" / FILE_NAME) as reader:
        return past.read_history(reader, "bench-1", TimeRange(-math.inf, math.inf), step_s=step_s)


@pytest.mark.long
def test_published_results_are_stored_and_a_second_run_adds_to_them(tmp_path: Path, recording: Path) -> None:
    output = OutputCollector()
    # At this speed, a loaded machine still publishes something in each minute of the recording.
    service = Service(write_and_load_config(tmp_path, recording, speed=20.0), [output])
    service.run(PATIENCE_S)
    assert service.output_states()["history"] == "ok"
    found = read_stored_history(tmp_path)
    minutes = found.start_s.tolist()
    assert set(minutes) <= {int(T0) + 60 * i for i in range(math.ceil(SECONDS / 60))}  # a busy machine may skip minutes
    assert len(minutes) >= 3
    n = found.select_column("gz.N")
    assert len(output.estimates) > 3
    for p, start_s in enumerate(found.start_s.tolist()):
        values = [
            estimate.coefficients.value[1, 2] for at, estimate in output.estimates if start_s <= at < start_s + 60
        ]
        values = [float(np.float32(value)) for value in values if not math.isnan(value)]
        assert n.n[p] == len(values)
        if values:
            assert (n.low[p], n.high[p], n.last[p]) == (min(values), max(values), values[-1])
    assert found.counts.sum(axis=0)[0] == output.received == round(SECONDS * RATE_HZ) - 100
    assert [(event.t_s, event.text) for event in found.events] == [(at, event.text) for at, event in output.events]
    assert found.select_column("temperature").low[0] == pytest.approx(20.0, abs=1.5)

    Service(write_and_load_config(tmp_path, recording)).run(PATIENCE_S)
    again = read_stored_history(tmp_path)
    assert set(again.start_s.tolist()) >= set(minutes)
    assert again.counts[:, 0].sum() == 2 * found.counts[:, 0].sum()


@pytest.fixture
def service_and_client(tmp_path: Path, recording: Path) -> Iterator[tuple[Service, Any]]:
    """Run a service with a stored history and connect a client to it."""
    endpoint = free_endpoint()
    Service(write_and_load_config(tmp_path, recording, speed=20.0)).run(PATIENCE_S)
    service = Service(write_and_load_config(tmp_path, recording, f'listen = ["{endpoint}"]', 1.0))
    thread = threading.Thread(target=service.run, args=(FOREVER_S,))
    thread.start()
    try:
        wait_for(lambda: service.zenoh.state == "ok")
        with open_session(connect=[endpoint]) as client:
            wait_for(lambda: list(client.get("imu/bench-1/history", timeout=PATIENCE_S)))
            yield service, client
    finally:
        service.request_stop()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


@pytest.mark.long
def test_query_over_zenoh_is_limited_to_its_time_range(service_and_client: tuple[Service, Any]) -> None:
    _, client = service_and_client

    def get_answer(parameters: str) -> Any:
        (reply,) = client.get(f"imu/*/history?{parameters}", timeout=PATIENCE_S)
        if reply.ok is None:
            return json.loads(bytes(reply.err.payload))["error"]
        assert (str(reply.ok.key_expr), str(reply.ok.encoding)) == ("imu/bench-1/history", "application/json")
        return decode_history(bytes(reply.ok.payload))

    whole = get_answer("step=1m")
    minutes = whole.start_s.tolist()
    assert len(minutes) >= 3
    first, last = (format_utc(t_s).replace(" ", "T") + "Z" for t_s in (minutes[1], minutes[2] + 60))
    part = get_answer(f"_time=[{first}..{last}[;step=1m;axis=gz;what=coefficients")
    assert part.start_s.tolist() == minutes[1:3]
    assert part.list_axes() == ("gz",)
    np.testing.assert_array_equal(part.select_column("gz.N").last, whole.select_column("gz.N").last[1:3])
    duration = get_answer(f"_time=[{first};60s[;step=60s")
    assert duration.start_s.tolist() == minutes[1:2]
    assert "did you mean" in get_answer("axes=gz")
    assert "no brackets" in get_answer("_time=yesterday")
    assert "no results in this time range; stored are 2020-09-13" in get_answer("_time=[now(-1h)..]")


@pytest.mark.long
def test_damaged_history_is_reported_in_the_status_and_to_queries(service_and_client: tuple[Service, Any]) -> None:
    service, client = service_and_client
    assert service.history is not None
    path = service.history.writer.path
    path.with_name(FILE_NAME + "-wal").unlink(missing_ok=True)
    path.write_bytes(b"no more" * 1000)
    (reply,) = client.get("imu/bench-1/history", timeout=PATIENCE_S)
    assert "damaged" in json.loads(bytes(reply.err.payload))["error"]
    service.history.writer.queue_item("bench-1", StoredEvent(T0, "moved", "once more"))
    wait_for(lambda: "damaged" in service.output_states()["history"])
    (renamed,) = path.parent.glob(f"{FILE_NAME}.aside-*Z")
    assert renamed.read_bytes() == b"no more" * 1000
