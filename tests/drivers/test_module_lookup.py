"""Plug-ins are found by listing a folder; a wrong name is answered with the nearest known one."""

import importlib
import sys

import pytest

from drivers import decoders, links
from drivers.errors import ConfigError
from drivers.module_lookup import format_suggestion, import_module, list_modules


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A folder of plug-ins on the import path; modules say so when they are imported."""
    folder = tmp_path / "some_plugins"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    for name in ("base", "serial_link", "can_link", "table"):
        (folder / f"{name}.py").write_text(f"NAME = {name!r}\n")
    (folder / "broken_link.py").write_text("raise RuntimeError('imported')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    yield importlib.import_module("some_plugins")
    for name in [name for name in sys.modules if name.partition(".")[0] == "some_plugins"]:
        del sys.modules[name]


def test_names_are_sorted_and_without_suffix(package):
    assert list_modules(package, "_link") == ("broken", "can", "serial")


def test_base_is_no_member(package):
    assert "base" not in list_modules(package)
    assert "table" in list_modules(package)


def test_listing_imports_nothing(package):
    list_modules(package, "_link")
    assert not any(name.startswith("some_plugins.") for name in sys.modules)


def test_load_imports_the_one_asked_for(package):
    assert import_module(package, "serial", "_link").NAME == "serial_link"
    assert "some_plugins.can_link" not in sys.modules


def test_an_error_inside_a_plugin_is_not_hidden(package):
    with pytest.raises(RuntimeError, match="imported"):
        import_module(package, "broken", "_link")


def test_unknown_name_gets_all_names_the_nearest_first(package):
    with pytest.raises(ConfigError, match='unknown name "seriel"; possible are serial, broken, can'):
        import_module(package, "seriel", "_link")


@pytest.mark.parametrize("name", ["base", "serial_link", "", "../secret", "os.path"])
def test_only_members_are_imported(package, name):
    with pytest.raises(ConfigError, match="unknown name"):
        import_module(package, name, "_link")


def test_nearest_lists_all_when_none_is_near():
    assert format_suggestion("xyzzy", ("can", "serial")) == "; known are can, serial"
    assert format_suggestion("cam", ("can", "serial")) == '; did you mean "can"?'


def test_the_project_has_members_and_each_is_importable():
    for package, suffix in ((links, "_link"), (decoders, "")):
        members = list_modules(package, suffix)
        assert members
        for member in members:
            assert import_module(package, member, suffix).__name__ == f"{package.__name__}.{member}{suffix}"
