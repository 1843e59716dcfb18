"""Test that no command writes a configured password to standard output, the debug log or the status."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.ports import free_endpoint
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
        [sys.executable, "-m", "monitor.cli", *arguments],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    return done.stdout + done.stderr


@pytest.mark.parametrize("broken", ["", " x", ', pasword: "tr0ub4dor-and-3"'])
def test_password_is_never_written(tmp_path: Path, broken: str) -> None:
    endpoint = free_endpoint()
    (tmp_path / "z.json5").write_text(ZENOH.format(endpoint=endpoint, password=PASSWORD, broken=broken))
    path = tmp_path / "a.toml"
    path.write_text(CONFIG.format(password=PASSWORD))
    with open_router(endpoint):
        outputs = {
            "check": run_program("check", str(path)),
            "run": run_program("run", str(path), "--seconds", "4"),
            "watch": run_program("watch", "--zenoh", str(tmp_path / "z.json5"), "--seconds", "2"),
        }
    assert all(outputs.values()), outputs
    for command, text in outputs.items():
        assert PASSWORD not in text, (command, text)
    if not broken:
        lines = [json.loads(line) for line in outputs["run"].splitlines() if line.startswith("{")]
        assert any("socket://bench:***@127.0.0.1:1" in str(line) for line in lines)
    else:
        assert "line 3" in outputs["run"]
