"""Tests of the command ``identify`` on a pseudo-terminal and on files."""

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from drivers.data_types import Chunk
from drivers.decoders.binary_frames.stim300 import Stim300Decoder
from drivers.errors import ConfigError, LinkUnavailable, NotReady
from monitor.cli import app
from monitor.commands import identify
from monitor.settings.loading import load_config
from tests.contracts.decoder_examples import EPSON, STIM300, TEXT, Example
from tests.drivers.test_wire_format_identification import ISSUE_LINE, encode_capture, write_text_lines


@contextmanager
def open_sending_terminal(data: bytes) -> Iterator[str]:
    """Yield the path of a pseudo-terminal on which ``data`` arrives again and again."""
    master, slave = os.openpty()
    os.set_blocking(master, False)
    stop = threading.Event()

    def send() -> None:
        at = 0
        while not stop.wait(0.002):
            try:
                at += os.write(master, data[at : at + 200])
            except BlockingIOError:
                continue
            at %= len(data)

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield os.ttyname(slave)
    finally:
        stop.set()
        thread.join()
        os.close(master)
        os.close(slave)


def test_sensor_on_a_port_is_identified_with_a_valid_configuration(tmp_path: Path) -> None:
    lines: list[str] = []
    with open_sending_terminal(encode_capture(STIM300, tmp_path)) as port:
        found = identify.identify_port(port, 60.0, lines.append)
    assert (found.source, found.format.decoder, found.baudrate, lines) == (port, "stim300", 115200, [])
    assert found.format.rate_hz is not None
    path = tmp_path / "bench.toml"
    path.write_text(identify.write_configuration(found))
    (device,) = load_config(path).devices
    assert isinstance(device.driver.decoder, Stim300Decoder)


def test_port_with_noise_reports_each_baud_rate() -> None:
    lines: list[str] = []
    noise = np.random.default_rng(5).bytes(5000).replace(b"\x55", b"")
    with open_sending_terminal(noise) as port, pytest.raises(NotReady, match="no decoder finds samples"):
        identify.identify_port(port, 0.1, lines.append)
    assert [int(line.split()[0]) for line in lines] == list(identify.BAUD_RATES)


def test_silent_port_names_the_wiring() -> None:
    master, slave = os.openpty()
    with pytest.raises(NotReady, match="no bytes at any baud rate; check the power"):
        identify.identify_port(os.ttyname(slave), 0.01, lambda line: None)
    os.close(master)
    os.close(slave)


def test_unknown_kind_of_url_is_one_error() -> None:
    with pytest.raises(ConfigError, match=r'port: "udp://127\.0\.0\.1:1" has an unknown kind of URL'):
        identify.identify_port("udp://127.0.0.1:1", 0.01, lambda line: None)


def test_missing_port_is_one_error() -> None:
    with pytest.raises(LinkUnavailable, match="no such port"):
        identify.identify_port("/dev/ttyNOTHERE", 0.01, lambda line: None)


@pytest.mark.parametrize("example", [EPSON, STIM300, TEXT], ids=lambda example: example.name)
def test_command_prints_the_configuration_of_a_capture(example: Example, tmp_path: Path) -> None:
    path = tmp_path / "capture.bin"
    path.write_bytes(encode_capture(example, tmp_path))
    result = CliRunner().invoke(app, ["identify", str(path)])
    assert result.exit_code == 0
    assert f'decoder = "{example.name}"' in result.stdout
    assert "found " in result.stderr
    assert ('gyro_unit = "rad/s"  # CHOOSE' in result.stdout) == (example.name == "text")
    assert ('model = "?"' in result.stdout) == (example.name == "epson_uart")


def test_file_without_samples_is_not_identified(tmp_path: Path) -> None:
    path = tmp_path / "capture.bin"
    path.write_bytes(b"booting\n" * 100)
    with pytest.raises(NotReady, match='the text is readable, but its lines have no known layout: "booting"'):
        identify.identify_file(path)


def test_labelled_text_on_a_port_gives_a_configuration_that_works_when_copied(tmp_path: Path) -> None:
    data, _ = write_text_lines(ISSUE_LINE, 1.0)
    with open_sending_terminal(data) as port:
        result = CliRunner().invoke(app, ["identify", port])
    assert result.exit_code == 0, result.stderr
    assert result.stderr.count(" baud: ") == 0  # no other baud rate was tried
    assert "received: A:0." in result.stderr
    assert 'gyro_unit = "deg/s"  # CHOOSE the unit' in result.stdout
    path = tmp_path / "bench.toml"
    path.write_text(result.stdout)
    (device,) = load_config(path).devices
    (block,) = device.driver.decoder.feed([Chunk(data, 0)])
    assert len(block) == 39
    assert np.linalg.norm(block.values[:, 3:], axis=1) == pytest.approx(9.81, rel=0.05)


def test_readable_text_without_a_layout_is_shown_and_ends_the_search() -> None:
    lines: list[str] = []
    with (
        open_sending_terminal(b"waiting\x1b[0m for the sensor\r\n") as port,
        pytest.raises(NotReady, match=r"115200 baud: the text is readable, .*waiting\\\\x1b\[0m for the sensor"),
    ):
        identify.identify_port(port, 0.5, lines.append)
    assert lines == []


def test_too_few_lines_of_text_ask_for_a_longer_time(tmp_path: Path) -> None:
    path = tmp_path / "capture.txt"
    path.write_bytes(b"".join(write_text_lines(ISSUE_LINE, 9.81)[0].splitlines(keepends=True)[:5]))
    with pytest.raises(NotReady, match="at least 7 lines are needed; try a longer time with --seconds"):
        identify.identify_file(path)
