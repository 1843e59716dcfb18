"""Exception classes of the project. Most classes also inherit from the matching built-in exception.

    ImuError
      ConfigError(ValueError)        invalid settings; the service refuses to start
      LinkError(OSError)
        LinkUnavailable              the link cannot be opened (port, library or permission); opening is retried
        LinkLost                     the open link has failed; opening is retried with growing pauses
        LinkEnded                    the replayed file has ended; not retried
      DecodeError(ValueError)        one frame is invalid; ``feed`` counts the frame and continues
      RecordingError(ValueError)     the file is not a recording, or the file is empty
        UnknownColumnsError          the user has to name the columns of a table
      NotReady                       too few samples for a result

Links convert the exceptions of vendor libraries to these classes and keep the original exception as the cause. Any
other exception in a module without I/O is a bug.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Final

from drivers.secret_masking import mask_secrets

MAX_TEXT_CHARACTERS: Final = 2000
"""Maximum length of an error text in characters. The limit is needed because an error may quote received data."""


class ImuError(Exception):
    """Base class of all exceptions. The error text is a single line without control characters and secrets."""

    def __str__(self) -> str:
        return make_printable_and_shorten(super().__str__())


def make_printable_and_shorten(text: str) -> str:
    """Replace control characters with spaces, mask secrets, and shorten the text to MAX_TEXT_CHARACTERS characters.

    >>> make_printable_and_shorten("no key \\x1b[2J\\nhere")
    'no key  [2J here'
    """
    text = mask_secrets(text[: 2 * MAX_TEXT_CHARACTERS])  # before a secret is cut
    text = "".join(c if c.isprintable() else " " for c in text[: MAX_TEXT_CHARACTERS + 1].strip())
    return text if len(text) <= MAX_TEXT_CHARACTERS else f"{text[:MAX_TEXT_CHARACTERS]} …"


def describe_error(error: Exception) -> str:
    """Return the text of an exception as a single line. The text of an OSError does not include the path."""
    return " ".join(str(getattr(error, "strerror", None) or error).split())


class ConfigError(ImuError, ValueError):
    """Invalid setting or option. The error text contains the location of the mistake and the valid values.

    Parameters
    ----------
    *lines
        One line for each mistake.

    >>> str(ConfigError("rate: missing", "window: missing"))
    'rate: missing; window: missing'
    """

    @property
    def mistake_lines(self) -> tuple[str, ...]:
        """Lines of the error text, one for each mistake."""
        return tuple(make_printable_and_shorten(str(line)) for line in self.args)

    def __str__(self) -> str:
        return make_printable_and_shorten("; ".join(self.mistake_lines))


class LinkError(ImuError, OSError):
    """Base class of the errors of a link."""


class LinkUnavailable(LinkError):
    """A link cannot be opened. The driver tries again later."""


class LinkLost(LinkError):
    """An open link has failed. The driver reopens the link."""


class LinkEnded(LinkError):
    """The replay has reached the end of the recorded file."""


class DecodeError(ImuError, ValueError):
    """A received frame violates the wire format."""


class RecordingError(ImuError, ValueError):
    """A file cannot be read as a recording."""


class UnknownColumnsError(RecordingError):
    """The columns of a table are not recognized.

    Parameters
    ----------
    text
        Error text with a command that names the columns.
    column_lines
        Table of the columns with their first values, which the command line prints below the error text.
    """

    def __init__(self, text: str, column_lines: Sequence[str] = ()) -> None:
        super().__init__(text)
        self.column_lines = tuple(make_printable_and_shorten(line.rstrip()) for line in column_lines)


class NotReady(ImuError):
    """There are too few samples for a result."""


@contextmanager
def convert_library_errors(format_message: Callable[[str], str]) -> Iterator[None]:
    """Convert the exceptions that a library raises for a damaged file to RecordingError.

    Errors of this project, of the operating system and of the memory are not changed.

    Parameters
    ----------
    format_message
        Function that returns the message for a cause.

    >>> with convert_library_errors(lambda cause: f"run.bag: is no complete bag ({cause})"):
    ...     {}["index"]
    Traceback (most recent call last):
    drivers.errors.RecordingError: run.bag: is no complete bag ('index')
    """
    try:
        yield
    except (ImuError, OSError, MemoryError):
        raise
    except Exception as error:
        raise RecordingError(format_message((describe_error(error) or type(error).__name__).rstrip("."))) from error
