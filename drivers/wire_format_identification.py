"""Identification of the wire format in captured bytes.

Every decoder of byte streams is tried. The decoder that finds the most samples identifies the format. If none finds
samples, the layout of text lines is identified for the decoder ``text``.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from types import ModuleType
from typing import Any, Final, Literal, get_args, get_origin

import numpy as np

from drivers import decoders
from drivers.data_types import NO_TICK, Chunk, CounterTimedFormat, SampleBlock, concatenate_blocks
from drivers.decoders.base import Decoder
from drivers.errors import ConfigError
from drivers.text_layout_identification import decode_readable_lines, identify_text_layout
from drivers.validation import module_lookup
from drivers.validation.settings_model import SettingsModel

MIN_SAMPLES: Final = 5
"""Minimum number of samples or text lines that identify a format.

Even for a format with an 8-bit checksum, random bytes look like two consecutive samples less than once in 10⁹ bytes.
"""
TEXT_DECODER: Final = "text"
UNKNOWN: Final = "?"
"""Placeholder for an option that cannot be determined from the bytes, such as the sensor model."""


@dataclass(frozen=True, slots=True)
class IdentifiedFormat:
    """Wire format that was found in captured bytes."""

    decoder: str
    options: Mapping[str, Any] = field(default_factory=dict)  # decoder options that differ from their defaults
    samples: int = 0  # number of decoded samples, or of text lines
    bad: int = 0  # number of rejected frames
    rate_hz: float | None = None  # sample rate by the device clock; None if the frames contain no clock
    text_lines: tuple[str, ...] = ()  # received text; empty for other formats


def identify_wire_format(data: bytes) -> IdentifiedFormat | None:
    """Return the wire format of captured bytes, or None if no decoder finds at least ``MIN_SAMPLES`` samples.

    Parameters
    ----------
    data
        Bytes of a serial port in their original order. 4 kB are enough for most formats.
    """
    found: list[IdentifiedFormat] = []
    for name, module, option_sets in _list_decoders():
        for options in option_sets:
            result = _decode(name, module, options, data)
            if result is not None and result.samples >= MIN_SAMPLES:
                found.append(result)
                break  # options that change only the units or the clock would find the same frames
    if not found:
        return _identify_text_lines(data)
    return max(found, key=lambda one: (one.samples, -one.bad))


@cache
def _list_decoders() -> tuple[tuple[str, ModuleType, tuple[dict[str, Any], ...]], ...]:
    """Return name, module and option sets of every decoder except that of text lines."""
    names = (name for name in module_lookup.list_modules(decoders) if name != TEXT_DECODER)
    modules = ((name, module_lookup.import_module(decoders, name)) for name in names)
    return tuple((name, module, tuple(_list_option_sets(module.Settings))) for name, module in modules)


def _list_option_sets(settings: type[SettingsModel]) -> Iterator[dict[str, Any]]:
    """Yield the required options, then every other value of each option that is a choice or a flag.

    A required option with a fixed set of choices is set to the first choice.
    """
    choices: dict[str, tuple[Any, ...]] = {}
    for key, info in settings.model_fields.items():
        if info.annotation is bool:
            choices[key] = (False, True)
        elif get_origin(info.annotation) is Literal:
            choices[key] = get_args(info.annotation)
    required = {key: values[0] for key, values in choices.items() if settings.model_fields[key].is_required()}
    yield required
    for key in [key for key in choices if key not in required]:
        yield from ({**required, key: one} for one in choices[key] if one != settings.model_fields[key].default)


def _decode(name: str, module: ModuleType, options: dict[str, Any], data: bytes) -> IdentifiedFormat | None:
    """Decode the bytes with one decoder. The result is None if the decoder reads no bytes or needs further options."""
    decoder = _build_decoder(module, options)
    if decoder is None or decoder.carrier != "bytes":
        return None
    blocks = decoder.feed([Chunk(data, 0)])
    samples = sum(map(len, blocks))
    fields = module.Settings.model_fields
    known = {key: UNKNOWN if fields[key].is_required() else value for key, value in options.items()}
    return IdentifiedFormat(name, known, samples, decoder.bad, _measure_rate_hz(decoder, blocks))


def _build_decoder(module: ModuleType, options: dict[str, Any]) -> Decoder | None:
    """Build a decoder with these options. If it needs further options, use their examples."""
    fields = module.Settings.model_fields.items()
    examples = {key: info.examples[0] for key, info in fields if info.examples and not info.is_required()}
    for others in ({}, examples):
        try:
            decoder: Decoder = module.build(module.Settings(**{**others, **options}))
        except (ConfigError, ValueError):  # a required option is missing, or options contradict each other
            continue
        return decoder
    return None


def _measure_rate_hz(decoder: Decoder, blocks: list[SampleBlock]) -> float | None:
    """Return the sample rate by the device clock, or None if there is none."""
    timing = decoder.timing
    if not blocks or not isinstance(timing, CounterTimedFormat) or timing.tick_s is None:
        return None
    ticks = concatenate_blocks(blocks).ticks
    steps = np.diff(ticks[ticks != NO_TICK]) % timing.modulus
    period_s = float(np.median(steps)) * timing.tick_s if steps.size else 0.0
    return 1.0 / period_s if period_s > 0.0 else None


def _identify_text_lines(data: bytes) -> IdentifiedFormat | None:
    lines = decode_readable_lines(data)[1:-1]  # the first and the last line may be incomplete
    options, matching = identify_text_layout(lines)
    return IdentifiedFormat(TEXT_DECODER, options, matching, text_lines=tuple(lines)) if options else None
