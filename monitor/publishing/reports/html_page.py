"""Rendering of self-contained HTML pages from templates. The same values always give an identical page."""

from typing import Any, Final

from drivers.errors import ConfigError
from drivers.host.extras import install_command
from monitor.common.control_characters import remove_control_characters

MISSING_MESSAGE: Final = f"Jinja2 is not installed: {install_command('imu-monitor[plot]')}"


def render_template(name: str, **values: Any) -> str:
    """Return the HTML page that a template gives for the given values, without control characters.

    Parameters
    ----------
    name
        File name of the Jinja2 template.
    values
        Values and functions that the template uses.

    Raises
    ------
    ConfigError
        If Jinja2 is not installed.
    """
    try:
        from jinja2 import Environment, PackageLoader, StrictUndefined
    except ImportError as error:
        raise ConfigError(MISSING_MESSAGE) from error
    environment = Environment(
        loader=PackageLoader("monitor.publishing.reports"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return remove_control_characters(environment.get_template(name).render(**values), "\n")
