"""Exception classes of the project. Most classes also inherit from the matching built-in exception.

    ImuError
      ConfigError(ValueError)        only while starting; the service refuses to start
      LinkError(OSError)
        LinkUnavailable              cannot be opened (no port, library or permission); opening is retried
        LinkLost                     was open and failed; opening is retried with growing pauses
        LinkEnded                    the replayed source has ended; not retried
      DecodeError(ValueError)        concerns one frame; ``feed`` counts it and continues
      RecordingError(ValueError)     the file is not a recording, or it is empty
      NotReady                       too few samples for a result

Links turn exceptions of vendor libraries into these classes, with ``from``. Any other exception from a module that does
no I/O is a bug.
"""

from typing import Final

MAX_TEXT_CHARACTERS: Final = 2000
"""Maximum length of the text of an error in characters. The text may quote received data."""


class ImuError(Exception):
    """Base class of all exceptions that this project raises on purpose.

    The text is one line without control characters.
    """

    def __str__(self) -> str:
        return format_one_line(super().__str__())


def format_one_line(text: str) -> str:
    """Return the text in one line without control characters, cut after MAX_TEXT_CHARACTERS characters.

    >>> format_one_line("no key \\x1b[2J\\nhere")
    'no key  [2J here'
    """
    text = "".join(c if c.isprintable() else " " for c in text[: MAX_TEXT_CHARACTERS + 1].strip())
    return text if len(text) <= MAX_TEXT_CHARACTERS else f"{text[:MAX_TEXT_CHARACTERS]} …"


def describe_error(error: Exception) -> str:
    """Return the text of an exception in one line. The text of an OSError is the reason without the path."""
    return " ".join(str(getattr(error, "strerror", None) or error).split())


class ConfigError(ImuError, ValueError):
    """An invalid setting or option. The text names the file, key or line, and the values that would be valid.

    Parameters
    ----------
    *lines
        One line for each mistake.

    >>> str(ConfigError("rate: missing", "window: missing"))
    'rate: missing; window: missing'
    """

    @property
    def lines(self) -> tuple[str, ...]:
        """Lines of the message, one for each mistake."""
        return tuple(format_one_line(str(line)) for line in self.args)

    def __str__(self) -> str:
        return format_one_line("; ".join(self.lines))


class LinkError(ImuError, OSError):
    """Base class of the errors of a link."""


class LinkUnavailable(LinkError):
    """The link cannot be opened now. Opening is tried again."""


class LinkLost(LinkError):
    """An open link has failed. The link is opened again."""


class LinkEnded(LinkError):
    """The end of a replayed source has been reached."""


class DecodeError(ImuError, ValueError):
    """A frame violates its format."""


class RecordingError(ImuError, ValueError):
    """A file cannot be read as a recording."""


class NotReady(ImuError):
    """There are too few samples for a result."""
