"""Configuration table ``[device.driver]``, which names the link and the decoder of a device.

Each link module and decoder module defines configuration keys. Only the modules of the named link and decoder are
imported.
"""

import copy
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, Final

import numpy as np
from pydantic import AfterValidator, Field, ValidationInfo

import drivers.decoders
import drivers.links
from drivers.data_types import make_block
from drivers.decoders.base import AddressFilteringDecoder, Decoder
from drivers.errors import ConfigError
from drivers.links.base import AddressFilteringLink, Link, LinkSettings
from drivers.validation import module_lookup, number_ranges
from drivers.validation.number_ranges import format_value
from drivers.validation.settings_model import (
    Conflict,
    ListOf,
    Problem,
    SettingsModel,
    TableCheckResult,
    TableError,
    check_table,
    fields_by_key,
)
from monitor.common.shipped_config_paths import resolve_model_path
from monitor.settings.field_types import Duration

VIRTUAL: Final = "virtual"
"""Name of the link of a simulated sensor."""
VIRTUAL_DECODER: Final = "vectornav_binary"
"""Default decoder of a simulated sensor."""

Share = Annotated[float, number_ranges.FRACTION]


class FaultsTable(SettingsModel):
    """Table ``[device.driver.faults]``: random transmission faults of a simulated sensor."""

    lost: Share = Field(
        0.0, description="share of samples that are not sent, although the counter of the sensor counts them"
    )
    repeated: Share = Field(0.0, description="share of samples that are sent twice")
    flipped: Share = Field(0.0, description="share of samples with one flipped bit")
    cut: Share = Field(0.0, description="share of samples whose frame ends too early")
    jitter: Annotated[float, number_ranges.JITTER_S] = Field(
        0.0, description="largest random delay of a burst of bytes in s"
    )
    unplugged: Share = Field(0.0, description="probability that the cable is pulled before a sample")
    unplugged_for: Duration = Field(
        2.0, description="time in s, on the clock of the sensor, until the cable is plugged in again"
    )
    clock: Annotated[float, number_ranges.CLOCK_RATIO] = Field(
        1.0, description="true sample rate divided by the rate that the sensor states"
    )

    def find_conflicting_settings(self) -> Iterator[Conflict]:
        """Yield a conflict if the fractions of faulty samples add up to more than 1."""
        if self.lost + self.repeated + self.flipped + self.cut > 1.0:
            text = "lost, repeated, flipped and cut are shares of all samples: their sum is at most 1"
            yield Conflict("", text, ("lost", "repeated", "flipped", "cut"))


def _model_file(name: str, info: ValidationInfo) -> str:
    return str(resolve_model_path(name, info.context.folder or Path())) if info.context else name


class VirtualTable(LinkSettings):
    """Configuration keys of a simulated sensor (``link = "virtual"``), which sends a real wire format over a real link.

    The decoder determines the type of link: a pseudo-terminal, a virtual CAN bus of python-can, or zenoh on the
    loopback interface.
    """

    model: Annotated[str, AfterValidator(_model_file)] = Field(
        "consumer-mems", validate_default=True, description="path of a model file, or name of a shipped model"
    )
    seed: Annotated[int, number_ranges.SEED] = Field(
        1, description="seed of the random numbers; the same seed gives the same samples"
    )
    speed: Annotated[float, number_ranges.SIMULATION_SPEED] = Field(
        1.0, description="simulation speed relative to real time"
    )
    effect: ListOf[str] = Field(
        (),
        examples=[["gz.sinusoidal:amplitude=1e-3,frequency=17"]],
        description="effects that begin while the sensor runs",
    )
    effect_at: Annotated[float, number_ranges.DELAY_S] = Field(
        90.0, description="time in s, on the clock of the sensor, at which the effects begin"
    )
    faults: FaultsTable = Field(FaultsTable(), description="faults of the transmission")


@dataclass(frozen=True, slots=True)
class BuiltLinkAndDecoder:
    """Link and decoder of a device, built from a configuration. The link is not open."""

    link: Link | VirtualTable
    decoder: Decoder
    silence_s: float = 3.0  # time without data after which the link is opened again; 0 = never


def link_settings_class(name: str) -> type[LinkSettings]:
    """Return the settings class of a link, which defines the configuration keys of the link.

    Raises
    ------
    ConfigError
        If no link has this name. The message lists all links, the most similar name first.
    """
    if name == VIRTUAL:
        return VirtualTable
    if name not in list_link_names():
        raise ConfigError(f'"{name}"{module_lookup.format_choices_by_similarity(name, list_link_names())}')
    settings: type[LinkSettings] = module_lookup.import_module(drivers.links, name, "_link").Settings
    return settings


def list_link_names() -> tuple[str, ...]:
    """Return the names of all links, including the link of a simulated sensor."""
    return tuple(sorted({*module_lookup.list_modules(drivers.links, "_link"), VIRTUAL}))


