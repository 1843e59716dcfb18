"""Tests of the number of workers and of the distribution of devices."""

import os
from pathlib import Path

import pytest

from monitor.daemon.workers.device_spreading import count_workers, spread_devices
from monitor.settings import loading


def load(folder: Path, rates: list[float | None], head: str = "") -> loading.Config:
    path = folder / "config.toml"
    devices = [
        f'[[device]]\nname = "d{i}"\n{f"rate = {rate}" if rate else ""}\ndriver = {{ link = "virtual" }}\n'
        for i, rate in enumerate(rates)
    ]
    path.write_text(head + "".join(devices))
    return loading.load_config(path)


@pytest.mark.parametrize(
    ("rates", "head", "expected"),
    [
        ([1000.0] * 8, "", 1),
        ([1000.0] * 9, "", 2),
        ([None] * 9, "", 2),
        ([1000.0] * 60, "", 4),
        ([100.0] * 64, "", 1),
        ([1000.0] * 60, "[service]\nworkers = 1\n", 1),
        ([100.0] * 3, "[service]\nworkers = 2\n", 2),
        ([100.0] * 3, "[service]\nworkers = 64\n", 3),
    ],
)
def test_number_of_workers_follows_rates_and_setting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rates: list[float | None], head: str, expected: int
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    assert count_workers(load(tmp_path, rates, head)) == expected


def test_devices_are_spread_by_rate_and_stay_where_they_are(tmp_path: Path) -> None:
    config = load(tmp_path, [100.0, 1000.0, 100.0, 900.0])
    places = spread_devices(config.devices, 2, {})
    assert places == {"d1": 0, "d3": 1, "d0": 1, "d2": 0}
    assert spread_devices(config.devices[:2], 2, places) == {"d1": 0, "d0": 1}
    assert spread_devices(config.devices, 2, {"d1": 1, "d0": 1}) == {"d1": 1, "d0": 1, "d3": 0, "d2": 0}
