"""Tests of reloading the configuration: changes take effect, and unchanged devices continue undisturbed."""

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from structlog.testing import capture_logs

from drivers.data_types import Event
from drivers.errors import ConfigError
from monitor.daemon import config_changes
from monitor.daemon.outputs.output import Output
from monitor.daemon.outputs.terminal_outputs import TableOutput
from monitor.daemon.service import Service
from monitor.noise.model_loading import read_model
from monitor.publishing.remote_device_states import RemoteDeviceRegistry
from monitor.publishing.terminal import live_device_table
from monitor.settings import loading
from tests.monitor.daemon.operations.test_systemd import NotificationReceiver
from tests.monitor.publishing import example_results
from tests.support.ports import free_endpoint
from tests.support.waiting import PATIENCE_S, wait_for
from tests.support.zenoh_sessions import open_session

QUIET = '[zenoh]\nmode = "none"\n[viewer]\nmode = "none"\n'


def format_device(name: str, extra: str = "", driver: str = "") -> str:
    return (
        f'[[device]]\nname = "{name}"\nrate = 100.0\nwindow = 60.0\n{extra}\ndriver = {{ link = "virtual"{driver} }}\n'
    )


def write_and_compare(folder: Path, before: str, after: str) -> config_changes.ConfigChange:
    path = folder / "c.toml"
    path.write_text(before)
    config = loading.load_config(path)
    models = {device.name: None if device.model is None else read_model(device.model) for device in config.devices}
    path.write_text(after)
    return config_changes.compare_with_file(config, models)


def test_devices_are_compared_by_their_entries_in_the_file(tmp_path: Path) -> None:
    before = format_device("a") + format_device("b") + format_device("c") + format_device("d")
    limit = '[[device.limit]]\naxes = "gz"\nletter = "N"\nabove = 1.0\n'
    after = (
        format_device("e")
        + format_device("d")
        + limit
        + "# a word\n"
        + format_device("a")
        + format_device("b", 'publish = "1 Hz"')
    )
    change = write_and_compare(tmp_path, before + QUIET, after + QUIET)
    assert [device.name for device in change.added] == ["e", "b"]
    assert change.removed == ("b", "c")
    assert [device.name for device in change.limited] == ["d"]
    assert change.restart == ()
    assert change.describe_changes() == "added: e; removed: c; restarted: b; new limits: d"


def test_device_restarts_if_the_content_of_its_model_file_changed(tmp_path: Path) -> None:
    text = format_device("a", 'model = "m.toml"') + QUIET
    model = tmp_path / "m.toml"
    model.write_text("sample_rate = 100.0\n[gz.angle_random_walk]\nN = 1e-4\n")
    assert write_and_compare(tmp_path, text, text).describe_changes() == "no device changed"
    path = tmp_path / "c.toml"
    config, models = loading.load_config(path), {"a": read_model(model)}
    model.write_text("sample_rate = 100.0\n[gz.angle_random_walk]\nN = 2e-4\n")
    assert config_changes.compare_with_file(config, models).describe_changes() == "restarted: a"


def test_settings_that_need_a_restart_are_reported_at_every_reload(tmp_path: Path) -> None:
    after = (
        format_device("a")
        + '[zenoh]\nmode = "peer"\n[viewer]\nmode = "none"\n[log]\nformat = "json"\nlevel = "debug"\n'
    )
    change = write_and_compare(tmp_path, format_device("a") + QUIET, after)
    assert change.restart == ("zenoh", "log.format")
    assert change.config.zenoh.mode == "none"
    assert change.config.log.level == "debug"
    assert config_changes.compare_with_file(change.config, {"a": None}).restart == ("zenoh", "log.format")
    (tmp_path / "c.toml").write_text(format_device("a") + QUIET)
    assert config_changes.compare_with_file(change.config, {"a": None}).restart == ()


@pytest.mark.parametrize(
    ("after", "message"),
    [
        ("[[device", "not TOML"),
        (format_device("a", "windw = 1.0") + QUIET, 'windw: unknown key; did you mean "window"?'),
        (format_device("a", 'model = "m.toml"') + QUIET, "m.toml: "),
        (
            format_device("a", 'model = "consumer-mems"')
            + '[[device.limit]]\naxes = "gz"\nletter = "R"\ntimes_model = 2.0\n'
            + QUIET,
            "the model in force has no R on gz",
        ),
    ],
    ids=["no TOML", "unknown key", "bad model", "limit without model term"],
)
def test_invalid_file_is_reported_in_one_line_and_changes_nothing(tmp_path: Path, after: str, message: str) -> None:
    (tmp_path / "m.toml").write_text("sample_rate = 100.0\n[gz.angle_random_walk]\nM = 1.0\n")
    with pytest.raises(ConfigError, match=message.replace("?", r"\?")) as caught:
        write_and_compare(tmp_path, format_device("a") + QUIET, after)
    assert "\n" not in str(caught.value)


# --- reload of a running service


