"""The error tree of the project. A class is the matching builtin too, where there is one.

    ImuError
      ConfigError(ValueError)        only while starting; the service refuses to start
      LinkError(OSError)
        LinkUnavailable              cannot open: no port, no library, no permission; retried
        LinkLost                     was open, is gone; retried with back-off
        LinkEnded                    a replay has given all it had; not retried
      DecodeError(ValueError)        from one frame only; ``feed`` counts it and goes on
      RecordingError(ValueError)     a file that is not a recording, or an empty one
      NotReady                       too few samples for an answer

Vendor exceptions are turned into these at the link, with ``from``. Any other exception out of a
pure room is a bug.
"""

from typing import Final

LONGEST: Final = 2000
"""Characters of an error's text; it may quote what somebody sent."""


class ImuError(Exception):
    """Root of all that this project raises on purpose; its text is one line that a terminal can be given."""

    def __str__(self) -> str:
        return in_one_line(super().__str__())


def in_one_line(text: str) -> str:
    """The text without line ends and control characters, and not endless.

    >>> in_one_line("no key \\x1b[2J\\nhere")
    'no key  [2J here'
    """
    text = "".join(c if c.isprintable() else " " for c in text[: LONGEST + 1].strip())
    return text if len(text) <= LONGEST else f"{text[:LONGEST]} …"


class ConfigError(ImuError, ValueError):
    """What was asked for is wrong: names the file, key or line, and what would be right.

    Parameters
    ----------
    *lines
        One line for each mistake, if several were found at once.

    >>> str(ConfigError("rate: missing", "window: missing"))
    'rate: missing; window: missing'
    """

    @property
    def lines(self) -> tuple[str, ...]:
        """One line for each mistake."""
        return tuple(in_one_line(str(line)) for line in self.args)

    def __str__(self) -> str:
        return in_one_line("; ".join(self.lines))


class LinkError(ImuError, OSError):
    """A link cannot do its work."""


class LinkUnavailable(LinkError):
    """The link cannot be opened now; it will be tried again."""


class LinkLost(LinkError):
    """The link was open and is gone; it will be opened again."""


class LinkEnded(LinkError):
    """A replayed source has come to its end."""


class DecodeError(ImuError, ValueError):
    """One frame does not follow its format."""


class RecordingError(ImuError, ValueError):
    """A file cannot be read as a recording."""


class NotReady(ImuError):
    """Too few samples for an answer."""
