"""Error messages and exit statuses of the commands."""

import contextlib
import os
import signal
from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from typing import Any, Final

import typer
from typer.exceptions import TyperException

from drivers.errors import ConfigError, ImuError, NotReady, RecordingError, make_printable_and_shorten

FAILED: Final = 1
"""Exit status after a failure at run time."""
WRONG: Final = 2
"""Exit status if an argument or an input file is invalid."""
NO_ANSWER: Final = 3
"""Exit status if the data do not support an answer."""
INTERRUPTED: Final = 128 + signal.SIGINT
DEBUG: Final = "--debug"
MAX_CAUSE_CHARACTERS: Final = 300
"""Maximum length in characters of an unexpected error text, because libraries may produce very long texts."""


@contextlib.contextmanager
def name_option_in_config_errors(option: str) -> Iterator[None]:
    """Prepend the name of an option to the message of a ConfigError."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f"{option}: {error}") from None


def error_message_and_exit_status(error: Exception) -> tuple[str, int]:
    """Return the error message and the exit status after an error has ended a command."""
    match error:
        case TyperException():
            return make_printable_and_shorten(_usage(error)), WRONG
        case ConfigError() | RecordingError():
            return str(error), WRONG
        case NotReady():
            return str(error), NO_ANSWER
        case ImuError():
            return str(error), FAILED
        case typer.Abort():
            return "interrupted", INTERRUPTED
        case OSError():
            return make_printable_and_shorten(_system_error(error)), FAILED
        case MemoryError():
            why = f" ({cause})" if (cause := _cause(error)) else ""
            return f"not enough memory{why}; read less data, e.g. the end of a recording with --last 1h", FAILED
    return (
        f"internal error: {type(error).__name__}: {_cause(error)}; please report it with the output of the same "
        f"command with {DEBUG}",
        FAILED,
    )


def _cause(error: Exception) -> str:
    text = " ".join(make_printable_and_shorten(str(error)).split())
    return text if len(text) <= MAX_CAUSE_CHARACTERS else f"{text[:MAX_CAUSE_CHARACTERS]} …"


def _system_error(error: OSError) -> str:
    """Return the text of a system error, or advice if the current folder has been removed or cannot be read."""
    if error.filename is None:
        try:
            os.getcwd()
        except OSError:
            return f"the current folder has been removed or cannot be read ({error.strerror}); change to another folder"
    return str(error)


def _usage(error: TyperException) -> str:
    """Return an error message that lists the missing arguments, or the possible values of an invalid argument."""
    text, context = error.format_message(), getattr(error, "ctx", None)
    if isinstance(error, typer.BadParameter) and error.param is not None and not error.message:
        option: Any = error.param
        what = f" ({option.metavar})" if option.metavar and option.param_type_name == "option" else ""
        where = f" See {context.command_path} --help" if context else ""
        return f"{text.rstrip('.')}{what}: {option.help or ''}{where}"
    if context is None:
        return text
    unknown = getattr(error, "option_name", None)
    if unknown is not None and text.startswith("No such option"):
        known = {name.lstrip("-"): name for option in context.command.params for name in option.opts if name[0] == "-"}
        near = get_close_matches(unknown.lstrip("-"), known, n=1)
        hint = f"did you mean {known[near[0]]}?" if near else f"known are {', '.join(known.values())}"
        return f"No such option: {unknown} of {context.command_path}; {hint}"
    commands: Mapping[str, Any] = getattr(context.command, "commands", {})
    if commands and "Did you mean" not in text:
        known_names = ", ".join(name for name, command in commands.items() if not command.hidden)
        return f"{text.rstrip('.')}; known are {known_names}. See {context.command_path} --help"
    return text
