"""The file is read again: what changed in it changes, what did not goes on as if nothing had happened."""

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
from monitor.daemon.outputs.table_output import TableOutput
from monitor.daemon.service import Service
from monitor.noise.model_loading import read_model
from monitor.publishing.remote_device_states import RemoteDeviceRegistry
from monitor.publishing.terminal import live_device_table
from monitor.settings import loading
from tests.monitor.daemon.operations.test_systemd import Listening
from tests.monitor.publishing import made
from tests.support.ports import free_endpoint
from tests.support.waiting import PATIENCE_S, wait_for
from tests.support.zenoh_sessions import open_session

QUIET = '[zenoh]\nmode = "none"\n[viewer]\nmode = "none"\n'


def device(name: str, extra: str = "", driver: str = "") -> str:
    return (
        f'[[device]]\nname = "{name}"\nrate = 100.0\nwindow = 60.0\n{extra}\ndriver = {{ link = "virtual"{driver} }}\n'
    )


def changed(folder: Path, before: str, after: str) -> config_changes.ConfigChange:
    path = folder / "c.toml"
    path.write_text(before)
    config = loading.load_config(path)
    models = {one.name: None if one.model is None else read_model(one.model) for one in config.devices}
    path.write_text(after)
    return config_changes.compare_with_file(config, models)


def test_devices_are_compared_as_they_stand_in_the_file(tmp_path: Path) -> None:
    before = device("a") + device("b") + device("c") + device("d")
    limit = '[[device.limit]]\naxes = "gz"\nletter = "N"\nabove = 1.0\n'
    after = device("e") + device("d") + limit + "# a word\n" + device("a") + device("b", 'publish = "1 Hz"')
    change = changed(tmp_path, before + QUIET, after + QUIET)
    assert [one.name for one in change.added] == ["e", "b"]
    assert change.removed == ("b", "c")
    assert [one.name for one in change.limited] == ["d"]
    assert change.restart == ()
    assert change.describe_changes() == "added: e; removed: c; restarted: b; new limits: d"


def test_a_model_that_reads_otherwise_begins_its_device_anew(tmp_path: Path) -> None:
    text = device("a", 'model = "m.toml"') + QUIET
    model = tmp_path / "m.toml"
    model.write_text("sample_rate = 100.0\n[gz.angle_random_walk]\nN = 1e-4\n")
    assert changed(tmp_path, text, text).describe_changes() == "no device changed"
    path = tmp_path / "c.toml"
    config, models = loading.load_config(path), {"a": read_model(model)}
    model.write_text("sample_rate = 100.0\n[gz.angle_random_walk]\nN = 2e-4\n")
    assert config_changes.compare_with_file(config, models).describe_changes() == "restarted: a"


def test_what_only_a_restart_makes_hold_is_said_again_and_again(tmp_path: Path) -> None:
    after = device("a") + '[zenoh]\nmode = "peer"\n[viewer]\nmode = "none"\n[log]\nformat = "json"\nlevel = "debug"\n'
    change = changed(tmp_path, device("a") + QUIET, after)
    assert change.restart == ("zenoh", "log.format")
    assert change.config.zenoh.mode == "none"
    assert change.config.log.level == "debug"
    assert config_changes.compare_with_file(change.config, {"a": None}).restart == ("zenoh", "log.format")
    (tmp_path / "c.toml").write_text(device("a") + QUIET)
    assert config_changes.compare_with_file(change.config, {"a": None}).restart == ()


@pytest.mark.parametrize(
    ("after", "words"),
    [
        ("[[device", "not TOML"),
        (device("a", "windw = 1.0") + QUIET, 'windw: unknown key; did you mean "window"?'),
        (device("a", 'model = "m.toml"') + QUIET, "m.toml: "),
        (
            device("a", 'model = "consumer-mems"')
            + '[[device.limit]]\naxes = "gz"\nletter = "R"\ntimes_model = 2.0\n'
            + QUIET,
            "the model in force has no R on gz",
        ),
    ],
    ids=["no TOML", "unknown key", "bad model", "relative to nothing"],
)
def test_a_wrong_file_is_one_line_and_changes_nothing(tmp_path: Path, after: str, words: str) -> None:
    (tmp_path / "m.toml").write_text("sample_rate = 100.0\n[gz.angle_random_walk]\nM = 1.0\n")
    with pytest.raises(ConfigError, match=words.replace("?", r"\?")) as caught:
        changed(tmp_path, device("a") + QUIET, after)
    assert "\n" not in str(caught.value)


