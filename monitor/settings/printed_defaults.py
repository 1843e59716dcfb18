"""Generation of a configuration file that lists all keys with default values.

Optional keys are printed as comments with example values.
"""

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, get_args, get_origin

from pydantic.fields import FieldInfo

import drivers.decoders
from drivers.data_types import AXES
from drivers.errors import ConfigError
from drivers.validation import module_lookup
from drivers.validation.number_ranges import NumberRange
from drivers.validation.settings_model import SettingsModel, fields_by_key, find_settings_model
from monitor.settings import driver_settings
from monitor.settings.schema import ConfigFile, Device, Hook, Limit

INTRODUCTION: Final = """\
# All keys of an imu-monitor configuration with their defaults. Keys in a comment have no default or are optional: their
# values are examples. Durations are seconds, or texts such as "90s", "30min", "1h", "2d". Relative paths begin at the
# folder of this file.
"""
FIRST_LINK, FIRST_DECODER = "serial", "vectornav_ascii"
"""Link and decoder of the device that is printed without comment marks."""
COMMENT_COLUMN: Final = 30
COMMENT: Final = "# "
DECODER_TABLE: Final = "device.driver.decoder_options"
LIST_TABLES: Final = ("device", "hook", "device.limit")


def format_defaults() -> str:
    """Format a configuration file with the keys of all tables, links and decoders."""
    links = [name for name in driver_settings.list_link_names() if name != FIRST_LINK]
    decoders = [name for name in module_lookup.list_modules(drivers.decoders) if name != FIRST_DECODER]
    blocks = [
        INTRODUCTION,
        _table(Device, "device", omit=("driver", "axes", "limit")),
        format_link_defaults(FIRST_LINK),
        format_decoder_defaults(FIRST_DECODER),
        "\n".join(
            ["[device.axes]", *(_line(axis, axis, str(fields_by_key(Device)["axes"].description)) for axis in AXES)]
        ),
        "# The other links. Replace the table [device.driver] above by one of these tables.",
        *(_commented(format_link_defaults(name)) for name in links),
        "# The other decoders.",
        *(_commented(format_decoder_defaults(name)) for name in decoders),
        _commented(_table(Limit, "device.limit", "any number of tables")),
        _commented(_table(Hook, "hook", "any number of tables")),
        *(_table(model, key) for key, model in _top_tables().items()),
    ]
    return "\n\n".join(block.strip("\n") for block in blocks) + "\n"


def _top_tables() -> dict[str, type[SettingsModel]]:
    """Return the tables that can occur only once in the file."""
    models = {key: find_settings_model(info.annotation) for key, info in fields_by_key(ConfigFile).items()}
    return {key: model for key, model in models.items() if model is not None and key not in LIST_TABLES}


def list_tables() -> list[tuple[str, type[SettingsModel]]]:
    """Return the headers and the models of all tables except those of the links and decoders."""
    once = [(f"[{key}]", model) for key, model in _top_tables().items()]
    return [("[[device]]", Device), ("[[device.limit]]", Limit), ("[[hook]]", Hook), *once]


def format_link_defaults(name: str) -> str:
    """Format the configuration table ``[device.driver]`` with all keys of a link.

    Raises
    ------
    ConfigError
        If no link has this name.
    """
    settings = driver_settings.link_settings_class(name)
    decoder = driver_settings.default_decoder(name) or FIRST_DECODER
    header, keys = _table(settings, "device.driver", omit=("faults",)).split("\n", 1)
    link = _line("link", name, f"one of {', '.join(driver_settings.list_link_names())}")
    text = "\n".join((header, link, f"{keys}{_line('decoder', decoder, 'wire format of the sensor')}\n"))
    if name != driver_settings.VIRTUAL:
        return text
    faults = _table(driver_settings.FaultsTable, "device.driver.faults", f'link = "{name}"')
    return f"{text}\n{faults}"


def format_decoder_defaults(name: str) -> str:
    """Format the configuration table ``[device.driver.decoder_options]`` with all keys of a decoder.

    Raises
    ------
    ConfigError
        If no decoder has this name.
    """
    known = module_lookup.list_modules(drivers.decoders)
    if name not in known:
        raise ConfigError(f'"{name}"{module_lookup.format_choices_by_similarity(name, known)}')
    settings = module_lookup.import_module(drivers.decoders, name).Settings
    lacking = "" if fields_by_key(settings) else " has no keys"
    return _table(settings, DECODER_TABLE, f'decoder = "{name}"{lacking}')


@dataclass(frozen=True, slots=True)
class KeyDescription:
    """Name, example value and meaning of a configuration key."""

    name: str
    value: object
    """Default value in the notation of the file. Example for a key without a default."""
    has_default: bool
    required: bool
    description: str
    """Meaning with the possible values or the range in parentheses."""


def describe_keys(model: type[SettingsModel]) -> Iterator[KeyDescription]:
    """Yield the keys of a configuration table in their order."""
    for key, info in fields_by_key(model).items():
        value = info.examples[0] if info.examples else info.default
        optional = info.default in (None, "", (), frozenset(), Path()) or info.default == {}
        required = info.is_required()
        yield KeyDescription(key, value, not (optional or required), required, f"{info.description}{_values(info)}")


def _table(model: type[SettingsModel], name: str, about: str = "", omit: tuple[str, ...] = ()) -> str:
    """Format the header and the keys of a configuration table, with optional keys in comments."""
    header = f"[[{name}]]" if name in LIST_TABLES else f"[{name}]"
    lines = [f"{header:<{COMMENT_COLUMN - 1}} # {about}" if about else header]
    for key in describe_keys(model):
        if key.name not in omit:
            line = _line(key.name, key.value, f"{'no default; ' if key.required else ''}{key.description}")
            lines.append(line if key.required or key.has_default else _commented(line))
    return "\n".join((*lines, ""))


def _commented(text: str) -> str:
    return "\n".join(line if line.startswith(COMMENT) or not line else COMMENT + line for line in text.split("\n"))


def _line(key: str, value: object, comment: str) -> str:
    return f"{f'{key} = {format_toml_value(value)}':<{COMMENT_COLUMN - 1}} # {comment}"


def _values(info: FieldInfo) -> str:
    """Format the possible values or the range of a configuration key in parentheses."""
    parts = list(_find_parts((info.annotation, *info.metadata)))
    words = [str(one) for one in parts if not isinstance(one, NumberRange)]
    ranges = [one.format_range() for one in parts if isinstance(one, NumberRange)]
    return f" ({' | '.join(words)})" if len(words) > 1 else "".join(f" ({one})" for one in ranges[:1])


def _find_parts(types: Iterable[Any]) -> Iterator[object]:
    """Yield the values of Literal types and the NumberRange objects in type annotations."""
    for one in types:
        if isinstance(one, NumberRange):
            yield one
        elif get_origin(one) is Literal:
            yield from get_args(one)
        else:
            yield from _find_parts(get_args(one))


def format_toml_value(value: Any) -> str:
    """Format a value in TOML notation.

    >>> format_toml_value({"gx": 0.5}), format_toml_value(("a", "b")), format_toml_value(True)
    ('{ gx = 0.5 }', '["a", "b"]', 'true')
    """
    if isinstance(value, Mapping):
        entries = ", ".join(f"{key} = {format_toml_value(one)}" for key, one in value.items())
        return f"{{ {entries} }}" if entries else "{}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(format_toml_value, value))}]"
    return json.dumps(value, ensure_ascii=False)
