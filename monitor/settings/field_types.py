"""Types of configuration values with a special notation, such as durations, rates and addresses."""

import re
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple
from urllib.parse import parse_qs, urlsplit

from pydantic import BeforeValidator

from drivers.errors import ConfigError
from drivers.host import safe_file_reading
from drivers.validation.module_lookup import format_choices_by_similarity
from drivers.validation.number_ranges import DURATION_S, PERCENT, PORT, SIZE_BYTES, UPDATE_RATE_HZ, format_value
from drivers.validation.settings_model import ConvertedFrom, checked_by
from monitor.common.topics import ENDPOINT

UNITS_S: Final = {"": 1.0, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
"""Length of each unit of a duration, in seconds."""
NUMBER: Final = r"(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)"
DURATION_TEXT: Final = re.compile(rf"\s*({NUMBER}(?:e[+-]?[0-9]+)?)\s*([a-z]*)\s*")
RATE_TEXT: Final = re.compile(rf"\s*({NUMBER})\s*Hz\s*")
ENDPOINT_TEXT: Final = re.compile(r"[a-z]+/.+")
ZENOH_KEY: Final = re.compile(r"[^/*$?#]+(/[^/*$?#]+)*")
ADDRESS_TEXT: Final = re.compile(r"(\[[0-9a-fA-F:]+\]|[\w.-]+):([0-9]{1,5})", re.ASCII)
INFLUX_URL: Final = "http://127.0.0.1:8086/api/v2/write?org=lab&bucket=imu"
"""Example of a write endpoint of InfluxDB."""
INFLUX_PRECISIONS: Final = ("ns", "n", "nanosecond", "auto")
"""Values of the parameter ``precision`` that mean nanoseconds in the different versions of InfluxDB."""
VIEWER_MODES: Final = ("auto", "native", "web", "none")
SIZE_TEXT: Final = re.compile(r"([0-9]{1,20}(?:\.[0-9]{1,20})?)\s*(?:([kMGT]?)(i?)B|%)")


class MetricsAddress(NamedTuple):
    """Host and port on which the service answers requests of Prometheus."""

    host: str
    port: int


def parse_duration_s(value: float | str) -> float:
    """Return a duration in seconds. The value is a number of seconds or a text such as "90s", "30min", "1h" or "2d".

    >>> parse_duration_s("30min"), parse_duration_s(3600), parse_duration_s("1.5 h")
    (1800.0, 3600.0, 5400.0)
    """
    return DURATION_S.check(float(_parse_duration_text(value)))


def parse_rate_as_period(value: str, always_text: str) -> float:
    """Convert a rate such as "10 Hz" to the period in seconds. The text ``always_text`` gives a period of 0.

    Parameters
    ----------
    value
        Rate with unit, or the text ``always_text``.
    always_text
        Text for the shortest possible period, for example "every sample".

    >>> parse_rate_as_period("10 Hz", "every sample"), parse_rate_as_period("every sample", "every sample")
    (0.1, 0.0)
    """
    if value == always_text:
        return 0.0
    match = RATE_TEXT.fullmatch(value)
    rate_hz = float(match[1]) if match else 0.0
    if not rate_hz > 0.0:
        raise ConfigError(f'{format_value(value)} is not a rate; write "10 Hz" or "{always_text}"')
    return 1.0 / UPDATE_RATE_HZ.check(rate_hz)


def period_stated_as_rate_annotation(always_text: str) -> ConvertedFrom:
    """Return the type annotation of a period that a configuration states as a rate or as ``always_text``."""
    return ConvertedFrom(str, lambda value, folder: parse_rate_as_period(value, always_text))


def check_memory_limit(size: str) -> None:
    """Raise ConfigError if a text is not a valid memory size such as "256MiB" or "25%".

    >>> check_memory_limit("256MiB"), check_memory_limit("25%")
    (None, None)
    """
    match = SIZE_TEXT.fullmatch(size)
    if match is None:
        raise ConfigError(f'{format_value(size)} is not a size; write "256MiB", "1GB" or "25%"')
    number, prefix, binary = match.groups()
    if size.endswith("%"):
        PERCENT.check(float(number))
    else:
        SIZE_BYTES.check(float(number) * (1024.0 if binary else 1000.0) ** ("", *"kMGT").index(prefix))


def check_viewer_mode(mode: str) -> None:
    """Raise ConfigError if the viewer mode is unknown."""
    if mode not in VIEWER_MODES and not mode.endswith(".rrd"):
        raise ConfigError(f'"{mode}"{format_choices_by_similarity(mode, VIEWER_MODES)}, or a file ending in .rrd')


def _parse_duration_text(value: Any) -> Any:
    """Convert a duration from text to seconds. Values of other types are returned unchanged."""
    if not isinstance(value, str):
        return value
    match = DURATION_TEXT.fullmatch(value)
    duration_s = float(match[1]) * UNITS_S.get(match[2], 0.0) if match else 0.0
    if not duration_s > 0.0:
        raise ConfigError(f'{format_value(value)} is not a duration; write seconds, or "90s", "30min", "1h", "2d"')
    return duration_s


def _path(name: str, folder: Path | None) -> Path:
    """Resolve a path relative to the folder of the configuration file."""
    return (folder or Path()) / safe_file_reading.expand_user(name)


def _check_endpoint(endpoint: str) -> None:
    if not ENDPOINT_TEXT.fullmatch(endpoint):
        raise ConfigError(f'{format_value(endpoint)} is not an endpoint; write "{ENDPOINT}"')


def _check_zenoh_key(key: str) -> None:
    if not ZENOH_KEY.fullmatch(key):
        example = 'a zenoh key such as "site/alarms", without * $ ? # and with text between slashes'
        raise ConfigError(f"expected {example}, got {format_value(key)}")


def _address(text: str, _: Path | None) -> MetricsAddress:
    """Parse an address such as "127.0.0.1:9464"."""
    match = ADDRESS_TEXT.fullmatch(text)
    if match is None or int(match[2]) == 0 or not PORT.supports(int(match[2])):
        raise ConfigError(f'{format_value(text)} is not a host and port; write "127.0.0.1:9464"')
    return MetricsAddress(match[1].strip("[]"), int(match[2]))


def _check_influx_url(url: str) -> None:
    try:
        parts = urlsplit(url)
        has_host = bool(parts.hostname) and parts.port != 0
    except ValueError:  # the port or the IPv6 address is invalid
        has_host = False
    printable = url.isascii() and url.isprintable() and " " not in url
    if not (printable and has_host and parts.scheme in ("http", "https") and parts.path.strip("/")) or parts.fragment:
        raise ConfigError(f'{format_value(url)} is not the address of a write endpoint; write "{INFLUX_URL}"')
    parameters = parse_qs(parts.query)
    if parts.username is not None or "p" in parameters:
        raise ConfigError("the address contains a password; write user:password into token_file instead")
    if not set(parameters.get("precision", [])) <= set(INFLUX_PRECISIONS):
        raise ConfigError("remove precision from the address, because the times are sent in nanoseconds")


DURATION_FROM_TEXT: Final = BeforeValidator(_parse_duration_text)
"""Annotation of a duration in seconds that a configuration may state as a text such as "1h"."""
Duration = Annotated[float, DURATION_S, DURATION_FROM_TEXT]
RelativePath = Annotated[Path, ConvertedFrom(str, _path)]
"""Path type. Relative paths refer to the folder of the configuration file."""
Endpoint = Annotated[str, checked_by(_check_endpoint)]
ZenohKey = Annotated[str, checked_by(_check_zenoh_key)]
Address = Annotated[MetricsAddress, ConvertedFrom(str, _address)]
InfluxUrl = Annotated[str, checked_by(_check_influx_url)]