class RemovalRecorder(Output):
    def __init__(self) -> None:
        self.names: list[str] = []
        self.events: list[tuple[str, str]] = []

    def publish_event(self, device: str, unix_s: float, received: int, event: Any) -> None:
        self.events.append((device, event.kind))

    def remove_device(self, device: str) -> None:
        self.names.append(device)


@contextmanager
def run_service(path: Path, *outputs: Output) -> Iterator[Service]:
    service = Service(loading.load_config(path), outputs)
    thread = threading.Thread(target=service.run)
    thread.start()
    try:
        yield service
    finally:
        service.request_stop()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


def list_alive_keys(listener: Any) -> set[str]:
    """Return the liveliness keys of all devices."""
    replies = listener.liveliness().get("imu/*/alive", timeout=PATIENCE_S)
    return {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}


@pytest.mark.long
def test_added_removed_and_changed_devices_do_not_disturb_the_others(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    endpoint, path, removals = free_endpoint(), tmp_path / "c.toml", RemovalRecorder()
    rest = f'[zenoh]\nlisten = ["{endpoint}"]\n[viewer]\nmode = "view.rrd"\n[storage]\nfolder = "kept"\n'
    path.write_text(format_device("stays") + format_device("goes") + format_device("changes") + rest)
    with run_service(path, removals) as service:
        workers = {worker.name: worker for worker in service.workers}
        wait_for(lambda: all(worker.publisher.published > 300 for worker in service.workers))
        wait_for(lambda: service.zenoh.state == "ok" and service.viewer is not None and service.viewer.state == "ok")
        ring, estimator = workers["stays"].ring, workers["stays"].pipeline.estimator
        path.write_text(
            format_device("stays") + format_device("comes") + format_device("changes", 'publish = "5 Hz"') + rest
        )
        with open_session(connect=[endpoint]) as listener:
            received: dict[str, list[Any]] = {}
            listener.declare_subscriber(
                "imu/*/coefficients",
                lambda sample: received.setdefault(str(sample.key_expr).split("/")[1], []).append(
                    bytes(sample.payload)
                ),
            )
            service.request_reload()
            wait_for(lambda: [worker.name for worker in service.workers] == ["stays", "comes", "changes"])
            wait_for(lambda: removals.names == ["goes", "changes"])
            received.clear()
            wait_for(lambda: {"stays", "comes", "changes"} <= received.keys())
            assert "goes" not in received
            alive = {f"imu/{name}/alive" for name in ("stays", "comes", "changes")}
            wait_for(
                lambda: list_alive_keys(listener) == alive, lambda: f"{alive}, there are {list_alive_keys(listener)}"
            )
            assert not [
                reply for reply in listener.get("imu/goes/command/reset", timeout=PATIENCE_S) if reply.ok is not None
            ]
        new = {worker.name: worker for worker in service.workers}
        assert new["stays"] is workers["stays"]
        assert (new["stays"].ring, new["stays"].pipeline.estimator) == (ring, estimator)
        # A simulated sensor drops samples on a busy machine. Nothing else may be missing.
        assert new["stays"].driver.counts.lost <= new["stays"].simulated.fault_counts.dropped
        assert new["changes"] is not workers["changes"]
        # The samples recorded before the change are in the window again.
        wait_for(lambda: ("changes", "window_rebuilt") in removals.events)
        assert service.viewer is not None
        assert service.viewer.state == "ok"
        assert {reply.name for reply in service.workers if reply.simulated is not None} == {"stays", "comes", "changes"}
    assert not [thread.name for thread in threading.enumerate() if thread.name.startswith(("reader of", "virtual imu"))]


def test_new_limits_and_hooks_take_effect_and_an_invalid_file_does_not(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    path.write_text(format_device("a") + QUIET)
    with capture_logs() as lines, run_service(path) as service:
        (worker,) = service.workers
        wait_for(lambda: worker.publisher.latest is not None and worker.publisher.published > 500)
        path.write_text("[[device")
        service.request_reload()
        wait_for(lambda: any(line["event"].startswith("not reloaded") for line in lines))
        limit = '[[device.limit]]\naxes = "a*"\nletter = "N"\nabove = 1e-5\nhold = "1s"\n'
        path.write_text(format_device("a") + limit + '[[hook]]\non = ["*"]\ncommand = ["/bin/true"]\n' + QUIET)
        service.request_reload()
        wait_for(lambda: worker.status.build_health({}, 0).crossed == ("ax N", "ay N", "az N"))
        assert service.output_states()["hook"] == "ok"
        assert service.workers == [worker]
        path.write_text(format_device("a") + QUIET)
        service.request_reload()
        wait_for(lambda: worker.status.build_health({}, 0).crossed == ())
    wrong = [line for line in lines if line["event"].startswith("not reloaded")]
    assert [line["log_level"] for line in wrong] == ["error"]
    assert "not TOML" in wrong[0]["error"]


def test_reading_the_file_delays_neither_samples_nor_the_end_of_the_service(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "c.toml"
    path.write_text(format_device("a") + QUIET)
    reading, release = threading.Event(), threading.Event()

    def read_slowly(_path: Path) -> loading.Config:
        reading.set()
        release.wait(PATIENCE_S)
        raise ConfigError("read slowly")

    try:
        with run_service(path) as service:
            (worker,) = service.workers
            monkeypatch.setattr(loading, "load_config", read_slowly)
            service.request_reload()
            wait_for(reading.is_set)
            received = worker.driver.counts.received
            wait_for(lambda: worker.publisher.published > received + 100)
        assert not release.is_set()  # the service has ended in the meantime
    finally:
        release.set()


@pytest.mark.long
def test_sighup_reloads_the_configuration_and_notifies_systemd(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    path.write_text(format_device("a") + QUIET + '[log]\nformat = "json"\n')
    with NotificationReceiver(str(tmp_path / "notify")) as systemd:
        environment = {**os.environ, "NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "9000000"}
        command = [sys.executable, "-m", "imu_monitor", "run", str(path)]
        with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL) as process:
            try:
                wait_for(lambda: systemd.count_lines("READY=1") == 1)
                path.write_text(
                    format_device("a") + format_device("b") + QUIET + '[log]\nformat = "json"\nlevel = "warning"\n'
                )
                process.send_signal(signal.SIGHUP)
                wait_for(lambda: systemd.count_lines("READY=1") == 2)
                wait_for(lambda: any(line.startswith("STATUS=2 devices") for line in systemd.read_lines()))
                path.write_text("[[device")
                process.send_signal(signal.SIGHUP)
                wait_for(lambda: systemd.count_lines("READY=1") == 3)
                wait_for(lambda: systemd.count_lines("WATCHDOG=1") > 0)
            finally:
                process.send_signal(signal.SIGTERM)
                _, errors = process.communicate(timeout=PATIENCE_S)
        systemd.read_lines()
    assert process.returncode == 0
    lines = [json.loads(line) for line in errors.decode().splitlines()]
    reload_events = [(line["event"], line["level"]) for line in lines if "reloaded" in line["event"]]
    # At level warning, the log shows the failed reload but not the successful one.
    assert reload_events == [("not reloaded, the running configuration stays in force", "error")]
    order = [line.partition("=")[0] for line in systemd.received if not line.startswith(("STATUS=", "WATCHDOG="))]
    again = ["RELOADING", "MONOTONIC_USEC", "READY"]
    assert order == ["READY", *again, *again, "STOPPING"]


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="needs /proc")
def test_reloads_leave_no_descriptors_or_threads(tmp_path: Path) -> None:
    path, rest = tmp_path / "c.toml", f'[zenoh]\nlisten = ["{free_endpoint()}"]\n[viewer]\nmode = "none"\n'
    path.write_text(format_device("stays") + format_device("a") + rest)
    with run_service(path) as service:
        wait_for(
            lambda: service.zenoh.state == "ok" and all(worker.publisher.published > 50 for worker in service.workers)
        )
        limits = (0, 0)
        for i in range(8):
            name = "ba"[i % 2]
            path.write_text(format_device("stays") + format_device(name) + rest)
            service.request_reload()
            wait_for(
                lambda name=name: service.workers[-1].name == name and service.workers[-1].publisher.published > 50
            )
            if i == 1:
                limits = count_descriptors_and_threads()
            elif i > 1:
                wait_for(
                    lambda limits=limits: all(
                        now <= then for now, then in zip(count_descriptors_and_threads(), limits, strict=True)
                    )
                )


def count_descriptors_and_threads() -> tuple[int, int]:
    """Return the numbers of open descriptors and threads of this process."""
    return len(os.listdir("/proc/self/fd")), threading.active_count()


def test_removed_device_has_no_table_row() -> None:
    registry = RemoteDeviceRegistry()
    table = TableOutput(registry)
    for name in ("first", "second"):
        table.publish_health(name, 0.0, example_results.make_health())
        table.publish_event(name, 0.0, 1, Event("moved", 0, f"{name} was moved"))
    table.remove_device("first")
    with (console := Console(width=200)).capture() as captured:
        console.print(live_device_table.device_overview(registry, 0.0))
    assert "second was moved" in captured.get()
    assert "first" not in captured.get()


def test_fifo_in_place_of_the_file_is_refused_and_a_new_folder_needs_a_restart(tmp_path: Path) -> None:
    before = format_device("a") + QUIET + '[storage]\nfolder = "one"\n'
    change = write_and_compare(tmp_path, before, before.replace('"one"', '"two"'))
    assert change.restart == ("storage",)
    assert change.config.storage is not None
    assert change.config.storage.folder == tmp_path / "one"
    path = tmp_path / "c.toml"
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(ConfigError, match=r"c.toml: cannot be read: is a FIFO, not a regular file"):
        config_changes.compare_with_file(change.config, {"a": None})
