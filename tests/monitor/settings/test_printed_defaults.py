"""Tests of the printed defaults, which must have every key of every table and be a valid configuration."""

import tomllib
from pathlib import Path
from typing import Any

import pytest

import drivers.decoders
from drivers.decoders.dbc.settings import SignalSettings
from drivers.driver import AxisMap
from drivers.errors import ConfigError
from drivers.units import ACCELERATION, RATE, TEMPERATURE
from drivers.validation import module_lookup
from drivers.validation.settings_model import SettingsModel, fields_by_key, find_settings_model
from monitor.commands.check_configuration import check_configuration
from monitor.settings import printed_defaults
from monitor.settings.driver_settings import FaultsTable, link_settings_class, list_link_names
from monitor.settings.schema import (
    ConfigFile,
    Device,
    Hook,
    Limit,
    LogTable,
    MetricsTable,
    Ros2Table,
    Storage,
    ViewerTable,
    ZenohTable,
)
from tests.support.settings import read_settings

LINKS = list_link_names()
DECODERS = module_lookup.list_modules(drivers.decoders)


def get_decoder_settings_class(name: str) -> type[SettingsModel]:
    settings: type[SettingsModel] = module_lookup.import_module(drivers.decoders, name).Settings
    return settings


MODELS = [
    *(
        ConfigFile,
        Device,
        Limit,
        Hook,
        ZenohTable,
        ViewerTable,
        Storage,
        MetricsTable,
        Ros2Table,
        LogTable,
        FaultsTable,
    ),
    *(SignalSettings, *map(link_settings_class, LINKS), *map(get_decoder_settings_class, DECODERS)),
]


def uncomment(text: str) -> str:
    """Return the text with commented keys and headers uncommented."""
    lines = (line.removeprefix("# ") for line in text.splitlines())
    return "\n".join(line for line in lines if line.startswith("[") or " = " in line.partition("#")[0])


@pytest.fixture
def folder_with_files(tmp_path: Path) -> Path:
    """Create the files to which the examples refer."""
    (tmp_path / "recording.csv").write_text("t,gz\n0.00,0.1\n0.01,0.2\n")
    (tmp_path / "zenoh.json5").write_text("{}")
    return tmp_path


def check_device_table(folder_with_files: Path, text: str) -> None:
    (folder_with_files / "my.toml").write_text(f'[[device]]\nname = "a"\nmodel = "consumer-mems"\n{text}\n', "utf-8")
    config, wrong = check_configuration(folder_with_files / "my.toml")
    assert wrong == []
    assert config is not None


def remove_keys(text: str, *keys: str) -> str:
    return "\n".join(line for line in text.splitlines() if not line.startswith(tuple(f"{key} = " for key in keys)))


@pytest.mark.parametrize("model", MODELS, ids=lambda model: f"{model.__module__}.{model.__name__}")
def test_every_key_has_a_description_and_a_value_or_example(model: type[SettingsModel]) -> None:
    for key, info in fields_by_key(model).items():
        assert info.description, key
        nothing = info.is_required() or info.default in (None, (), frozenset(), Path())
        assert not nothing or info.examples or find_settings_model(info.annotation), key


@pytest.mark.parametrize("model", MODELS, ids=lambda model: f"{model.__module__}.{model.__name__}")
def test_example_equals_the_default(model: type[SettingsModel]) -> None:
    minimum = {Limit: {"above": 1.0}, Hook: {"key": "a"}}.get(model, {})
    required = minimum | {
        key: info.examples[0] for key, info in fields_by_key(model).items() if info.is_required() if info.examples
    }
    for key, info in fields_by_key(model).items():
        if info.examples and not info.is_required() and info.default not in (None, "", (), frozenset(), Path(), {}):
            settings = read_settings(model, {**required, key: info.examples[0]})
            name = next(name for name, field in model.model_fields.items() if field is info)
            assert getattr(settings, name) == info.default, key


