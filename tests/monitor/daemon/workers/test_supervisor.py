"""Tests of the main process of a daemon with two workers: reload, commands and refused configurations."""

import json
import os
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import cast

import pytest
from structlog.testing import capture_logs

from drivers.errors import ConfigError
from monitor.daemon.workers import supervisor
from monitor.daemon.workers.supervisor import WorkerSupervisor
from monitor.daemon.workers.worker_service import Call, PipeOutput, WorkerService
from monitor.settings import loading
from tests.support.ports import free_endpoint
from tests.support.waiting import PATIENCE_S, wait_for
from tests.support.zenoh_sessions import open_session
from tests.system.rig import RecordingOutput

DEVICE = '[[device]]\nname = "{name}"\nrate = 100.0\nwindow = "1min"\n{more}\ndriver = {{ link = "virtual" }}\n'
LIMIT = 'limit = [{ axes = "gz", letter = "N", above = 1e-9 }]'


def write(folder: Path, endpoint: str, devices: dict[str, str]) -> Path:
    path = folder / "config.toml"
    head = f'[zenoh]\nlisten = ["{endpoint}"]\n[viewer]\nmode = "none"\n[service]\nworkers = 2\n'
    path.write_text(head + "".join(DEVICE.format(name=name, more=more) for name, more in devices.items()))
    return path


@contextmanager
def run_supervisor(path: Path, output: RecordingOutput) -> Iterator[WorkerSupervisor]:
    running = WorkerSupervisor(loading.load_config(path), 2, [output])
    thread = threading.Thread(target=running.run)
    thread.start()
    try:
        yield running
    finally:
        running.request_stop()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


@pytest.mark.long
def test_reload_and_commands_reach_the_worker_of_a_device(tmp_path: Path) -> None:
    endpoint, output = free_endpoint(), RecordingOutput()
    path = write(tmp_path, endpoint, {"kept": "", "removed": ""})
    with run_supervisor(path, output) as running, ExitStack() as stack:
        wait_for(lambda: len(output.estimates) == 2, "estimates of both devices")
        wait_for(lambda: running.output_states()["zenoh"] == "ok", "the session")
        session = stack.enter_context(open_session(connect=[endpoint]))
        write(tmp_path, endpoint, {"kept": LIMIT, "added": ""})
        before = output.healths["kept"]
        running.request_reload()
        wait_for(lambda: "added" in output.estimates, "an estimate of the added device")
        wait_for(lambda: "added" in output.healths, "its status")
        wait_for(lambda: output.healths["kept"].received > before.received, "more samples of the kept device")
        assert output.healths["kept"].uptime_s > before.uptime_s
        count = len(output.blocks["removed"])
        replies = {
            name: [
                json.loads((one.ok or one.err).payload.to_bytes()) for one in session.get(f"imu/{name}/command/{verb}")
            ]
            for name, verb in (("kept", "reset"), ("added", "fly"), ("removed", "reset"))
        }
        assert len(output.blocks["removed"]) == count
    assert [reply["text"] for reply in replies["kept"]] == ["the window is empty"]
    assert ["unknown command" in reply["error"] for reply in replies["added"]] == [True]
    assert replies["removed"] == []
    assert {name: health.state for name, health in output.healths.items()}["kept"] == "running"
    assert [worker.process.returncode for worker in running._workers if worker.process is not None] == [0, 0]


def test_calls_before_the_end_of_a_worker_are_not_lost() -> None:
    worker = supervisor._Worker(0)
    worker.pipe, theirs = Pipe()
    last = [Call("set_progress", ({"a": 1},))]
    theirs.send(last)
    theirs.close()
    assert worker.receive() == last
    with pytest.raises(EOFError):
        worker.receive()


def test_worker_that_can_receive_no_calls_stops(tmp_path: Path) -> None:
    """Otherwise, the worker would neither obey nor end with the main process."""

    class FullMemory:
        def recv(self) -> Call:
            raise MemoryError

    ours, _ = Pipe()
    config = loading.load_config(write(tmp_path, free_endpoint(), {"a": ""}))
    service = WorkerService(config, PipeOutput(ours), os.getpid())
    with pytest.raises(MemoryError):
        service.receive_calls(cast(Connection, FullMemory()))
    assert service._stop.is_set()


@pytest.mark.long
def test_worker_that_cannot_be_started_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    output = RecordingOutput()
    path = write(tmp_path, free_endpoint(), {"a": "", "b": ""})
    with monkeypatch.context() as patch, capture_logs() as logs:
        patch.setattr(supervisor, "PROGRAM", (str(tmp_path / "missing"),))
        with run_supervisor(path, output):
            wait_for(lambda: len(logs) >= 2, "the failures of both workers")
            patch.undo()
            wait_for(lambda: len(output.estimates) == 2, "estimates of both devices")
    assert "worker 0 cannot be started: No such file or directory; trying again" in logs[0]["text"]


@pytest.mark.long
def test_worker_refuses_a_configuration_that_became_invalid(tmp_path: Path) -> None:
    model = tmp_path / "model.toml"
    model.write_text("broken")
    more = f'driver = {{ link = "virtual", model = "{model}" }}'
    path = tmp_path / "config.toml"
    path.write_text("".join(f'[[device]]\nname = "{name}"\n{more}\n' for name in "ab") + '[viewer]\nmode = "none"\n')
    refused = WorkerSupervisor(loading.load_config(path), 2)
    with pytest.raises(ConfigError, match=r"model\.toml"):
        refused.run(PATIENCE_S)
