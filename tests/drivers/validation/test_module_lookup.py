"""Tests of finding links and decoders by listing their folders, and of suggestions for unknown names."""

import importlib
import sys

import pytest

from drivers import decoders, links
from drivers.errors import ConfigError
from drivers.validation.module_lookup import format_suggestion, import_module, list_modules


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Return a package with three valid modules and one module that raises an error when it is imported."""
    folder = tmp_path / "some_package"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    for name in ("base", "serial_link", "can_link", "table"):
        (folder / f"{name}.py").write_text(f"NAME = {name!r}\n")
    (folder / "broken_link.py").write_text("raise RuntimeError('imported')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    yield importlib.import_module("some_package")
    for name in [name for name in sys.modules if name.partition(".")[0] == "some_package"]:
        del sys.modules[name]


def test_names_are_sorted_and_have_no_suffix(package):
    assert list_modules(package, "_link") == ("broken", "can", "serial")


def test_base_is_not_listed(package):
    assert "base" not in list_modules(package)
    assert "table" in list_modules(package)


def test_listing_imports_no_module(package):
    list_modules(package, "_link")
    assert not any(name.startswith("some_package.") for name in sys.modules)


def test_only_the_requested_module_is_imported(package):
    assert import_module(package, "serial", "_link").NAME == "serial_link"
    assert "some_package.can_link" not in sys.modules


def test_modules_of_subpackages_are_found_by_their_names(package, tmp_path):
    (tmp_path / "some_package" / "inner").mkdir()
    (tmp_path / "some_package" / "inner" / "__init__.py").write_text("")
    (tmp_path / "some_package" / "inner" / "udp_link.py").write_text("NAME = 'udp_link'\n")
    package.SUBPACKAGES = ("inner",)
    assert list_modules(package, "_link") == ("broken", "can", "serial", "udp")
    assert import_module(package, "udp", "_link").__name__ == "some_package.inner.udp_link"


def test_error_inside_a_module_is_not_hidden(package):
    with pytest.raises(RuntimeError, match="imported"):
        import_module(package, "broken", "_link")


def test_error_for_an_unknown_name_lists_the_most_similar_names_first(package):
    with pytest.raises(ConfigError, match='unknown name "seriel"; possible are serial, broken, can'):
        import_module(package, "seriel", "_link")


@pytest.mark.parametrize("name", ["base", "serial_link", "", "../secret", "os.path"])
def test_names_that_are_not_listed_are_refused(package, name):
    with pytest.raises(ConfigError, match="unknown name"):
        import_module(package, name, "_link")


def test_suggestion_lists_all_names_if_none_is_similar():
    assert format_suggestion("xyzzy", ("can", "serial")) == "; known are can, serial"
    assert format_suggestion("cam", ("can", "serial")) == '; did you mean "can"?'


def test_all_links_and_decoders_can_be_imported():
    for package, suffix in ((links, "_link"), (decoders, "")):
        members = list_modules(package, suffix)
        assert members
        for member in members:
            name = import_module(package, member, suffix).__name__
            assert name.startswith(f"{package.__name__}.")
            assert name.endswith(f".{member}{suffix}")
