"""Console of the program. Texts from outside cannot control the terminal."""

from collections.abc import Iterable

from rich import console as rich_console
from rich.segment import Segment

from monitor.common.control_characters import remove_control_characters


class Console(rich_console.Console):
    """Console that replaces control characters in texts, except line breaks."""

    def render(
        self, renderable: rich_console.RenderableType, options: rich_console.ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """Yield the segments of a renderable. Control codes of the console itself, such as those of a table that is
        redrawn, are segments of their own and are kept."""
        for segment in super().render(renderable, options):
            text = segment.text if segment.control else remove_control_characters(segment.text, "\n")
            yield Segment(text, segment.style, segment.control)
