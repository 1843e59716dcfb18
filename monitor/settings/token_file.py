"""Files that contain the token of a server."""

from pathlib import Path

from drivers.errors import ConfigError, describe_error
from drivers.host.safe_file_reading import read_small_file
from drivers.secret_masking import remember_secret


def read_token(path: Path) -> str:
    """Return the token in a file, without surrounding white space.

    Parameters
    ----------
    path
        File with one line.

    Raises
    ------
    ConfigError
        If the file cannot be read, or if its content is not one word of ASCII characters. The message does not contain
        the token.
    """
    try:
        token = read_small_file(path).decode("ascii").strip()
    except OSError as error:
        raise ConfigError(f"{path}: {describe_error(error)}") from error
    except UnicodeDecodeError:
        token = ""
    if not token or " " in token or not token.isprintable():
        raise ConfigError(f"{path}: must contain the token, as one word of ASCII characters")
    remember_secret(token)
    return token
