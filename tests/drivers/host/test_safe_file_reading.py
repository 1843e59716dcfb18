"""Tests of reading small files completely and refusing large ones."""

from pathlib import Path

import pytest

from drivers.errors import ConfigError
from drivers.host import safe_file_reading
from monitor.commands import thermal
from monitor.noise.model_loading import read_model
from monitor.settings import loading


def test_small_file_is_read_completely(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"1\r\n2")
    assert safe_file_reading.read_small_file(tmp_path / "a") == b"1\r\n2"


def test_every_reader_refuses_a_file_that_is_too_large(tmp_path: Path) -> None:
    path = tmp_path / "big"
    with path.open("wb") as file:
        file.truncate(safe_file_reading.MAX_BYTES + 1)
    with pytest.raises(OSError, match="more than 32 MB"):
        safe_file_reading.read_small_file(path)
    reading = loading.examine_config_file(path)
    config, wrong = reading.config, reading.wrong
    assert config is None
    assert "more than 32 MB" in wrong[0]
    for read in (read_model, thermal.read_model_file):
        with pytest.raises(ConfigError, match="more than 32 MB"):
            read(path)
