"""Tests of the main process of a daemon with two workers: reload, commands and refused configurations."""

import json
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from drivers.errors import ConfigError
from monitor.daemon.workers.supervisor import WorkerSupervisor
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
    supervisor = WorkerSupervisor(loading.load_config(path), 2, [output])
    thread = threading.Thread(target=supervisor.run)
    thread.start()
    try:
        yield supervisor
    finally:
        supervisor.request_stop()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


@pytest.mark.long
def test_reload_and_commands_reach_the_worker_of_a_device(tmp_path: Path) -> None:
    endpoint, output = free_endpoint(), RecordingOutput()
    path = write(tmp_path, endpoint, {"kept": "", "removed": ""})
    with run_supervisor(path, output) as supervisor, ExitStack() as stack:
        wait_for(lambda: len(output.estimates) == 2, "estimates of both devices")
        wait_for(lambda: supervisor.output_states()["zenoh"] == "ok", "the session")
        session = stack.enter_context(open_session(connect=[endpoint]))
        write(tmp_path, endpoint, {"kept": LIMIT, "added": ""})
        before = output.healths["kept"]
        supervisor.request_reload()
        wait_for(lambda: "added" in output.estimates, "an estimate of the added device")
        wait_for(lambda: output.healths["added"].state == "running", "its status")
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
    assert [worker.process.returncode for worker in supervisor._workers if worker.process is not None] == [0, 0]


@pytest.mark.long
def test_worker_refuses_a_configuration_that_became_invalid(tmp_path: Path) -> None:
    model = tmp_path / "model.toml"
    model.write_text("broken")
    more = f'driver = {{ link = "virtual", model = "{model}" }}'
    path = tmp_path / "config.toml"
    path.write_text("".join(f'[[device]]\nname = "{name}"\n{more}\n' for name in "ab") + '[viewer]\nmode = "none"\n')
    supervisor = WorkerSupervisor(loading.load_config(path), 2)
    with pytest.raises(ConfigError, match=r"model\.toml"):
        supervisor.run(PATIENCE_S)
