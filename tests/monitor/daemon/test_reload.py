"""Test that reloads at random moments end in exactly the configured devices, each of which answers a command once."""

import random
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from monitor.daemon.daemon_process import DaemonProcess
from monitor.daemon.outputs.terminal_outputs import TableOutput
from monitor.daemon.service import Service
from monitor.daemon.workers.supervisor import WorkerSupervisor
from monitor.publishing.remote_device_states import RemoteDeviceRegistry
from monitor.settings import loading
from tests.support.ports import free_endpoint, free_port
from tests.support.waiting import PATIENCE_S, wait_for
from tests.support.zenoh_sessions import open_session
from tests.system.rig import RecordingOutput

NAMES = tuple(f"imu-{number}" for number in range(8))
MAX_PAUSE_S = 0.3
DEVICE = '[[device]]\nname = "{name}"\nwindow = "{window}s"\ndriver = {{ link = "virtual", seed = {seed} }}\n'


class RowOutput(RecordingOutput):
    """Output that forgets a device that is removed, as the table does."""

    def remove_device(self, device: str) -> None:
        self.healths.pop(device, None)


class RandomConfiguration:
    """Configuration file whose devices are added, removed, renamed and changed at random."""

    def __init__(self, path: Path, endpoint: str, workers: int, seed: int) -> None:
        self._path = path
        self._head = (
            f'[zenoh]\nlisten = ["{endpoint}"]\n[viewer]\nmode = "none"\n[service]\nworkers = {workers}\n'
            f'[storage]\nfolder = "{path.parent / "store"}"\n[metrics]\nlisten = "127.0.0.1:{free_port()}"\n'
        )
        self.random = random.Random(seed)
        self.devices = dict.fromkeys(NAMES[:3], (10, 1))
        self.write()

    def change(self) -> None:
        """Add, remove, rename or change devices, and write the file."""
        for _ in range(self.random.randint(1, 3)):
            name, absent = self.random.choice([*self.devices]), [*{*NAMES} - {*self.devices}]
            match self.random.choice(("add", "remove", "rename", "change")):
                case "add" if absent:
                    self.devices[self.random.choice(sorted(absent))] = (10, 1)
                case "remove" if len(self.devices) > 1:
                    del self.devices[name]
                case "rename" if absent:
                    self.devices[self.random.choice(sorted(absent))] = self.devices.pop(name)
                case _:
                    self.devices[name] = (self.random.randint(10, 20), self.random.randint(1, 99))
        self.write()

    def write(self) -> None:
        tables = (DEVICE.format(name=name, window=w, seed=seed) for name, (w, seed) in self.devices.items())
        part = self._path.with_suffix(".part")
        part.write_text(self._head + "".join(tables))
        part.rename(self._path)


def names_in_metrics(daemon: DaemonProcess) -> set[str]:
    assert daemon.metrics is not None
    return {
        dict(zip(metric.labels, value.label_values, strict=True))["device"]
        for metric in daemon.metrics.read_metrics()
        if "device" in metric.labels
        for value in metric.values
    }


def replies(session: Any, selector: str) -> list[str]:
    """Return the devices that answer a query, with one entry for each reply."""
    return sorted(str(one.ok.key_expr).split("/")[1] for one in session.get(selector) if one.ok is not None)


def check_random_reloads(folder: Path, workers: int, reloads: int, seed: int) -> None:
    endpoint, rows, table = free_endpoint(), RowOutput(), TableOutput(RemoteDeviceRegistry())
    path = folder / "config.toml"
    file = RandomConfiguration(path, endpoint, workers, seed)
    config = loading.load_config(path)
    daemon: DaemonProcess = (
        Service(config, [rows, table]) if workers == 1 else WorkerSupervisor(config, workers, [rows, table])
    )
    thread = threading.Thread(target=daemon.run)
    thread.start()
    try:
        wait_for(lambda: len(rows.healths) == 3, "the first status")
        for _ in range(reloads):
            file.change()
            daemon.request_reload()
            time.sleep(file.random.choice((0.0, file.random.uniform(0.0, MAX_PAUSE_S))))  # a random moment
        configured = {*file.devices}
        wait_for(lambda: {*(one.name for one in daemon.config.devices)} == configured, "the last reload")

        def all_run() -> bool:
            newest = dict(rows.healths)
            return {*newest} == configured and all(one.state == "running" and not one.text for one in newest.values())

        wait_for(all_run, lambda: (configured, rows.healths))
        begun = {name: rows.healths[name].received for name in configured}
        wait_for(lambda: all(rows.healths[name].received > count for name, count in begun.items()), "more samples")
        wait_for(lambda: daemon.output_states()["zenoh"] == "ok", "the session")
        wait_for(lambda: names_in_metrics(daemon) == configured, lambda: names_in_metrics(daemon))
        assert {one.key.rpartition("/")[2] for one in table.states.devices_with_problems_first(0.0)} == configured
        with open_session(connect=[endpoint]) as session:
            wait_for(lambda: replies(session, "imu/*/command/reset"), "answers")
            assert replies(session, "imu/*/command/reset") == sorted(configured)
            alive = {str(one.ok.key_expr).split("/")[1] for one in session.liveliness().get("imu/*/alive")}
            assert alive == configured
            answering = replies(session, "imu/*/history?")
            assert len(answering) == len({*answering})
            assert {*answering} <= configured
        readers = [one.name for one in threading.enumerate() if one.name.startswith("reader of ")]
        assert sorted(readers) == (sorted(f"reader of {name}" for name in configured) if workers == 1 else [])
    finally:
        daemon.request_stop()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


def test_ten_random_reloads_end_in_the_configured_devices(tmp_path: Path) -> None:
    check_random_reloads(tmp_path, 1, 10, seed=1)


@pytest.mark.long
@pytest.mark.parametrize("workers", [1, 3])
def test_two_hundred_random_reloads_end_in_the_configured_devices(tmp_path: Path, workers: int) -> None:
    check_random_reloads(tmp_path, workers, 200, seed=2)
