"""Tests of the service: the viewer address, the times of recordings, rate checks and kernels."""

import math
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from structlog.testing import capture_logs

from drivers.data_types import Event
from drivers.recordings import save_samples
from drivers.secret_masking import remember_secret
from monitor.common.device_health import Health
from monitor.daemon.kernels import kernel_compilation, kernel_groups
from monitor.daemon.outputs.output import Output
from monitor.daemon.outputs.terminal_outputs import EventAndStatusLogOutput, TableOutput
from monitor.daemon.service import Service
from monitor.estimation.detection.comparison_with_noise_model import ModelComparison
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients_with_intervals import Status
from monitor.history import bucketed_history as past
from monitor.history.sqlite_store import FILE_NAME, open_history
from monitor.history.time_ranges import TimeRange
from monitor.publishing.remote_device_states import RemoteDeviceRegistry
from monitor.publishing.terminal import live_device_table
from monitor.settings import loading

pytest.importorskip("rerun", reason="rerun-sdk is not installed")

from tests.monitor.publishing.rerun.test_queued_view import read_entities
from tests.support.ports import free_port
from tests.support.waiting import PATIENCE_S, wait_for

RECORDED_S = 1_600_000_000.0


def write_and_load_config(folder: Path, driver: str, viewer: str) -> loading.Config:
    path = folder / "config.toml"
    device = f'[[device]]\nname = "d"\nrate = 100.0\ndriver = {{ {driver} }}\n'
    path.write_text(f'{device}[zenoh]\nmode = "none"\n[viewer]\n{viewer}')
    return loading.load_config(path)


class StatusCounter(Output):
    """Counts the published status reports."""

    def __init__(self) -> None:
        self.healths = 0

    def publish_health(self, device: str, unix_s: float, health: Health) -> None:
        self.healths += 1


def test_viewer_address_is_shown_above_the_table_and_not_logged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    viewer = f'mode = "auto"\nport = {free_port()}\nweb_port = {free_port()}\n'
    registry = RemoteDeviceRegistry()
    status_counter = StatusCounter()
    service = Service(
        write_and_load_config(tmp_path, 'link = "virtual"', viewer),
        [TableOutput(registry, lambda: None), status_counter],
    )
    assert service.viewer is not None
    thread = threading.Thread(target=service.run)
    with capture_logs() as logs:
        thread.start()
        try:
            wait_for(lambda: registry.note != "")
            url, note = service.viewer.url, registry.note
            before = status_counter.healths
            wait_for(lambda: status_counter.healths >= before + 2, "two more status reports")
            with (console := Console(width=200)).capture() as captured:
                console.print(live_device_table.device_overview(registry, time.monotonic()))
        finally:
            service.request_stop()
            thread.join(PATIENCE_S)
    assert not thread.is_alive()
    assert url.startswith("http://127.0.0.1:")
    assert note == f"viewer: {url}"
    assert url in captured.get()
    assert not [line for line in logs if line["event"] == "viewer"]


def test_viewer_address_is_logged_if_the_table_is_written_to_a_file() -> None:
    registry = RemoteDeviceRegistry()
    with capture_logs() as logs:
        for output in (TableOutput(registry), EventAndStatusLogOutput()):
            output.set_viewer_url("http://127.0.0.1:9090")
            output.set_viewer_url("")
    assert registry.note == ""
    assert [line["url"] for line in logs] == ["http://127.0.0.1:9090"]


def test_old_recording_shows_nothing_at_the_present_time(tmp_path: Path) -> None:
    path = tmp_path / "view.rrd"
    rows = [f"{RECORDED_S + i / 100:.2f},{0.1 * (-1) ** i}" for i in range(100)]
    (tmp_path / "long-ago.csv").write_text("\n".join(["t,gz", *rows]))
    service = Service(write_and_load_config(tmp_path, 'link = "replay", path = "long-ago.csv"', f'mode = "{path}"\n'))
    service.run(PATIENCE_S)
    assert service.workers[0].driver.state == "ended"
    cells = read_entities(path)
    assert "ENDED" in str(cells["/d/status"])
    times_s = [t / 1e9 for entity in cells.values() for t in entity.get("sample_time", []) if isinstance(t, int)]
    assert RECORDED_S <= min(times_s) <= max(times_s) <= RECORDED_S + 1.0


class TextCollector(Output):
    """Collects all texts of the status reports and events."""

    state = "the server refuses kR7-wq2Zt9"

    def __init__(self) -> None:
        self.texts: list[str] = []

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        self.texts.append(event.text)

    def publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
        self.texts += [health.text, *health.outputs.values()]


