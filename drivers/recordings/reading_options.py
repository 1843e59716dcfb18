"""Options that determine how a recording is read: the topic of a log, and the columns and units of a table.

The commands and the link ``replay`` use the same options.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Final

from pydantic import BeforeValidator, Field

from drivers import units
from drivers.errors import ConfigError
from drivers.recordings.table import COLUMNS
from drivers.validation.number_ranges import format_value
from drivers.validation.settings_model import SettingsModel, check_table, checked_by, one_of

NOT_READ: Final = "-"
"""Column reference that leaves a quantity out."""


def _to_column_reference(value: Any) -> str:
    """Return the name or the number of a column as text. Raise ConfigError for any other value."""
    if isinstance(value, int) and not isinstance(value, bool):
        value = str(value)
    if not isinstance(value, str) or not value.strip():
        raise ConfigError(f"expected the name or the number of a column, got {format_value(value)}")
    return value.strip()


class ReadingOptions(SettingsModel):
    """Options for reading a recording."""

    topic: str | None = Field(
        None,
        examples=["/imu/data"],
        description="topic of a ROS bag or an autopilot log, or one of several sensors of a table; absent: the only "
        "one with IMU data",
    )
    columns: dict[Annotated[str, one_of(COLUMNS)], Annotated[str, BeforeValidator(_to_column_reference)]] = Field(
        {},
        examples=[{"gx": "omega_x", "t": 1}],
        description='column of a table for t, gx, …, temperature: a name, a number from 1, or "-" to leave it out; '
        "absent: recognized by name",
    )
    gyro_unit: Annotated[str, checked_by(units.angular_rate_factor)] | None = Field(
        None,
        examples=["deg/s"],
        description="unit of gx gy gz in the file; absent: unit that the file states or its numbers show, or rad/s",
    )
    accel_unit: Annotated[str, checked_by(units.acceleration_factor)] | None = Field(
        None,
        examples=["g"],
        description="unit of ax ay az in the file; absent: unit that the file states or its numbers show, or m/s²",
    )
    temperature_unit: Annotated[str, checked_by(units.temperature_factor_and_offset)] | None = Field(
        None,
        examples=["K"],
        description="unit of the temperature in the file; absent: unit that the file states, or °C",
    )
    time_unit: Annotated[str, checked_by(units.time_factor)] | None = Field(
        None,
        examples=["ns"],
        description="unit of t in the file; absent: unit that the file states or its numbers show, or s",
    )
    assume: bool = Field(False, description="accept a doubtful table with its likeliest units and as one sensor")


OPTION_NAMES: Final = {key: f"--{key.replace('_', '-')}" for key in ReadingOptions.model_fields}
"""Option of the commands for each field of ``ReadingOptions``."""
DEFAULT_OPTIONS: Final = ReadingOptions()


def create_reading_options(values: Mapping[str, Any]) -> ReadingOptions:
    """Create reading options from the options of a command or the arguments of a function.

    Parameters
    ----------
    values
        Value of each field of ``ReadingOptions``. None means the default.

    Raises
    ------
    ConfigError
        If a value is invalid. Each line names the option.
    """
    checked = check_table(ReadingOptions, {key: value for key, value in values.items() if value is not None})
    if checked.problems:
        keys = (problem.key_path.partition(".") for problem in checked.problems)
        raise ConfigError(
            *(
                f"{OPTION_NAMES[key]}: {f'{column}: ' if column in COLUMNS else ''}{problem.text}"
                for problem, (key, _, column) in zip(checked.problems, keys, strict=True)
            )
        )
    return checked.value or DEFAULT_OPTIONS


def parse_column_mapping(text: str) -> dict[str, str]:
    """Parse the option ``--columns``, such as ``gx=omega_x,t=1``.

    Raises
    ------
    ConfigError
        If a part of the text does not assign a column to a quantity, or if a quantity is given twice.

    >>> parse_column_mapping("gx=omega_x, t=1")
    {'gx': 'omega_x', 't': '1'}
    """
    columns: dict[str, str] = {}
    for part in text.split(","):
        quantity, sign, column = (piece.strip() for piece in part.partition("="))
        if not sign or not quantity or not column:
            raise ConfigError(f"{format_value(part.strip())}: expected QUANTITY=COLUMN, such as gx=omega_x or t=1")
        if quantity in columns:
            raise ConfigError(f"{quantity} is given twice; each quantity has one column")
        columns[quantity] = column
    return columns
