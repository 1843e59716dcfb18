"""Text and HTML of results, and conversion to pandas."""

import html
import io
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from drivers.errors import ConfigError
from drivers.host.extras import install_command

if TYPE_CHECKING:
    import pandas as pd

    from monitor.publishing.terminal.console import Console

WIDTH: Final = 120
"""Width of printed results in characters."""


def render_text(print_result: "Callable[[Console], None]") -> str:
    """Return the text that a function prints to a console, without colours.

    Parameters
    ----------
    print_result
        Function that prints to the console that it receives.
    """
    from monitor.publishing.terminal.console import Console

    text = io.StringIO()
    print_result(Console(file=text, width=WIDTH, color_system=None, force_terminal=False, force_jupyter=False))
    return "\n".join(line.rstrip() for line in text.getvalue().rstrip().splitlines())


def render_html(text: str, figures: Sequence[str] = (), width_em: float = 60.0) -> str:
    """Return HTML for a notebook that shows a text in a fixed-width font, followed by SVG elements.

    Parameters
    ----------
    text
        Text of the result.
    figures
        SVG elements.
    width_em
        Largest width of a figure, in multiples of the font size.
    """
    drawn = "".join(f'<div style="max-width:{width_em:g}em;background:white">{figure}</div>' for figure in figures)
    return f'<pre style="line-height:1.3">{html.escape(text)}</pre>{drawn}'


def build_dataframe(columns: Mapping[str, Any]) -> "pd.DataFrame":
    """Return a pandas DataFrame with the given columns.

    Raises
    ------
    ConfigError
        If pandas is not installed.
    """
    try:
        import pandas as pd
    except ImportError as error:
        raise ConfigError(f"a DataFrame needs pandas: {install_command('pandas')}") from error
    return pd.DataFrame(dict(columns))
