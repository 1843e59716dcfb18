"""Help texts of commands in which arguments appear by their name alone."""

import re
from typing import Any

from typer.core import TyperCommand


class PlainHelpCommand(TyperCommand):
    """Command whose help shows arguments without the braces and Python types that typer adds."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the words of the usage line after the name of the command."""
        return [re.sub(r"\{(.*)\}", r"\1", piece).replace("…...", "…") for piece in super().collect_usage_pieces(ctx)]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the sections of the arguments and the options."""
        for title, kind in (("Arguments", "argument"), ("Options", "option")):
            records = (one.get_help_record(ctx) for one in self.get_params(ctx) if one.param_type_name == kind)
            rows = [(re.sub(r" <.*>$", "", name), text) for name, text in filter(None, records)]
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)
