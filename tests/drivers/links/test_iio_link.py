"""Tests of the link to IIO devices, with a folder tree in place of sysfs and a named pipe in place of the device."""

import errno
import json
import os
import struct
from pathlib import Path
from typing import Any

import pytest

from drivers.data_types import Chunk
from drivers.errors import ConfigError, LinkLost, LinkUnavailable
from drivers.links import iio_link
from drivers.links.iio_link import BUFFER_SCANS, IioLink, Settings
from tests.support.fake_iio_device import FakeIioDevice
from tests.support.settings import read_settings

CHANNELS = {
    "in_accel_x": "le:s16/16>>0",
    "in_anglvel_x": "le:s16/16>>0",
    "in_anglvel_y": "le:s16/16>>0",
    "in_magn_x": "le:s16/16>>0",
    "in_temp": "be:s16/16>>0",
    "in_timestamp": "le:s64/64>>0",
}
ATTRIBUTES = {
    "in_accel_scale": "0.5",
    "in_anglvel_scale": "0.25",
    "in_anglvel_y_scale": "0.125",
    "in_temp_scale": "2",
    "in_temp_offset": "-3",
    "in_anglvel_sampling_frequency": "100",
    "in_accel_sampling_frequency": "100",
    "current_timestamp_clock": "realtime",
}
SCAN_BYTES = 16  # without in_magn_x


def build(root: Path, device: str = "bmi160", **keys: Any) -> IioLink:
    return IioLink(read_settings(Settings, {"device": device, **keys}), root)


def read_all(link: IioLink) -> list[Chunk]:
    return link.wait_for_chunks_or_timeout(30.0) or []


def test_layout_is_read_from_sysfs(tmp_path: Path) -> None:
    device = FakeIioDevice(tmp_path, "bmi160", CHANNELS, ATTRIBUTES, enabled=True)
    (device.folder / "scan_elements/in_magn_x_en").write_text("0\n")
    link = build(tmp_path)
    link.open()
    device.write(bytes(SCAN_BYTES))
    [chunk] = read_all(link)
    layout = json.loads(chunk.attachment)
    assert layout["clock"] == "realtime"
    assert [tuple(one.values()) for one in layout["elements"]] == [
        ("in_accel_x", "le:s16/16>>0", 0.5, 0.0),
        ("in_anglvel_x", "le:s16/16>>0", 0.25, 0.0),
        ("in_anglvel_y", "le:s16/16>>0", 0.125, 0.0),
        ("in_temp", "be:s16/16>>0", 2.0, -3.0),
        ("in_timestamp", "le:s64/64>>0", 1.0, 0.0),
    ]
    link.close()
    assert device.read("buffer/length") == "2"
    device.unplug()


def test_a_scan_that_arrives_in_two_parts_is_joined(tmp_path: Path) -> None:
    device = FakeIioDevice(tmp_path, "bmi160", {"in_timestamp": "le:s64/64>>0"}, enabled=True)
    link = build(tmp_path)
    link.open()
    sent = struct.pack("<5q", *range(5))
    device.write(sent[:20])
    received = b"".join(chunk.data for chunk in read_all(link))
    assert received == sent[:16]
    device.write(sent[20:23])
    assert link.wait_for_chunks_or_timeout(0.2) is None
    device.write(sent[23:])
    assert received + b"".join(chunk.data for chunk in read_all(link)) == sent
    # the rest of a scan is discarded when the link is opened again
    device.write(b"123")
    assert link.wait_for_chunks_or_timeout(0.2) is None
    link.close()
    link.open()
    device.write(sent)
    assert b"".join(chunk.data for chunk in read_all(link)) == sent
    link.close()
    device.unplug()


def test_enabling_the_buffer_is_undone_by_close(tmp_path: Path) -> None:
    device = FakeIioDevice(tmp_path, "bmi160", CHANNELS, ATTRIBUTES)
    before = {path: path.read_text().strip() for path in device.folder.rglob("*") if path.is_file()}
    link = build(tmp_path, enable=True, trigger="hrtimer0", sampling_frequency=1600)
    link.open()
    for name in CHANNELS:
        assert device.read(f"scan_elements/{name}_en") == ("0" if name == "in_magn_x" else "1")
    assert device.read("trigger/current_trigger") == "hrtimer0"
    assert device.read("in_accel_sampling_frequency") == device.read("in_anglvel_sampling_frequency") == "1600"
    assert device.read("buffer/length") == str(BUFFER_SCANS)
    assert device.read("buffer/enable") == "1"
    device.write(bytes(SCAN_BYTES))
    assert len(read_all(link)[0].data) == SCAN_BYTES
    link.close()
    assert {path: path.read_text().strip() for path in before} == before
    device.unplug()


def test_buffer_that_was_enabled_is_enabled_again(tmp_path: Path) -> None:
    device = FakeIioDevice(tmp_path, "bmi160", CHANNELS, ATTRIBUTES, enabled=True)
    link = build(tmp_path, enable=True)
    link.open()
    link.close()
    assert device.read("buffer/enable") == "1"
    device.unplug()