def test_secrets_in_texts_from_outside_reach_no_output(tmp_path: Path) -> None:
    (tmp_path / "samples.csv").write_text("t,gz\n" + "".join(f"{i / 100:.2f},{0.1 * (-1) ** i}\n" for i in range(100)))
    config = write_and_load_config(tmp_path, 'link = "replay", path = "samples.csv"', 'mode = "none"\n')
    remember_secret("kR7-wq2Zt9")
    collector = TextCollector()
    service = Service(config, [collector], writers={"log": collector})
    service.workers[0].driver.text = "the gateway refuses a1I3LXdxMlp0OQ=="
    service.workers[0].publish_event("link_lost", "lost %6BR7-wq2Zt9")
    service._publish_status()
    service.run(PATIENCE_S)
    assert {"lost ***", "the server refuses ***"} <= set(collector.texts)
    assert any(text.startswith("the gateway refuses ***") for text in collector.texts)
    assert not any("wq2Z" in text or "XdxM" in text for text in collector.texts)


class TimeCollector(Output):
    """Collects the times of the status reports and events of a device."""

    def __init__(self) -> None:
        self.healths: list[tuple[float | None, Health]] = []
        self.events: list[float] = []

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        self.events.append(unix_s)

    def publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
        self.healths.append((unix_s, health))

    def count_reports(self, received: bool) -> int:
        """Count the reports with received samples, or those without."""
        return sum(bool(health.received) == received for _, health in self.healths)


