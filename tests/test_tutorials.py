"""Tests that follow the tutorials literally: they save the files, run the commands and compare the output."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAMS = Path(sys.executable).parent
PAGES = sorted((Path(__file__).parents[1] / "docs" / "tutorials").glob("*.md"))
BLOCK = re.compile(
    r"(?:[Ss]ave (?:it|this text) as `(?P<file>[\w.]+)`:\n\n)?```(?P<language>\w*)\n(?P<text>.*?)^```", re.M | re.S
)
NAMED_FILE = re.compile(r"`([\w/-]+\.(?:png|html|json|jsonl|yaml|toml|npz|mcap))`")
INSTALLATION = "console"
"""Language of the commands that install the program, which this test does not run."""


def follow_tutorial(text: str, folder: Path) -> int:
    """Save the files and run the commands of a tutorial, as a reader does, and return the number of command blocks.

    Parameters
    ----------
    text
        Markdown text of the page.
    folder
        Folder in which the commands run.

    Raises
    ------
    AssertionError
        If a command fails, if a shown line is not part of the output of the preceding commands, if the text names a
        file that does not exist at the end, or if a block is of another kind.
    """
    printed, commands = "", 0
    for block in BLOCK.finditer(text):
        match block["language"]:
            case "toml":
                assert block["file"], f"the text before this block does not name its file:\n{block['text']}"
                (folder / block["file"]).write_text(block["text"], "utf-8")
            case "sh":
                printed = run_commands(block["text"], folder)
                commands += 1
            case "text":
                for line in block["text"].splitlines():
                    assert line in printed
            case language:
                assert language == INSTALLATION, f"unknown kind of block: {language!r}"
                assert "imu-monitor " not in block["text"], "commands of the program belong into a block sh"
    missing = {name for name in NAMED_FILE.findall(BLOCK.sub("", text)) if not (folder / name).exists()}
    assert not missing
    return commands


def run_commands(text: str, folder: Path) -> str:
    """Run commands in a shell and return their output, followed by the YAML files that they name."""
    run = subprocess.run(
        ["/bin/sh", "-e", "-c", text],
        cwd=folder,
        env=os.environ | {"PATH": f"{PROGRAMS}:{os.environ['PATH']}"},
        capture_output=True,
        text=True,
        timeout=300.0,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    files = [folder / name for name in re.findall(r"[\w/-]+\.yaml", text)]
    return " ".join(run.stdout.split()) + "".join(file.read_text("utf-8") for file in files)


@pytest.mark.long
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_of_tutorial_print_what_it_shows(page: Path, tmp_path: Path) -> None:
    assert follow_tutorial(page.read_text("utf-8"), tmp_path) >= 2


TUTORIAL = """\
Save this text as `model.toml`:

```toml
name = "one"
```

```sh
grep name model.toml
cp model.toml report.html
```

```text
name = "one"
```

`report.html` contains the same.
"""


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("", ""),
        ('name = "one"\n```\n\n```sh', 'name = "two"\n```\n\n```sh'),
        ("grep name", "grep -c name"),
        ("grep name", "grep other"),
        ("cp model.toml report.html", "true"),
        ("Save this text as `model.toml`:\n\n", ""),
        ("```sh", "```console"),
        ("```sh", "```bash"),
    ],
)
def test_a_changed_tutorial_fails(old: str, new: str, tmp_path: Path) -> None:
    changed = TUTORIAL.replace(old, new, 1)
    if not old:
        assert follow_tutorial(changed, tmp_path) == 1
        return
    assert changed != TUTORIAL
    with pytest.raises(AssertionError):
        follow_tutorial(changed, tmp_path)
