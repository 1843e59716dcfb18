"""Text of a configuration file with all keys, generated from the models of the settings.

Keys of the tables that a service always has stand with their defaults. All other keys are comments, with an example.
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, Literal, get_args, get_origin

from pydantic.fields import FieldInfo

import drivers.decoders
import drivers.links
from drivers import discovery
from drivers.errors import ConfigError
from drivers.quantities import Quantity
from drivers.sample import AXES
from drivers.settings_model import SettingsModel, describe_keys, find_model
from monitor.settings import driver_settings
from monitor.settings.schema import ConfigFile, Device, Hook, Limit

INTRODUCTION: Final = """\
# All keys of an imu-monitor configuration with their defaults. Keys in a comment have no default or are optional: their
# values are examples. Durations are seconds, or texts such as "90s", "30min", "1h", "2d". Relative paths begin at the
# folder of this file.
"""
FIRST_LINK, FIRST_DECODER = "serial", "vectornav_ascii"
"""Link and decoder of the device that is not a comment."""
COMMENT_COLUMN: Final = 30
COMMENT: Final = "# "
DECODER_TABLE: Final = "device.driver.decoder_options"
LIST_TABLES: Final = ("device", "hook", "device.limit")


def format_defaults() -> str:
    """Return a configuration file with the keys of all tables, links and decoders."""
    links = [name for name in driver_settings.link_names() if name != FIRST_LINK]
    decoders = [name for name in discovery.list_modules(drivers.decoders) if name != FIRST_DECODER]
    blocks = [
        INTRODUCTION.splitlines(),
        _table(Device, "device", omit=("driver", "axes", "limit")),
        [*_link(FIRST_LINK), *_line("decoder", f'"{FIRST_DECODER}"', "wire format of the sensor")],
        _table(_decoder_settings(FIRST_DECODER), DECODER_TABLE, f'decoder = "{FIRST_DECODER}"'),
        ["[device.axes]", *_axes()],
        ["# The other links. One of these tables takes the place of [device.driver] above."],
        *(_commented(block) for name in links for block in _link_blocks(name)),
        ["# The other decoders."],
        *(_commented(_decoder(name)) for name in decoders),
        _commented(_table(Limit, "device.limit", "any number of tables")),
        *(_top_level_tables()),
    ]
    return "\n\n".join("\n".join(block) for block in blocks) + "\n"


def format_link(name: str) -> str:
    """Return the table ``[device.driver]`` with all keys of a link.

    Raises
    ------
    ConfigError
        If there is no such link.
    """
    driver_settings.link_settings(name)
    return "\n\n".join("\n".join(block) for block in _link_blocks(name)) + "\n"


def format_decoder(name: str) -> str:
    """Return the table ``[device.driver.decoder_options]`` with all keys of a decoder.

    Raises
    ------
    ConfigError
        If there is no such decoder.
    """
    return "\n".join(_decoder(name)) + "\n"


def _top_level_tables() -> Iterator[list[str]]:
    """Yield the tables that do not belong to a device."""
    for key, info in describe_keys(ConfigFile).items():
        model = find_model(info.annotation)
        if model is Hook:
            yield _commented(_table(Hook, "hook", "any number of tables"))
        elif model is not None and model is not Device:
            yield _table(model, key)


def _axes() -> list[str]:
    """Return the keys of the mounting, without a change of axes."""
    axes = describe_keys(Device)["axes"]
    return [line for axis in AXES for line in _line(axis, f'"{axis}"', axes.description or "")]


def _link(name: str) -> list[str]:
    """Return the table of a link."""
    settings = driver_settings.link_settings(name)
    lines = _table(settings, "device.driver", omit=("faults",))
    return [lines[0], *_line("link", f'"{name}"', f"one of {', '.join(driver_settings.link_names())}"), *lines[1:]]


def _link_blocks(name: str) -> list[list[str]]:
    """Return the tables of a link, with its default decoder."""
    if name == driver_settings.VIRTUAL:
        decoder = driver_settings.VIRTUAL_DECODER
    else:
        decoder = discovery.import_module(drivers.links, name, "_link").DEFAULT_DECODER or FIRST_DECODER
    blocks = [[*_link(name), *_line("decoder", f'"{decoder}"', "wire format of the sensor")]]
    if name == driver_settings.VIRTUAL:
        blocks.append(_table(driver_settings.FaultsTable, "device.driver.faults", f'link = "{name}"'))
    return blocks


def _decoder_settings(name: str) -> type[SettingsModel]:
    """Return the model of the keys of a decoder."""
    known = discovery.list_modules(drivers.decoders)
    if name not in known:
        raise ConfigError(f'"{name}"{discovery.format_choices(name, known)}')
    settings: type[SettingsModel] = discovery.import_module(drivers.decoders, name).Settings
    return settings


def _decoder(name: str) -> list[str]:
    """Return the table of a decoder."""
    about = f'decoder = "{name}"'
    settings = _decoder_settings(name)
    return _table(settings, DECODER_TABLE, about if describe_keys(settings) else f"{about} has no keys")


def _table(model: type[SettingsModel], name: str, about: str = "", omit: tuple[str, ...] = ()) -> list[str]:
    """Return the header and the keys of a table. Optional keys are comments."""
    header = f"[[{name}]]" if name in LIST_TABLES else f"[{name}]"
    lines = [f"{header:<{COMMENT_COLUMN - 1}} # {about}" if about else header]
    for key, info in describe_keys(model).items():
        if key in omit:
            continue
        required, optional = info.is_required(), _says_nothing(info.default)
        comment = f"no default; {info.description}" if required else str(info.description)
        line = _line(key, format_toml(_example(info)), f"{comment}{_values(info)}")
        lines += [COMMENT + one for one in line] if optional and not required else line
    return lines


def _commented(lines: list[str]) -> list[str]:
    """Return the lines as comments."""
    return [line if line.startswith(COMMENT) else COMMENT + line for line in lines]


def _line(key: str, value: str, comment: str) -> list[str]:
    """Return the line of a key with its comment."""
    return [f"{f'{key} = {value}':<{COMMENT_COLUMN - 1}} # {comment}"]


def _says_nothing(default: object) -> bool:
    """Return True for a default that turns a function off."""
    return default in (None, "", (), frozenset(), Path()) or default == {}


def _example(info: FieldInfo) -> Any:
    """Return the value to print: the example of a key, or its default."""
    return info.examples[0] if info.examples else info.default


def _values(info: FieldInfo) -> str:
    """Return the possible words or the range of a key."""
    words = [str(word) for word in _find_words(info.annotation)]
    ranges = [one.range_text() for one in _find_quantities((info.annotation, *info.metadata))]
    return f" ({' | '.join(words)})" if len(words) > 1 else "".join(f" ({one})" for one in ranges[:1])


def _find_words(annotation: Any) -> Iterator[object]:
    """Yield the words of the Literal types in an annotation."""
    if get_origin(annotation) is Literal:
        yield from get_args(annotation)
    else:
        for one in get_args(annotation):
            yield from _find_words(one)


def _find_quantities(parts: tuple[Any, ...]) -> Iterator[Quantity]:
    """Yield the quantities in annotations."""
    for one in parts:
        if isinstance(one, Quantity):
            yield one
        yield from _find_quantities(get_args(one))


def format_toml(value: Any) -> str:
    """Return a value as TOML writes it.

    >>> format_toml({"gx": 0.5}), format_toml(("a", "b")), format_toml(True)
    ('{ gx = 0.5 }', '["a", "b"]', 'true')
    """
    if isinstance(value, Mapping):
        return "{}" if not value else f"{{ {', '.join(f'{key} = {format_toml(one)}' for key, one in value.items())} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(format_toml, value))}]"
    return json.dumps(value, ensure_ascii=False)
