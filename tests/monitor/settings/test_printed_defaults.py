"""The printed defaults have all keys of all tables, links and decoders, and are a valid configuration."""

import tomllib
from pathlib import Path
from typing import Any

import pytest

import drivers.decoders
from drivers import module_lookup
from drivers.decoders.dbc.settings import SignalSettings
from drivers.driver import AxisMap
from drivers.errors import ConfigError
from drivers.settings_model import SettingsModel, fields_by_key, find_settings_model
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
    Storage,
    ViewerTable,
    ZenohTable,
)
from tests.support.settings import read_settings

LINKS = list_link_names()
DECODERS = module_lookup.list_modules(drivers.decoders)


def decoder_settings(name: str) -> type[SettingsModel]:
    settings: type[SettingsModel] = module_lookup.import_module(drivers.decoders, name).Settings
    return settings


MODELS = [
    *(ConfigFile, Device, Limit, Hook, ZenohTable, ViewerTable, Storage, MetricsTable, LogTable, FaultsTable),
    *(SignalSettings, *map(link_settings_class, LINKS), *map(decoder_settings, DECODERS)),
]


def uncommented(text: str) -> str:
    """The text with its commented keys and headers as keys and headers."""
    lines = (line.removeprefix("# ") for line in text.splitlines())
    return "\n".join(line for line in lines if line.startswith("[") or " = " in line.partition("#")[0])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the files that the examples name."""
    (tmp_path / "recording.csv").write_text("t,gz\n0.00,0.1\n0.01,0.2\n")
    (tmp_path / "zenoh.json5").write_text("{}")
    return tmp_path


def check_text(folder: Path, text: str) -> None:
    (folder / "my.toml").write_text(f'[[device]]\nname = "a"\nmodel = "consumer-mems"\n{text}\n', "utf-8")
    config, wrong = check_configuration(folder / "my.toml")
    assert wrong == []
    assert config is not None


def without(text: str, *keys: str) -> str:
    return "\n".join(line for line in text.splitlines() if not line.startswith(tuple(f"{key} = " for key in keys)))


@pytest.mark.parametrize("model", MODELS, ids=lambda model: f"{model.__module__}.{model.__name__}")
def test_every_key_has_a_description_and_something_to_print(model: type[SettingsModel]) -> None:
    for key, info in fields_by_key(model).items():
        assert info.description, key
        nothing = info.is_required() or info.default in (None, (), frozenset(), Path())
        assert not nothing or info.examples or find_settings_model(info.annotation), key


@pytest.mark.parametrize("model", MODELS, ids=lambda model: f"{model.__module__}.{model.__name__}")
def test_an_example_of_a_default_has_its_value(model: type[SettingsModel]) -> None:
    needed = {Limit: {"above": 1.0}, Hook: {"key": "a"}}.get(model, {})
    required = needed | {
        key: info.examples[0] for key, info in fields_by_key(model).items() if info.is_required() if info.examples
    }
    for key, info in fields_by_key(model).items():
        if info.examples and not info.is_required() and info.default not in (None, "", (), frozenset(), Path(), {}):
            settings = read_settings(model, {**required, key: info.examples[0]})
            name = next(name for name, one in model.model_fields.items() if one is info)
            assert getattr(settings, name) == info.default, key


def test_the_file_is_a_valid_configuration(tmp_path: Path) -> None:
    (tmp_path / "my.toml").write_text(printed_defaults.format_defaults(), "utf-8")
    config, wrong = check_configuration(tmp_path / "my.toml")
    assert wrong == []
    assert config is not None
    assert config.devices[0].axes == AxisMap()


def test_the_file_has_every_table_with_every_key() -> None:
    text = printed_defaults.format_defaults()
    for key, info in fields_by_key(ConfigFile).items():
        model = find_settings_model(info.annotation)
        assert model is not None
        block = next(one for one in uncommented(text).split("\n[") if one.lstrip("[").startswith(f"{key}]"))
        own = {"driver", "axes", "limit"} if model is Device else set()
        assert set(printed_keys(f"[{block}")) == set(fields_by_key(model)) - own
    for name in LINKS:
        assert f'link = "{name}"' in text
    for name in DECODERS:
        assert f'# decoder = "{name}"' in text


def printed_keys(block: str) -> dict[str, Any]:
    """The keys of the first table of a text."""
    return tomllib.loads("\n".join(line for line in block.splitlines() if not line.startswith("[")))


@pytest.mark.parametrize("link", LINKS)
def test_the_table_of_a_link_has_every_key_and_passes_the_check(folder: Path, link: str) -> None:
    text = uncommented(printed_defaults.format_link_defaults(link))
    first = text.split("[device.driver.faults]")[0]
    assert set(printed_keys(first)) - {"link", "decoder"} == set(fields_by_key(link_settings_class(link))) - {"faults"}
    if link == "can":
        text += "\n" + without(uncommented(printed_defaults.format_decoder_defaults("dbc")), "valid")
    check_text(folder, text)


@pytest.mark.parametrize("decoder", DECODERS)
def test_the_table_of_a_decoder_has_every_key_and_passes_the_check(folder: Path, decoder: str) -> None:
    text = uncommented(printed_defaults.format_decoder_defaults(decoder))
    assert set(printed_keys(text)) == set(fields_by_key(decoder_settings(decoder)))
    # no shipped database with a counter has a signal for valid
    check_text(folder, f'[device.driver]\nlink = "virtual"\ndecoder = "{decoder}"\n{without(text, "valid")}')


def test_tables_that_may_be_repeated_pass_the_check(folder: Path) -> None:
    program = folder / "tell"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    text = uncommented(printed_defaults.format_defaults())
    blocks = [f"[[{one}" for one in text.split("\n[[")[1:] if one.startswith(("device.limit", "hook"))]
    (limit, hook) = (block.split("\n[m")[0].split("\n[z")[0] for block in blocks)
    hook = hook.replace("/usr/local/bin/tell", "./tell").replace('"bench-1"', '"a"')
    check_text(folder, f'driver = {{ link = "virtual" }}\n{without(limit, "times_model")}\n{hook}')


def test_an_unknown_name_is_answered_with_the_nearest_one() -> None:
    with pytest.raises(ConfigError, match='"seral"; possible are serial, '):
        printed_defaults.format_link_defaults("seral")
    with pytest.raises(ConfigError, match='"tekst"; possible are text, '):
        printed_defaults.format_decoder_defaults("tekst")