def test_printed_file_is_a_valid_configuration(tmp_path: Path) -> None:
    (tmp_path / "my.toml").write_text(printed_defaults.format_defaults(), "utf-8")
    config, wrong = check_configuration(tmp_path / "my.toml")
    assert wrong == []
    assert config is not None
    assert config.devices[0].axes == AxisMap()


def test_printed_file_has_every_table_with_every_key() -> None:
    text = printed_defaults.format_defaults()
    for key, info in fields_by_key(ConfigFile).items():
        model = find_settings_model(info.annotation)
        assert model is not None
        block = next(part for part in uncomment(text).split("\n[") if part.lstrip("[").startswith(f"{key}]"))
        own = {"driver", "axes", "limit"} if model is Device else set()
        assert set(parse_first_table(f"[{block}")) == set(fields_by_key(model)) - own
    for name in LINKS:
        assert f'link = "{name}"' in text
    for name in DECODERS:
        assert f'# decoder = "{name}"' in text


def parse_first_table(block: str) -> dict[str, Any]:
    """Parse the keys of the first table of the text."""
    return tomllib.loads("\n".join(line for line in block.splitlines() if not line.startswith("[")))


@pytest.mark.parametrize("link", LINKS)
def test_link_table_has_every_key_and_is_valid(folder_with_files: Path, link: str) -> None:
    text = uncomment(printed_defaults.format_link_defaults(link))
    first = text.split("[device.driver.faults]")[0]
    assert set(parse_first_table(first)) - {"link", "decoder"} == set(fields_by_key(link_settings_class(link))) - {
        "faults"
    }
    if link == "can":
        text += "\n" + remove_keys(uncomment(printed_defaults.format_decoder_defaults("dbc")), "valid")
    if link == "iio":  # the keys trigger and sampling_frequency need this key
        text = text.replace("enable = false", "enable = true")
    check_device_table(folder_with_files, text)


@pytest.mark.parametrize("decoder", DECODERS)
def test_decoder_table_has_every_key_and_is_valid(folder_with_files: Path, decoder: str) -> None:
    text = uncomment(printed_defaults.format_decoder_defaults(decoder))
    assert set(parse_first_table(text)) == set(fields_by_key(get_decoder_settings_class(decoder)))
    # No shipped database with a counter has a validity signal. A pattern replaces the columns.
    text = remove_keys(text, "valid", "pattern")
    check_device_table(folder_with_files, f'[device.driver]\nlink = "virtual"\ndecoder = "{decoder}"\n{text}')


def test_repeatable_tables_are_valid(folder_with_files: Path) -> None:
    program = folder_with_files / "tell"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    text = uncomment(printed_defaults.format_defaults())
    blocks = [f"[[{part}" for part in text.split("\n[[")[1:] if part.startswith(("device.limit", "hook"))]
    (limit, hook) = (block.split("\n[m")[0].split("\n[z")[0] for block in blocks)
    hook = hook.replace("/usr/local/bin/tell", "./tell").replace('"bench-1"', '"a"')
    check_device_table(
        folder_with_files, f'driver = {{ link = "virtual" }}\n{remove_keys(limit, "times_model")}\n{hook}'
    )


def test_unknown_name_is_refused_with_a_suggestion() -> None:
    with pytest.raises(ConfigError, match='"seral"; possible are serial, '):
        printed_defaults.format_link_defaults("seral")
    with pytest.raises(ConfigError, match='"tekst"; possible are text, '):
        printed_defaults.format_decoder_defaults("tekst")


@pytest.mark.parametrize(
    ("key", "table"), [("gyro_unit", RATE), ("accel_unit", ACCELERATION), ("temperature_unit", TEMPERATURE)]
)
def test_every_unit_is_listed(key, table):
    [line] = [
        line for line in printed_defaults.format_decoder_defaults("text").splitlines() if line.startswith(f"{key} = ")
    ]
    assert line.rpartition(": ")[2].split(", ") == list(table)
