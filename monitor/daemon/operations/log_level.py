"""The level of the log, which a reload may change: loggers that are in use keep their class, but not this."""

from collections.abc import MutableMapping
from typing import Any, Final

import structlog

LEVELS: Final = {"debug": 10, "info": 20, "warning": 30, "error": 40, "critical": 50}


class Level:
    """A processor of structlog that drops what is below the level."""

    def __init__(self, name: str = "info") -> None:
        self.name = name

    def __call__(self, _logger: Any, method: str, line: MutableMapping[str, Any]) -> MutableMapping[str, Any]:
        """The line, if it is to be said."""
        if LEVELS.get(method, LEVELS["critical"]) < LEVELS[self.name]:
            raise structlog.DropEvent
        return line


LEVEL: Final = Level()
"""Of this process."""
