"""Test that no command writes a configured password to standard output, the debug log or the status."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.ports import free_endpoint
from tests.support.program import exit_status
from tests.support.waiting import PATIENCE_S
from tests.support.zenoh_sessions import open_router

PASSWORD = "tr0ub4dor-and-3"
ZENOH = """{{
  mode: "peer", listen: {{endpoints: []}}, connect: {{endpoints: ["{endpoint}"]}},
  transport: {{auth: {{usrpwd: {{user: "nose", password: "{password}"{broken} }}}}}},
}}"""
CONFIG = """
[[device]]
name = "nose"
rate = 100.0
driver = {{ link = "virtual" }}
[[device]]
name = "far"
rate = 100.0
driver = {{ link = "serial", port = "socket://bench:{password}@127.0.0.1:1", decoder = "vectornav_ascii" }}
[zenoh]
config = "z.json5"
[viewer]
mode = "none"
[log]
level = "debug"
format = "json"
"""


def run_program(*arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "imu_monitor", *arguments],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    return done.stdout + done.stderr


def write_config(folder: Path, endpoint: str, broken: str = "") -> str:
    """Write a configuration with passwords and return its path. ``broken`` is inserted into the Zenoh file."""
    (folder / "z.json5").write_text(ZENOH.format(endpoint=endpoint, password=PASSWORD, broken=broken))
    path = folder / "a.toml"
    path.write_text(CONFIG.format(password=PASSWORD))
    return str(path)


def test_password_is_never_written(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    path = write_config(tmp_path, endpoint)
    with open_router(endpoint):
        outputs = {
            "check": run_program("check", path),
            "run": run_program("run", path, "--seconds", "4"),
            "watch": run_program("watch", "--zenoh", str(tmp_path / "z.json5"), "--seconds", "2"),
        }
    assert all(outputs.values()), outputs
    for command, text in outputs.items():
        assert PASSWORD not in text, (command, text)
    lines = [json.loads(line) for line in outputs["run"].splitlines() if line.startswith("{")]
    assert any("socket://bench:***@127.0.0.1:1" in str(line) for line in lines)


@pytest.mark.parametrize("broken", [" x", ', pasword: "tr0ub4dor-and-3"'])
def test_error_in_the_zenoh_file_names_the_line_without_the_password(
    tmp_path: Path, broken: str, capfd: pytest.CaptureFixture[str]
) -> None:
    path = write_config(tmp_path, free_endpoint(), broken)
    for command in (("check", path), ("run", path), ("watch", "--zenoh", str(tmp_path / "z.json5"))):
        assert exit_status(*command) == 2
        text = "".join(capfd.readouterr())
        assert "line 3" in text
        assert PASSWORD not in text
