"""Log level of the process, which a reload can change while loggers are in use."""

from collections.abc import MutableMapping
from typing import Any, Final

import structlog

LEVELS: Final = {"debug": 10, "info": 20, "warning": 30, "error": 40, "critical": 50}
"""Names of the levels and their numbers."""


class LevelFilter:
    """Processor of structlog that drops lines below the level.

    Parameters
    ----------
    name : str, optional
        Name of the level.
    """

    def __init__(self, name: str = "info") -> None:
        self.name = name

    def __call__(self, _logger: Any, method: str, line: MutableMapping[str, Any]) -> MutableMapping[str, Any]:
        """Return the line, or drop it if it is below the level."""
        if LEVELS.get(method, LEVELS["critical"]) < LEVELS[self.name]:
            raise structlog.DropEvent
        return line


LEVEL: Final = LevelFilter()
"""Log level of this process."""
