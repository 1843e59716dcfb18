"""Error messages and notes for the Python interface.

The modules below the interface name the options of the command line, such as ``--rate HZ``. The functions in this
module replace the options by the arguments of the Python functions.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from drivers.errors import ConfigError, ImuError, NotReady

ARGUMENTS: Final = {
    "--accel-unit": "accel_unit",
    "--assume": "assume=True",
    "--columns": "columns",
    "--correlation-time S": "correlation_time_s",
    "--gyro-unit": "gyro_unit",
    "--last 1d": "last_s=86400",
    "--last": "last_s",
    "--out": "folder",
    "--rate HZ": "rate_hz",
    "--rate": "rate_hz",
    "--temperature-unit": "temperature_unit",
    "--time-unit": "time_unit",
    "--topic (in a configuration file: topic)": "topic",
    "--topic": "topic",
    "--window S": "window_s",
}
"""Options in messages, the longest spelling first, and the arguments of the Python functions."""
_OPTIONS: Final = re.compile("|".join(map(re.escape, ARGUMENTS)))


def replace_options_by_argument_names(text: str) -> str:
    """Replace options of the command line by arguments of the Python functions.

    >>> replace_options_by_argument_names("run.csv: its rate is not known; give it with --rate HZ")
    'run.csv: its rate is not known; give it with rate_hz'
    """
    return _OPTIONS.sub(lambda option: ARGUMENTS[option[0]], text)


@contextmanager
def errors_name_arguments() -> Iterator[None]:
    """Raise each error of the project with a text that names arguments instead of options.

    Raises
    ------
    ImuError
        The error with the changed text. A MemoryError becomes a ConfigError.
    """
    try:
        yield
    except ConfigError as error:
        raise ConfigError(*map(replace_options_by_argument_names, error.mistake_lines)) from error
    except NotReady as error:  # subclasses have other arguments
        raise NotReady(replace_options_by_argument_names(str(error))) from error
    except ImuError as error:
        raise type(error)(replace_options_by_argument_names(str(error))) from error
    except MemoryError as error:
        raise ConfigError("there is not enough free memory for so many samples") from error