@pytest.mark.parametrize("kind", ["csv", "npz", "folder"])
def test_recording_that_waits_for_kernels_uses_only_its_own_times(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    n, compiled, prepare = 2000, threading.Event(), kernel_compilation.prepare_kernels

    def wait_then_prepare(
        group: kernel_groups.KernelGroup, tell: Callable[[kernel_compilation.CompilationProgress], None]
    ) -> Iterator[str]:
        compiled.wait(PATIENCE_S)
        yield from prepare(group, tell)

    monkeypatch.setattr(kernel_compilation, "prepare_kernels", wait_then_prepare)
    t_s = np.arange(n) / 100.0
    values = np.random.default_rng(1).standard_normal((n, 6)) * 1e-3
    name = {"csv": "r.csv", "npz": "r.npz", "folder": "r"}[kind]
    recording, away = tmp_path / name, tmp_path / f"away-{name}"
    if kind == "folder":
        recording.mkdir()
        for part in (slice(0, n // 2), slice(n // 2, n)):
            save_samples(recording / f"{part.start:05d}.csv", t_s[part], values[part])
    else:
        save_samples(recording, t_s, values)
    view = tmp_path / "view.rrd"
    path = tmp_path / "config.toml"
    path.write_text(
        f"""
[[device]]
name = "night-run"
driver = {{ link = "replay", path = "{name}", speed = 1000 }}
[zenoh]
mode = "none"
[viewer]
mode = "{view}"
[storage]
folder = "kept"
record = false
"""
    )
    times = TimeCollector()
    service = Service(loading.load_config(path), [times])
    recording.rename(away)
    thread = threading.Thread(target=service.run, args=(PATIENCE_S,))
    thread.start()
    try:
        assert wait_for(lambda: times.count_reports(received=False) >= 2)  # the recording does not exist yet
        away.rename(recording)
        assert wait_for(lambda: times.count_reports(received=True) >= 2)  # the samples wait in the ring
        assert service.workers[0].publisher.published == 0
    finally:
        compiled.set()
        thread.join(PATIENCE_S)
    assert not thread.is_alive()
    assert service.workers[0].publisher.published == n
    first_s, last_s = 0.0, (n - 1) / 100.0
    assert {unix_s for unix_s, health in times.healths if not health.received} == {None}
    sample_times = [unix_s for unix_s, health in times.healths if health.received]
    assert all(unix_s is not None and first_s <= unix_s <= last_s for unix_s in sample_times), sample_times
    assert sample_times[-1] == last_s
    assert all(first_s <= unix_s <= last_s for unix_s in times.events), times.events
    cells = read_entities(view)
    assert "ENDED" in str(cells["/night-run/status"])
    times_s = [t / 1e9 for entity in cells.values() for t in entity.get("sample_time", []) if isinstance(t, int)]
    assert first_s <= min(times_s) <= max(times_s) <= last_s
    with open_history(tmp_path / "kept" / FILE_NAME) as reader:
        history = past.read_history(reader, "night-run", TimeRange(-math.inf, math.inf), step_s=60)
    assert history.start_s.tolist() == [0]
    assert history.counts[:, 0].tolist() == [n]
    assert all(first_s <= event.t_s <= last_s for event in history.events)


class EstimateCollector(Output):
    """Collects estimates, kinds of events, model comparisons and the status text."""

    def __init__(self) -> None:
        self.all: list[Estimate] = []
        self.kinds: set[str] = set()
        self.gaps: list[ModelComparison] = []
        self.health_text = ""

    def publish_result(self, device: str, unix_s: float, received: int, result: Any) -> None:
        if isinstance(result, Estimate):
            self.all.append(result)
        elif isinstance(result, ModelComparison):
            self.gaps.append(result)

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        self.kinds.add(event.kind)

    def publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
        self.health_text = health.text


@pytest.mark.parametrize("rate_hz", [100.0, 200.0])
def test_recording_that_contradicts_the_rate_publishes_no_coefficients(tmp_path: Path, rate_hz: float) -> None:
    values = np.random.default_rng(1).standard_normal((6000, 6)) * 1e-2
    save_samples(tmp_path / "r.npz", np.arange(6000) / 100.0, values)
    path = tmp_path / "config.toml"
    path.write_text(
        f"""
[[device]]
name = "d"
rate = {rate_hz}
window = "1min"
model = "consumer-mems"
driver = {{ link = "replay", path = "r.npz", speed = 20 }}
[[device.limit]]
axes = "gz"
letter = "N"
above = 1e-5
hold = "1s"
[zenoh]
mode = "none"
[viewer]
mode = "none"
[storage]
folder = "kept"
record = false
"""
    )
    collector, registry = EstimateCollector(), RemoteDeviceRegistry()
    Service(loading.load_config(path), [collector, TableOutput(registry)]).run(60.0)
    with open_history(tmp_path / "kept" / FILE_NAME) as reader:
        history = past.read_history(reader, "d", TimeRange(-math.inf, math.inf), step_s=60)
    (device,) = registry.devices_with_problems_first(time.monotonic())
    assert device.coefficients is not None
    published = {
        Status(status) for estimate in collector.all for status in estimate.coefficients.status.ravel().tolist()
    }
    assert collector.all[-1].rate_hz == 100.0
    if rate_hz == 100.0:
        assert Status.ESTIMATED in published
        assert collector.kinds >= {"limit_crossed", "model_disagrees"}
        assert np.isfinite(history.select_column("gz.N").last).any()
        assert Status.ESTIMATED in device.coefficients.coefficients.status
    else:
        assert published == {Status.UNESTIMATED}
        assert not collector.kinds & {"limit_crossed", "model_disagrees"}
        assert all(comparison.axes == {} for comparison in collector.gaps)
        assert not np.isfinite(history.select_column("gz.N").last).any()
        assert set(device.coefficients.coefficients.status.ravel().tolist()) == {Status.UNESTIMATED}
        assert device.status is not None
        assert device.status.text == collector.health_text
        assert collector.health_text.endswith(
            "the end of the file; measured rate 100 Hz differs from the configured 200 Hz; coefficients are withheld: "
            "correct `rate` or remove it"
        )


def test_recording_without_a_rate_is_reported(tmp_path: Path) -> None:
    save_samples(tmp_path / "r.npz", np.arange(50) / 100.0, np.ones((50, 6)))
    collector = EstimateCollector()
    path = tmp_path / "config.toml"
    path.write_text(
        '[[device]]\nname = "d"\ndriver = { link = "replay", path = "r.npz" }\n'
        '[zenoh]\nmode = "none"\n[viewer]\nmode = "none"\n'
    )
    service = Service(loading.load_config(path), [collector])
    service.run(60.0)
    assert service.workers[0].publisher.published == 50
    assert collector.all == []
    assert collector.health_text.endswith("; no estimate: the times of the samples do not show a rate; set `rate`")


def test_kernels_that_cannot_be_stored_do_not_stop_processing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail_with_full_disk(
        _group: kernel_groups.KernelGroup, _tell: Callable[[kernel_compilation.CompilationProgress], None]
    ) -> Iterator[str]:
        yield kernel_groups.WINDOW
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(kernel_compilation, "prepare_kernels", fail_with_full_disk)
    save_samples(tmp_path / "short.npz", np.arange(500) / 100.0, np.random.default_rng(1).standard_normal((500, 6)))
    service = Service(
        write_and_load_config(tmp_path, 'link = "replay", path = "short.npz", speed = "max"', 'mode = "none"')
    )
    with capture_logs() as logs:
        service.run(PATIENCE_S)
    latest = service.workers[0].publisher.latest
    assert latest is not None
    assert latest.samples == 500
    assert np.isfinite(latest.fitted[:, 2]).any()
    assert ["No space left" in str(line.get("error")) for line in logs].count(True) == 1


@pytest.mark.long
def test_stopped_replay_loses_no_counted_samples(tmp_path: Path) -> None:
    n = 1_000_000  # many times the capacity of the ring
    save_samples(tmp_path / "long.npz", np.arange(n) / 100.0, np.random.default_rng(1).standard_normal((n, 6)))
    service = Service(
        write_and_load_config(tmp_path, 'link = "replay", path = "long.npz", speed = "max"', 'mode = "none"')
    )
    (worker,) = service.workers
    thread = threading.Thread(target=service.run)
    thread.start()
    wait_for(lambda: worker.publisher.published > 0)
    service.request_stop()
    thread.join(PATIENCE_S)
    assert not thread.is_alive()
    assert worker.driver.state != "ended"
    assert worker.ring.overflowed == 0
    assert worker.publisher.published == worker.driver.counts.received < n
