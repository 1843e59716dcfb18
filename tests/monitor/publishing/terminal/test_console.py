"""Tests that texts from outside cannot control the terminal, while the console itself can."""

import io

from rich.live import Live
from rich.table import Table
from rich.text import Text

from monitor.publishing.terminal.console import Console

NAME = "run\x1b[2J\x1b]0;title\x07\u202ecsv"


def make_table() -> Table:
    table = Table(NAME)
    table.add_row(NAME)
    return table


def test_control_characters_of_texts_are_removed() -> None:
    file = io.StringIO()
    console = Console(file=file)
    for one in (NAME, Text(NAME), make_table()):
        console.print(one)
    console.print(NAME, soft_wrap=True)
    assert not set(file.getvalue()) & set("\x1b\x07\u202e")
    assert file.getvalue().count("run [2J ]0;title") == 5


def test_console_can_still_redraw_a_table() -> None:
    file = io.StringIO()
    console = Console(file=file, force_terminal=True, color_system=None)
    with Live(make_table(), console=console, auto_refresh=False) as live:
        live.update(Text("new"), refresh=True)
    assert "\x1b[1A" in file.getvalue()
    assert "\x1b[2J" not in file.getvalue()