# --- in a service that runs


class Gone(Output):
    def __init__(self) -> None:
        self.names: list[str] = []
        self.events: list[tuple[str, str]] = []

    def publish_event(self, device: str, unix_s: float, received: int, event: Any) -> None:
        self.events.append((device, event.kind))

    def remove_device(self, device: str) -> None:
        self.names.append(device)


@contextmanager
def running(path: Path, *outputs: Output) -> Iterator[Service]:
    service = Service(loading.load_config(path), outputs)
    thread = threading.Thread(target=service.run)
    thread.start()
    try:
        yield service
    finally:
        service.request_stop()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


def tokens(listener: Any) -> set[str]:
    """Keys of all devices that are alive."""
    replies = listener.liveliness().get("imu/*/alive", timeout=PATIENCE_S)
    return {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}


@pytest.mark.long
def test_devices_come_go_and_change_while_the_others_run(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    endpoint, path, gone = free_endpoint(), tmp_path / "c.toml", Gone()
    rest = f'[zenoh]\nlisten = ["{endpoint}"]\n[viewer]\nmode = "view.rrd"\n[storage]\nfolder = "kept"\n'
    path.write_text(device("stays") + device("goes") + device("changes") + rest)
    with running(path, gone) as service:
        stations = {station.name: station for station in service.workers}
        wait_for(lambda: all(station.publisher.published > 300 for station in service.workers))
        wait_for(lambda: service.zenoh.state == "ok" and service.viewer is not None and service.viewer.state == "ok")
        ring, estimator = stations["stays"].ring, stations["stays"].pipeline.estimator
        path.write_text(device("stays") + device("comes") + device("changes", 'publish = "5 Hz"') + rest)
        with open_session(connect=[endpoint]) as listener:
            heard: dict[str, list[Any]] = {}
            listener.declare_subscriber(
                "imu/*/coefficients",
                lambda sample: heard.setdefault(str(sample.key_expr).split("/")[1], []).append(bytes(sample.payload)),
            )
            service.request_reload()
            wait_for(lambda: [station.name for station in service.workers] == ["stays", "comes", "changes"])
            wait_for(lambda: gone.names == ["goes", "changes"])
            heard.clear()
            wait_for(lambda: {"stays", "comes", "changes"} <= heard.keys())
            assert "goes" not in heard
            alive = {f"imu/{name}/alive" for name in ("stays", "comes", "changes")}
            wait_for(lambda: tokens(listener) == alive, lambda: f"{alive}, there are {tokens(listener)}")
            assert not [one for one in listener.get("imu/goes/command/reset", timeout=PATIENCE_S) if one.ok is not None]
        new = {station.name: station for station in service.workers}
        assert new["stays"] is stations["stays"]
        assert (new["stays"].ring, new["stays"].pipeline.estimator) == (ring, estimator)
        # a simulated sensor on a busy machine drops what it has no time to send; nothing else may be missing
        assert new["stays"].driver.counts.lost <= new["stays"].simulated.fault_counts.dropped
        assert new["changes"] is not stations["changes"]
        # what was recorded of it is in its window again
        wait_for(lambda: ("changes", "window_rebuilt") in gone.events)
        assert service.viewer is not None
        assert service.viewer.state == "ok"
        assert {one.name for one in service.workers if one.simulated is not None} == {"stays", "comes", "changes"}
    assert not [thread.name for thread in threading.enumerate() if thread.name.startswith(("reader of", "virtual imu"))]


def test_new_limits_and_hooks_hold_at_once_and_a_wrong_file_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    path.write_text(device("a") + QUIET)
    with capture_logs() as lines, running(path) as service:
        (station,) = service.workers
        wait_for(lambda: station.publisher.latest is not None and station.publisher.published > 500)
        path.write_text("[[device")
        service.request_reload()
        wait_for(lambda: any(line["event"].startswith("not reloaded") for line in lines))
        limit = '[[device.limit]]\naxes = "a*"\nletter = "N"\nabove = 1e-5\nhold = "1s"\n'
        path.write_text(device("a") + limit + '[[hook]]\non = ["*"]\ncommand = ["/bin/true"]\n' + QUIET)
        service.request_reload()
        wait_for(lambda: station.status.build_health({}, 0).crossed == ("ax N", "ay N", "az N"))
        assert service.output_states()["hook"] == "ok"
        assert service.workers == [station]
        path.write_text(device("a") + QUIET)
        service.request_reload()
        wait_for(lambda: station.status.build_health({}, 0).crossed == ())
    wrong = [line for line in lines if line["event"].startswith("not reloaded")]
    assert [line["log_level"] for line in wrong] == ["error"]
    assert "not TOML" in wrong[0]["error"]


@pytest.mark.long
def test_a_hang_up_reloads_and_systemd_is_told(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    path.write_text(device("a") + QUIET + '[log]\nformat = "json"\n')
    with Listening(str(tmp_path / "notify")) as systemd:
        environment = {**os.environ, "NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "9000000"}
        command = [sys.executable, "-m", "monitor.cli", "run", str(path)]
        with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL) as process:
            try:
                wait_for(lambda: systemd.count("READY=1") == 1)
                path.write_text(device("a") + device("b") + QUIET + '[log]\nformat = "json"\nlevel = "warning"\n')
                process.send_signal(signal.SIGHUP)
                wait_for(lambda: systemd.count("READY=1") == 2)
                wait_for(lambda: any(line.startswith("STATUS=2 devices") for line in systemd.lines()))
                path.write_text("[[device")
                process.send_signal(signal.SIGHUP)
                wait_for(lambda: systemd.count("READY=1") == 3)
                wait_for(lambda: systemd.count("WATCHDOG=1") > 0)
            finally:
                process.send_signal(signal.SIGTERM)
                _, said = process.communicate(timeout=PATIENCE_S)
        systemd.lines()
    assert process.returncode == 0
    lines = [json.loads(line) for line in said.decode().splitlines()]
    told = [(line["event"], line["level"]) for line in lines if "reloaded" in line["event"]]
    # the new level is warning: what was done is no warning, that the file is wrong is more than one
    assert told == [("not reloaded, the running configuration stays in force", "error")]
    order = [line.partition("=")[0] for line in systemd.heard if not line.startswith(("STATUS=", "WATCHDOG="))]
    again = ["RELOADING", "MONOTONIC_USEC", "READY"]
    assert order == ["READY", *again, *again, "STOPPING"]


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="needs /proc")
def test_reloads_leave_nothing_behind(tmp_path: Path) -> None:
    """Descriptors and threads of a device that comes and goes."""
    path, rest = tmp_path / "c.toml", f'[zenoh]\nlisten = ["{free_endpoint()}"]\n[viewer]\nmode = "none"\n'
    path.write_text(device("stays") + device("a") + rest)
    with running(path) as service:
        wait_for(lambda: service.zenoh.state == "ok" and all(one.publisher.published > 50 for one in service.workers))
        most = (0, 0)
        for i in range(8):
            name = "ba"[i % 2]
            path.write_text(device("stays") + device(name) + rest)
            service.request_reload()
            wait_for(
                lambda name=name: service.workers[-1].name == name and service.workers[-1].publisher.published > 50
            )
            if i == 1:
                most = in_use()
            elif i > 1:
                wait_for(lambda most=most: all(now <= then for now, then in zip(in_use(), most, strict=True)))


def in_use() -> tuple[int, int]:
    """Descriptors and threads of this process."""
    return len(os.listdir("/proc/self/fd")), threading.active_count()


def test_a_device_that_is_gone_has_no_row() -> None:
    board = RemoteDeviceRegistry()
    table = TableOutput(board)
    for name in ("first", "second"):
        table.publish_health(name, 0.0, made.health())
        table.publish_event(name, 0.0, 1, Event("moved", 0, f"{name} was moved"))
    table.remove_device("first")
    with (console := Console(width=200)).capture() as captured:
        console.print(live_device_table.device_overview(board, 0.0))
    assert "second was moved" in captured.get()
    assert "first" not in captured.get()


def test_a_fifo_in_place_of_the_file_is_not_waited_for_and_another_folder_needs_a_restart(tmp_path: Path) -> None:
    before = device("a") + QUIET + '[storage]\nfolder = "one"\n'
    change = changed(tmp_path, before, before.replace('"one"', '"two"'))
    assert change.restart == ("storage",)
    assert change.config.storage is not None
    assert change.config.storage.folder == tmp_path / "one"
    path = tmp_path / "c.toml"
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(ConfigError, match=r"c.toml: cannot be read: is a FIFO, not a regular file"):
        config_changes.compare_with_file(change.config, {"a": None})
