"""Tests of the table ``[ros2]``: namespaces, frames, and devices whose names ROS 2 does not accept."""

from pathlib import Path

import pytest

from monitor.settings.loading import ConfigReading, examine_config_file

DEVICE = '[[device]]\nname = "{}"\ndriver = {{ link = "virtual" }}\n{}\n'
ROS2 = "[ros2]\ndomain = 0\n"


def examine(folder: Path, text: str) -> ConfigReading:
    path = folder / "config.toml"
    path.write_text(text)
    return examine_config_file(path)


def examine_one_device(folder: Path, ros2: str, device: str = "") -> ConfigReading:
    return examine(folder, DEVICE.format("bench-1", device) + ros2)


def test_nothing_is_published_without_domain(tmp_path: Path) -> None:
    reading = examine_one_device(tmp_path, '[ros2]\nimu = "raw"\n')
    assert reading.config is not None
    assert reading.config.ros2 is None


@pytest.mark.parametrize(
    ("written", "expected"),
    [("", "/"), ("/", "/"), ("robot1", "/robot1"), ("/robot1/arm_2", "/robot1/arm_2"), ("robot1/", "/robot1")],
)
def test_namespace_begins_with_a_slash(tmp_path: Path, written: str, expected: str) -> None:
    config = examine_one_device(tmp_path, f'{ROS2}namespace = "{written}"\n').config
    assert config is not None
    assert config.ros2 is not None
    assert (config.ros2.domain, config.ros2.namespace) == (0, expected)


@pytest.mark.parametrize("namespace", ["robot-1", "1robot", "a//b", "a b", "$robot", "robot/*"])
def test_invalid_namespace_is_refused(tmp_path: Path, namespace: str) -> None:
    [line] = examine_one_device(tmp_path, f'{ROS2}namespace = "{namespace}"\n').wrong
    assert f'ros2.namespace: "{namespace}" is not a namespace of ROS' in line


@pytest.mark.parametrize("frame", ["", "/imu_link", "imu link", "imu\\u0001", "x" * 256])
def test_invalid_frame_is_refused(tmp_path: Path, frame: str) -> None:
    [line] = examine_one_device(tmp_path, ROS2, f'frame_id = "{frame}"').wrong
    assert "device bench-1: frame_id: " in line


def test_name_that_begins_with_a_digit_is_refused(tmp_path: Path) -> None:
    text = DEVICE.format("1-bench", "") + ROS2
    [line] = examine(tmp_path, text).wrong
    assert '"1-bench" begins with a digit, which ROS 2 refuses' in line
    assert examine(tmp_path, text + 'imu = "none"\n').wrong == []


def test_names_that_are_equal_in_ros_are_refused(tmp_path: Path) -> None:
    text = DEVICE.format("a-1", "") + DEVICE.format("a_1", "")
    assert examine(tmp_path, text).wrong == []
    [line] = examine(tmp_path, text + ROS2).wrong
    assert '"a_1" and "a-1" have the same name in ROS 2, a_1' in line


def test_compensated_samples_need_the_compensation(tmp_path: Path) -> None:
    [line] = examine_one_device(tmp_path, f'{ROS2}imu = "compensated"\n', "compensate = false").wrong
    assert 'device bench-1: compensate: false, but ros2.imu is "compensated"' in line
    assert examine_one_device(tmp_path, ROS2, "compensate = false").wrong == []
