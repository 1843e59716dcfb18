"""Tests of the number of workers and of the distribution of devices."""

import os
from pathlib import Path

import pytest

from monitor.daemon.workers.device_spreading import count_workers, spread_devices
from monitor.settings import loading


def load(folder: Path, devices: int, head: str = "") -> loading.Config:
    path = folder / "config.toml"
    device = '[[device]]\nname = "d{i}"\ndriver = {{ link = "virtual" }}\n'
    path.write_text(head + "".join(device.format(i=i) for i in range(devices)))
    return loading.load_config(path)


@pytest.mark.parametrize(
    ("devices", "setting", "expected"),
    [(8, "", 1), (9, "", 2), (60, "", 4), (60, "workers = 1", 1), (3, "workers = 2", 2), (3, "workers = 64", 3)],
)
def test_number_of_workers_follows_devices_and_setting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, devices: int, setting: str, expected: int
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    assert count_workers(load(tmp_path, devices, f"[service]\n{setting}\n")) == expected


def test_devices_are_spread_evenly_and_stay_where_they_are(tmp_path: Path) -> None:
    devices = load(tmp_path, 4).devices
    assert spread_devices(devices, 2, {}) == {"d0": 0, "d1": 1, "d2": 0, "d3": 1}
    assert spread_devices(devices[1:], 2, {"d0": 0, "d1": 1, "d3": 1}) == {"d1": 1, "d3": 1, "d2": 0}