def list_decoders(carrier: str) -> tuple[str, ...]:
    """Return the names of the decoders that read one kind of chunks, such as ``frames``."""
    known = module_lookup.list_modules(drivers.decoders)
    return tuple(one for one in known if _carrier_of(module_lookup.import_module(drivers.decoders, one)) == carrier)


def default_decoder(link: str) -> str:
    """Return the default decoder of a link, or an empty string if a configuration must name the decoder."""
    if link == VIRTUAL:
        return VIRTUAL_DECODER
    return str(module_lookup.import_module(drivers.links, link, "_link").DEFAULT_DECODER)


def build_link_and_decoder(table: Mapping[str, Any], folder: Path | None) -> BuiltLinkAndDecoder:
    """Build the link and the decoder from a configuration table ``[device.driver]``.

    Parameters
    ----------
    table
        Keys and values as read from TOML.
    folder
        Folder to which relative paths refer.

    Raises
    ------
    TableError
        If the table is invalid. ``partial`` is the ``VirtualTable`` of a simulated sensor.
    """
    keys = dict(table)
    name, decoder_name, options = keys.pop("link", None), keys.pop("decoder", ""), keys.pop("decoder_options", {})
    problems: list[Problem] = []
    link: Link | VirtualTable | None = None
    carrier, silence_s = "", 0.0
    if not isinstance(name, str) or name not in list_link_names():
        said = "missing" if name is None else format_value(name)
        problems.append(
            Problem("link", f"{said}{module_lookup.format_choices_by_similarity(str(name or ''), list_link_names())}")
        )
    else:
        module = None if name == VIRTUAL else module_lookup.import_module(drivers.links, name, "_link")
        checked = check_table(link_settings_class(name), keys, folder)
        link = checked.value if isinstance(checked.value, VirtualTable) else _build(module, checked)
        problems += checked.problems
        carrier = "" if module is None else getattr(link, "carrier", "") or _carrier_of(module)
        decoder_name = decoder_name or getattr(link, "default_decoder", default_decoder(name))
        silence_s = checked.value.silence if checked.value is not None else 0.0
    decoder = None
    if name in list_link_names() or decoder_name:
        decoder = _read_decoder(decoder_name, options, folder, (str(name), carrier), problems)
    if problems or link is None or decoder is None:
        raise TableError(problems, link if isinstance(link, VirtualTable) else None)
    if isinstance(link, AddressFilteringLink) and isinstance(decoder, AddressFilteringDecoder):
        link.set_address_filter(decoder.accepted_addresses)
    return BuiltLinkAndDecoder(link, decoder, silence_s)


def _read_decoder(
    name: object, options: object, folder: Path | None, link: tuple[str, str], problems: list[Problem]
) -> Decoder | None:
    """Build the decoder for a link, which is given by name and carrier. Append all problems to ``problems``."""
    known = module_lookup.list_modules(drivers.decoders)
    if not isinstance(name, str) or name not in known:
        said = format_value(name) if name else "missing"
        problems.append(Problem("decoder", f"{said}{module_lookup.format_choices_by_similarity(str(name), known)}"))
        return None
    module = module_lookup.import_module(drivers.decoders, name)
    if not isinstance(options, dict):
        problems.append(Problem("decoder_options", f"expected a table, got {format_value(options)}"))
        return None
    checked = check_table(module.Settings, options, folder)
    decoder: Decoder | None = _build(module, checked)
    problems += (problem.nest_under("decoder_options") for problem in checked.problems)
    link_name, carrier = link
    if carrier and _carrier_of(module) not in ("", carrier):
        fitting = ", ".join(list_decoders(carrier))
        text = f"{name} reads {_carrier_of(module)}, link {link_name} provides {carrier}: possible are {fitting}"
        problems.append(Problem("decoder", text))
    if link_name == VIRTUAL and decoder is not None:
        try:
            copy.deepcopy(decoder).encode(
                make_block(np.zeros(1, np.int64), np.zeros((1, 6)), ticks=np.zeros(1, np.int64))
            )
        except ConfigError as error:
            problems += (Problem("decoder_options", line) for line in error.mistake_lines)
    return decoder


def _build(module: ModuleType | None, checked: TableCheckResult[Any]) -> Any:
    """Build a link or decoder from checked settings. Return None and add the problems if the settings are invalid."""
    if checked.value is None or module is None:
        return None
    keys = fields_by_key(type(checked.value))
    if any(problem.key_path in keys and keys[problem.key_path].is_required() for problem in checked.problems):
        return None
    sound = not checked.problems
    try:
        built = module.build(checked.value)
    except ConfigError as error:
        for line in error.mistake_lines:
            place, _, text = line.partition(": ")
            if re.split(r"[.\[]", place)[0] in keys:
                checked.add_problem(place, text)
            else:
                checked.problems.append(Problem("", line))
        return None
    return built if sound else None


def _carrier_of(module: ModuleType) -> str:
    """Return the carrier of a link or decoder module, or an empty string if the carrier depends on the settings."""
    kinds = [one for one in vars(module).values() if isinstance(one, type) and one.__module__ == module.__name__]
    return next((str(kind.carrier) for kind in kinds if hasattr(kind, "carrier")), "")
