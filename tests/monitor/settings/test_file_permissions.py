"""Tests of file permissions: untrusted files are refused, and exposed secrets give a warning."""

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
def public_folder() -> Iterator[Path]:
    """Create a folder that other users can reach, unlike the folders of pytest."""
    with tempfile.TemporaryDirectory() as name:
        path = Path(name).resolve()
        path.chmod(0o755)
        if any(not above.stat().st_mode & 0o001 for above in path.parents):
            pytest.skip(f"other users cannot reach {path.parent}")
        yield path


def write_file(path: Path, text: str, mode: int) -> Path:
    path.write_text(text)
    path.chmod(mode)
    return path


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o644, 0o664, 0o400])
def test_usual_permissions_are_accepted(public_folder: Path, mode: int) -> None:
    path = write_file(public_folder / "a.toml", VIRTUAL, mode)
    assert file_permissions.explain_untrusted_file(path) == ""
    assert file_permissions.describe_exposed_secret(path) == ""
    reading = loading.examine_config_file(path)
    config, wrong = reading.config, reading.wrong
    assert wrong == []
    assert config is not None
    assert config.warnings == ()


def test_file_that_anyone_may_change_is_refused(public_folder: Path) -> None:
    path = write_file(public_folder / "a.toml", VIRTUAL, 0o646)
    with pytest.raises(ConfigError, match=rf"anyone on this machine may change it.*chmod o-w {path}$"):
        loading.load_config(path)
    path.chmod(0o644)
    loading.load_config(path)


def test_symbolic_link_is_checked_by_its_target(public_folder: Path) -> None:
    real = write_file(public_folder / "real.toml", VIRTUAL, 0o646)
    (public_folder / "link.toml").symlink_to(real)
    assert str(real) in file_permissions.explain_untrusted_file(public_folder / "link.toml")


def test_folder_that_anyone_may_change_is_refused_unless_sticky(public_folder: Path) -> None:
    path = write_file(public_folder / "a.toml", VIRTUAL, 0o644)
    public_folder.chmod(0o777)
    assert file_permissions.explain_untrusted_file(path).endswith(f"in its place: chmod o-w {public_folder}")
    public_folder.chmod(0o1777)
    assert file_permissions.explain_untrusted_file(path) == ""


def test_secret_that_anyone_may_read_gives_a_warning(public_folder: Path) -> None:
    zenoh = write_file(public_folder / "z.json5", SECRET, 0o644)
    path = write_file(public_folder / "a.toml", VIRTUAL + '[zenoh]\nconfig = "z.json5"\n', 0o644)
    (warning,) = loading.load_config(path).warnings
    assert warning == (
        f"{path}: zenoh.config: z.json5: holds a secret that anyone on this machine may read: chmod o-r {zenoh}"
    )
    zenoh.chmod(0o640)
    assert loading.load_config(path).warnings == ()
    zenoh.chmod(0o644)
    public_folder.chmod(0o700)
    assert loading.load_config(path).warnings == ()  # other users cannot reach the file


def test_private_key_of_a_zenoh_file_is_checked(public_folder: Path) -> None:
    key = write_file(public_folder / "nose.key", "-----BEGIN PRIVATE KEY-----", 0o644)
    write_file(public_folder / "z.json5", f'{{transport: {{link: {{tls: {{connect_private_key: "{key}"}}}}}}}}', 0o644)
    path = write_file(public_folder / "a.toml", VIRTUAL + '[zenoh]\nconfig = "z.json5"\n', 0o644)
    (warning,) = loading.load_config(path).warnings
    assert f"nose.key: holds a secret that anyone on this machine may read: chmod o-r {key}" in warning


def test_token_that_anyone_may_read_gives_a_warning(public_folder: Path) -> None:
    token = write_file(public_folder / "token", "s3cret", 0o644)
    influx = '[influx]\nurl = "http://127.0.0.1:8086/write"\ntoken_file = "token"\n'
    path = write_file(public_folder / "a.toml", VIRTUAL + influx, 0o644)
    (warning,) = loading.load_config(path).warnings
    assert warning == (
        f"{path}: influx.token_file: token: holds a secret that anyone on this machine may read: chmod o-r {token}"
    )
    token.chmod(0o640)
    assert loading.load_config(path).warnings == ()


@pytest.mark.parametrize("content", [None, b"", b"two words", b"two\nlines", "ü".encode()])
def test_missing_or_malformed_token_is_refused_without_showing_it(tmp_path: Path, content: bytes | None) -> None:
    influx = '[influx]\nurl = "http://127.0.0.1:8086/write"\ntoken_file = "token"\n'
    path = write_file(tmp_path / "a.toml", VIRTUAL + influx, 0o644)
    if content is not None:
        (tmp_path / "token").write_bytes(content)
    (line,) = loading.examine_config_file(path).wrong
    problem = (
        "No such file or directory" if content is None else "must contain the token, as one word of ASCII characters"
    )
    assert line == f"{path}: influx.token_file: {tmp_path / 'token'}: {problem}"


def test_untrusted_or_invalid_zenoh_file_is_refused(public_folder: Path) -> None:
    zenoh = write_file(public_folder / "z.json5", SECRET, 0o602)
    path = write_file(public_folder / "a.toml", VIRTUAL + '[zenoh]\nconfig = "z.json5"\n', 0o644)
    assert "zenoh.config: anyone on this machine may change it" in loading.examine_config_file(path).wrong[0]
    with pytest.raises(ConfigError, match="anyone on this machine may change it"):
        client_configurations((), zenoh)
    write_file(zenoh, SECRET.replace('"hunter2"', '"hunter2" x'), 0o600)
    (line,) = loading.examine_config_file(path).wrong
    assert line == f"{path}: zenoh.config: {zenoh}: line 1, column 54: expected boolean or null"
