"""Tests that follow the tutorials literally: they save the files, run the commands and compare the output."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAMS = Path(sys.executable).parent
FOLDER = Path(__file__).parents[1] / "docs" / "tutorials"
BLOCK = re.compile(
    r"(?:[Ss]ave (?:it|this text) as `(?P<file>[\w.]+)`:\n\n)?```(?P<language>\w+)\n(?P<text>.*?)^```", re.M | re.S
)


@pytest.mark.long
@pytest.mark.parametrize("page", sorted(FOLDER.glob("*.md")), ids=lambda page: page.stem)
def test_commands_of_tutorial_print_what_it_shows(page: Path, tmp_path: Path) -> None:
    printed, commands = "", 0
    for block in BLOCK.finditer(page.read_text("utf-8")):
        match block["language"]:
            case "toml":
                (tmp_path / block["file"]).write_text(block["text"], "utf-8")
            case "sh":
                run = subprocess.run(
                    ["/bin/sh", "-e", "-c", block["text"]],
                    cwd=tmp_path,
                    env=os.environ | {"PATH": f"{PROGRAMS}:{os.environ['PATH']}"},
                    capture_output=True,
                    text=True,
                    timeout=300.0,
                    check=False,
                )
                assert run.returncode == 0, run.stderr
                printed = " ".join(run.stdout.split())
                for written in tmp_path.glob("*.yaml"):
                    printed += written.read_text("utf-8")
                commands += 1
            case "text":
                for line in block["text"].splitlines():
                    assert line in printed
    assert commands >= 2
