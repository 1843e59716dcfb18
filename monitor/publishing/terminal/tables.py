"""Tables and notes in the terminal, based on the package rich."""

from collections.abc import Iterable, Sequence

from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table
from rich.text import Text

UNLIMITED_WIDTH = 10_000


def plain_table(*headers: str, wrapped_headers: Sequence[str] = (), gap: int = 2, show_header: bool = True) -> Table:
    """Return an empty table without borders.

    Parameters
    ----------
    *headers
                Headers of the first columns, whose text is not wrapped.
    wrapped_headers
        Headers of the following columns, whose text is wrapped.
    gap
        Number of blanks between columns.
    show_header
        False to omit the header line.
    """
    table = Table(box=None, padding=(0, gap, 0, 0), pad_edge=False, header_style="bold", show_header=show_header)
    for head in headers:
        table.add_column(head, no_wrap=True)
    for head in wrapped_headers:
        table.add_column(head)
    return table


def print_line(line: str | Text, console: Console) -> None:
    """Print a line without markup. On a terminal, the line is wrapped at word boundaries; in a file, it is written as a
    single line."""
    console.print(line, markup=False, highlight=False, soft_wrap=not console.is_terminal)


def print_notes(notes: Iterable[str], console: Console) -> None:
    """Print each note as a line of its own."""
    for note in notes:
        print_line(f"note: {note}", console)


def unwrapped_table_width(table: Table, console: Console, options: ConsoleOptions) -> int:
    """Return the width in characters at which no text of a table is wrapped.

    Parameters
    ----------
    table
        Table whose width is measured.
        console, options
        Console and options with which the table is rendered.
    """
    return console.measure(table, options=options.update(max_width=UNLIMITED_WIDTH)).maximum


class WidthDependentTable:
    """The first of several tables that fits the terminal, or the last table. The widest table is the first."""

    def __init__(self, *tables: Table) -> None:
        self._tables = tables

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        fitting = (one for one in self._tables if unwrapped_table_width(one, console, options) <= options.max_width)
        yield next(fitting, self._tables[-1])
