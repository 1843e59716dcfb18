"""Every public layout is read rightly, or is refused with a message whose advice leads to the right samples."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from drivers.data_types import AXES
from drivers.errors import ImuError, UnknownColumnsError
from drivers.recordings import Recording
from drivers.recordings.reading_options import create_reading_options, parse_column_mapping
from monitor.commands.recording_loading import LoadingOptions, load_recording
from tests.drivers.public_layouts import LAYOUTS, Layout, Sensor, simulate_sensor

OPTION = re.compile(r"--([a-z-]+)((?: (?!--)[^\s]+)?)")


def read(path: Path, options: dict[str, str]) -> Recording:
    """Read a file as ``imu-monitor analyze`` does."""
    values: dict[str, object] = {key.replace("-", "_"): value for key, value in options.items() if key != "rate"}
    if "columns" in options:
        values["columns"] = parse_column_mapping(options["columns"])
    rate_hz = float(options["rate"]) if "rate" in options else None
    return load_recording(path, LoadingOptions(rate_hz, reading=create_reading_options(values)))


def read_by_messages(layout: Layout, path: Path) -> tuple[Recording, dict[str, str]]:
    """Read a file with the options that the messages ask for."""
    known = {name: value.strip() for name, value in OPTION.findall(layout.options)}
    options: dict[str, str] = {}
    for _ in range(4):
        try:
            return read(path, options), options
        except ImuError as error:
            message = str(error)
            has_columns = isinstance(error, UnknownColumnsError)
        assert str(path) in message
        assert has_columns == ("imu-monitor analyze" in message)
        command = dict(OPTION.findall(message.partition("imu-monitor analyze ")[2]))
        asked = [name for name in known if f"--{name}" in message and name not in options]
        assert asked, message
        for name in asked:
            options[name] = known[name] or command[name].strip().replace("HZ", f"{layout.rate_hz:g}")
        if "topic" in asked:
            assert options["topic"] in message
    raise AssertionError(message)


def measured_rate_hz(found: Recording) -> float:
    if found.rate_hz is not None:
        return found.rate_hz
    assert found.t_s is not None
    return float((len(found) - 1) / (found.t_s[-1] - found.t_s[0]))


def require_samples(found: Recording, layout: Layout, sensor: Sensor) -> None:
    assert found.axes == layout.axes
    assert len(found) == len(sensor.t)
    assert measured_rate_hz(found) == pytest.approx(layout.rate_hz, rel=0.01)
    truth = np.hstack([sensor.gyro, sensor.accel])
    for axis in layout.axes:
        i = AXES.index(axis)
        assert np.abs(found.values[:, i] - truth[:, i]).max() <= layout.resolution, axis


@pytest.mark.parametrize("layout", LAYOUTS, ids=[layout.name for layout in LAYOUTS])
def test_layout(layout: Layout, tmp_path: Path) -> None:
    sensor = simulate_sensor(layout.rate_hz)
    path = layout.write(sensor, tmp_path)
    if layout.refused:
        with pytest.raises(ImuError, match=re.escape(layout.refused)):
            read(path, {})
        return
    found, options = read_by_messages(layout, path)
    assert {*options} == {name for name, _ in OPTION.findall(layout.options)}
    require_samples(found, layout, sensor)


def test_unknown_columns_are_listed_with_a_command_that_can_be_copied(tmp_path: Path) -> None:
    layout = next(one for one in LAYOUTS if one.name == "PAMAP2")
    path = layout.write(simulate_sensor(layout.rate_hz), tmp_path)
    with pytest.raises(UnknownColumnsError) as error:
        read(path, {})
    lines = error.value.column_lines
    assert len(lines) == 1 + 54
    assert lines[5].split() == ["5", "column", "5", *lines[5].split()[3:]]
    assert [line.split()[1] for line in lines[11:14]] == ["gx", "gy", "gz"]
    command = str(error.value).partition("such as ")[2].partition("such as ")[2]
    assert shlex.split(command)[:3] == ["imu-monitor", "analyze", str(path)]
