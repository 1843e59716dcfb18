"""Files that others may change are refused, secrets that others may read are warned of, and nothing else is."""

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.errors import ConfigError
from monitor.publishing.zenoh.subscriber import client_configurations
from monitor.settings import file_permissions, loading
from tests.monitor.cli.test_cli import VIRTUAL

pytestmark = pytest.mark.skipif(os.name != "posix", reason="permissions are not POSIX's here")
SECRET = '{transport: {auth: {usrpwd: {user: "nose", password: "hunter2"}}}}'


@pytest.fixture
def folder() -> Iterator[Path]:
    """One that others get as far as: pytest's own is closed to them."""
    with tempfile.TemporaryDirectory() as name:
        path = Path(name).resolve()
        path.chmod(0o755)
        if any(not above.stat().st_mode & 0o001 for above in path.parents):
            pytest.skip(f"others do not get as far as {path.parent}")
        yield path


def made(path: Path, text: str, mode: int) -> Path:
    path.write_text(text)
    path.chmod(mode)
    return path


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o644, 0o664, 0o400])
def test_usual_modes_are_well(folder: Path, mode: int) -> None:
    path = made(folder / "a.toml", VIRTUAL, mode)
    assert file_permissions.explain_untrusted_file(path) == ""
    assert file_permissions.describe_exposed_secret(path) == ""
    reading = loading.examine_config_file(path)
    config, wrong = reading.config, reading.wrong
    assert wrong == []
    assert config is not None
    assert config.warnings == ()


def test_a_file_that_anyone_may_change_is_refused(folder: Path) -> None:
    path = made(folder / "a.toml", VIRTUAL, 0o646)
    with pytest.raises(ConfigError, match=rf"anyone on this machine may change it.*chmod o-w {path}$"):
        loading.load_config(path)
    path.chmod(0o644)
    loading.load_config(path)


def test_a_link_is_judged_by_where_it_leads(folder: Path) -> None:
    real = made(folder / "real.toml", VIRTUAL, 0o646)
    (folder / "link.toml").symlink_to(real)
    assert str(real) in file_permissions.explain_untrusted_file(folder / "link.toml")


def test_a_folder_in_which_anyone_may_swap_the_file_is_refused_but_a_sticky_one_is_not(folder: Path) -> None:
    path = made(folder / "a.toml", VIRTUAL, 0o644)
    folder.chmod(0o777)
    assert file_permissions.explain_untrusted_file(path).endswith(f"in its place: chmod o-w {folder}")
    folder.chmod(0o1777)
    assert file_permissions.explain_untrusted_file(path) == ""


def test_a_secret_that_anyone_may_read_is_warned_of(folder: Path) -> None:
    zenoh = made(folder / "z.json5", SECRET, 0o644)
    path = made(folder / "a.toml", VIRTUAL + '[zenoh]\nconfig = "z.json5"\n', 0o644)
    (warning,) = loading.load_config(path).warnings
    assert warning == (
        f"{path}: zenoh.config: z.json5: holds a secret that anyone on this machine may read: chmod o-r {zenoh}"
    )
    zenoh.chmod(0o640)
    assert loading.load_config(path).warnings == ()
    zenoh.chmod(0o644)
    folder.chmod(0o700)
    assert loading.load_config(path).warnings == ()  # nobody else gets there


def test_a_private_key_that_a_zenoh_file_names_is_looked_at_too(folder: Path) -> None:
    key = made(folder / "nose.key", "-----BEGIN PRIVATE KEY-----", 0o644)
    made(folder / "z.json5", f'{{transport: {{link: {{tls: {{connect_private_key: "{key}"}}}}}}}}', 0o644)
    path = made(folder / "a.toml", VIRTUAL + '[zenoh]\nconfig = "z.json5"\n', 0o644)
    (warning,) = loading.load_config(path).warnings
    assert f"nose.key: holds a secret that anyone on this machine may read: chmod o-r {key}" in warning


def test_a_zenoh_file_that_anyone_may_change_or_that_zenoh_refuses_is_wrong(folder: Path) -> None:
    zenoh = made(folder / "z.json5", SECRET, 0o602)
    path = made(folder / "a.toml", VIRTUAL + '[zenoh]\nconfig = "z.json5"\n', 0o644)
    assert "zenoh.config: anyone on this machine may change it" in loading.examine_config_file(path).wrong[0]
    with pytest.raises(ConfigError, match="anyone on this machine may change it"):
        client_configurations((), zenoh)
    made(zenoh, SECRET.replace('"hunter2"', '"hunter2" x'), 0o600)
    (line,) = loading.examine_config_file(path).wrong
    assert line == f"{path}: zenoh.config: {zenoh}: line 1, column 54: expected boolean or null"
