"""History through the whole service: a recording replayed, what is kept of it, and what a query over zenoh answers."""

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
from monitor.history import history_table as past
from monitor.history.history_table import HistoryTable
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
CONFIG = """
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


class Told(Output):
    """All that was published."""

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
    """With a hole of two seconds in it."""
    path = tmp_path_factory.mktemp("recording") / "r.npz"
    n = round(SECONDS * RATE_HZ)
    drawn = read_model(MODEL).start_stream(RATE_HZ, 3).draw_samples_with_temperature(n)
    rows = np.delete(np.arange(n), slice(5000, 5100))
    save_samples(path, T0 + rows / RATE_HZ, drawn.values[rows], 20.0 + rows / 1000.0)
    return path


def config(folder: Path, recording: Path, zenoh: str = 'mode = "none"', speed: float = 100.0) -> loading.Config:
    path = folder / "config.toml"
    path.write_text(CONFIG.format(recording=recording, zenoh=zenoh, speed=speed))
    return loading.load_config(path)


def kept(folder: Path, step_s: int | None = 60) -> HistoryTable:
    with open_history(folder / "kept" / FILE_NAME) as reader:
        return past.read_history(reader, "bench-1", TimeRange(-math.inf, math.inf), step_s=step_s)


@pytest.mark.long
def test_what_was_published_is_kept_and_a_second_run_adds_to_it(tmp_path: Path, recording: Path) -> None:
    told = Told()
    # slow enough that each minute of the recording lasts seconds, in which a loaded machine publishes something
    service = Service(config(tmp_path, recording, speed=20.0), [told])
    service.run(PATIENCE_S)
    assert service.output_states()["history"] == "ok"
    found = kept(tmp_path)
    minutes = found.start_s.tolist()
    assert set(minutes) <= {int(T0) + 60 * i for i in range(math.ceil(SECONDS / 60))}  # a busy machine skips some
    assert len(minutes) >= 3
    n = found.select_column("gz.N")
    assert len(told.estimates) > 3
    for p, start_s in enumerate(found.start_s.tolist()):
        values = [one.coefficients.value[1, 2] for at, one in told.estimates if start_s <= at < start_s + 60]
        values = [float(np.float32(one)) for one in values if not math.isnan(one)]
        assert n.n[p] == len(values)
        if values:
            assert (n.low[p], n.high[p], n.last[p]) == (min(values), max(values), values[-1])
    assert found.counts.sum(axis=0)[0] == told.received == round(SECONDS * RATE_HZ) - 100
    assert [(one.t_s, one.text) for one in found.events] == [(at, event.text) for at, event in told.events]
    assert found.select_column("temperature").low[0] == pytest.approx(20.0, abs=1.5)

    Service(config(tmp_path, recording)).run(PATIENCE_S)
    again = kept(tmp_path)
    assert set(again.start_s.tolist()) >= set(minutes)
    assert again.counts[:, 0].sum() == 2 * found.counts[:, 0].sum()


@pytest.fixture
def asked(tmp_path: Path, recording: Path) -> Iterator[tuple[Service, Any]]:
    """A service that runs on for a while, and a session beside it."""
    endpoint = free_endpoint()
    Service(config(tmp_path, recording, speed=20.0)).run(PATIENCE_S)
    service = Service(config(tmp_path, recording, f'listen = ["{endpoint}"]', 1.0))
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
def test_a_query_over_zenoh_honours_its_time(asked: tuple[Service, Any]) -> None:
    _, client = asked

    def answer(parameters: str) -> Any:
        (reply,) = client.get(f"imu/*/history?{parameters}", timeout=PATIENCE_S)
        if reply.ok is None:
            return json.loads(bytes(reply.err.payload))["error"]
        assert (str(reply.ok.key_expr), str(reply.ok.encoding)) == ("imu/bench-1/history", "application/json")
        return decode_history(bytes(reply.ok.payload))

    whole = answer("step=1m")
    minutes = whole.start_s.tolist()
    assert len(minutes) >= 3
    first, last = (format_utc(one).replace(" ", "T") + "Z" for one in (minutes[1], minutes[2] + 60))
    some = answer(f"_time=[{first}..{last}[;step=1m;axis=gz;what=coefficients")
    assert some.start_s.tolist() == minutes[1:3]
    assert some.list_axes() == ("gz",)
    np.testing.assert_array_equal(some.select_column("gz.N").last, whole.select_column("gz.N").last[1:3])
    duration = answer(f"_time=[{first};60s[;step=60s")
    assert duration.start_s.tolist() == minutes[1:2]
    assert "did you mean" in answer("axes=gz")
    assert "no brackets" in answer("_time=yesterday")
    assert "no results in this time range; stored are 2020-09-13" in answer("_time=[now(-1h)..]")


@pytest.mark.long
def test_a_damaged_history_is_said_in_the_status_and_to_who_asks(asked: tuple[Service, Any]) -> None:
    service, client = asked
    assert service.history is not None
    path = service.history.writer.path
    path.with_name(FILE_NAME + "-wal").unlink(missing_ok=True)
    path.write_bytes(b"no more" * 1000)
    (reply,) = client.get("imu/bench-1/history", timeout=PATIENCE_S)
    assert "damaged" in json.loads(bytes(reply.err.payload))["error"]
    service.history.writer.queue_item("bench-1", StoredEvent(T0, "moved", "once more"))
    wait_for(lambda: "damaged" in service.output_states()["history"])
    (aside,) = path.parent.glob(f"{FILE_NAME}.aside-*Z")
    assert aside.read_bytes() == b"no more" * 1000