def test_failed_opening_restores_the_attributes(tmp_path: Path) -> None:
    device = FakeIioDevice(tmp_path, "bmi160", CHANNELS | {"in_accel_z": "le:f32/32>>0"}, ATTRIBUTES)
    link = build(tmp_path, enable=True)
    with pytest.raises(LinkUnavailable, match=r'scan_elements: in_accel_z: unknown type "le:f32/32>>0"; disable'):
        link.open()
    assert device.read("scan_elements/in_accel_x_en") == device.read("buffer/enable") == "0"
    device.unplug()


def test_disabled_buffer_is_reported(tmp_path: Path) -> None:
    device = FakeIioDevice(tmp_path, "bmi160", CHANNELS, ATTRIBUTES)
    with pytest.raises(LinkUnavailable, match="IIO device bmi160: the buffer is not enabled; set enable = true, or"):
        build(tmp_path).open()
    device.unplug()


def test_device_is_found_by_name_or_number(tmp_path: Path) -> None:
    devices = [
        FakeIioDevice(tmp_path, name, {"in_timestamp": "le:s64/64>>0"}, number=number, enabled=True)
        for number, name in enumerate(("adis16475-2", "lsm6dsr_gyro", "lsm6dsr_accel", "lsm6dsr_accel"))
    ]
    for word, number in (("adis16475-2", 0), ("1", 1), ("lsm6dsr_gyro", 1), ("3", 3)):
        assert iio_link.find_device(word, tmp_path)[0] == devices[number].folder
    with pytest.raises(LinkUnavailable, match="several devices have this name; give the number: iio:device0 "):
        build(tmp_path, "lsm6dsr_accel").open()
    with pytest.raises(LinkUnavailable, match=r"bmi160: no such device; .* here: iio:device0 \(adis16475-2\), "):
        build(tmp_path, "bmi160").open()
    for device in devices:
        device.unplug()
    with pytest.raises(LinkUnavailable, match="IIO devices here: none"):
        build(tmp_path, "0").open()


@pytest.mark.parametrize(
    ("number", "text"),
    [
        (errno.EACCES, "no permission; a udev rule has to give"),
        (errno.EBUSY, "another program reads this device"),
        (errno.ENODEV, "no character device; "),
        (errno.EIO, "cannot be opened: Input/output error"),
    ],
)
def test_reason_why_the_device_cannot_be_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, text: str
) -> None:
    device = FakeIioDevice(tmp_path, "bmi160", CHANNELS, ATTRIBUTES, enabled=True)

    def fail(*arguments: Any, **keys: Any) -> int:
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patch:
        patch.setattr(os, "open", fail)
        with pytest.raises(LinkUnavailable) as raised:
            build(tmp_path).open()
    assert str(raised.value).startswith(f"IIO device bmi160: {device.node}: {text}")
    device.unplug()


def test_missing_permission_to_write_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    device = FakeIioDevice(tmp_path, "bmi160", CHANNELS, ATTRIBUTES)

    def refuse(path: Path, text: str) -> int:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_text", refuse)
        with pytest.raises(LinkUnavailable, match=r'buffer/enable: cannot write "0": Permission denied; a udev rule'):
            build(tmp_path, enable=True).open()
    device.unplug()


def test_invalid_attributes_are_reported(tmp_path: Path) -> None:
    device = FakeIioDevice(tmp_path, "bmi160", CHANNELS, ATTRIBUTES | {"in_accel_scale": "half"}, enabled=True)
    with pytest.raises(LinkUnavailable, match='in_accel_scale: expected a number, got "half"'):
        build(tmp_path).open()
    device.unplug()


def test_sampling_frequency_that_the_driver_lacks_is_reported(tmp_path: Path) -> None:
    device = FakeIioDevice(tmp_path, "bmi160", CHANNELS)
    with pytest.raises(LinkUnavailable, match="the driver has no sampling_frequency; remove this key"):
        build(tmp_path, enable=True, sampling_frequency=100.0).open()
    device.unplug()


def test_removed_device_raises_link_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    device = FakeIioDevice(tmp_path, "bmi160", CHANNELS, ATTRIBUTES)
    link = build(tmp_path, enable=True)
    link.open()

    def fail(file: int, size: int) -> bytes:
        raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))

    with monkeypatch.context() as patch:
        patch.setattr(os, "read", fail)
        with pytest.raises(LinkLost, match=r"IIO device bmi160: the device is gone \(unplugged\?\): No such device"):
            link.wait_for_chunks_or_timeout(30.0)
    device.unplug()
    link.close()


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        ({"device": ""}, "device: empty; it is the name of an IIO device"),
        ({"device": "0", "trigger": "t"}, "trigger: the link writes nothing to the device unless enable = true"),
        ({"device": "0", "sampling_frequency": 100.0}, "sampling_frequency: the link writes nothing"),
        ({"device": "0", "enable": True, "sampling_frequency": 0.0}, "sampling_frequency: 0 Hz is outside"),
        ({}, "device: missing"),
    ],
)
def test_invalid_settings_are_refused(keys: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        read_settings(Settings, keys)
