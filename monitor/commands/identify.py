"""Identification of the wire format on a serial port or in a file of captured bytes."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic
from typing import Final

import msgspec

from drivers.data_types import AXES
from drivers.errors import ConfigError, LinkLost, LinkUnavailable, NotReady
from drivers.host import safe_file_reading
from drivers.links import serial_link
from drivers.text_layout_identification import MIN_LINES, decode_readable_lines
from drivers.validation.settings_model import check_table
from drivers.wire_format_identification import TEXT_DECODER, UNKNOWN, IdentifiedFormat, identify_wire_format

BAUD_RATES: Final = (115200, 460800, 921600, 230400, 9600, 57600, 38400, 19200, 374400, 1000000, 1843200, 2000000)
"""Baud rates of IMUs in bit/s, the most common first."""
MAX_BYTES: Final = 16384
"""Number of bytes that are examined, which is 0.2 s at the highest baud rate."""
MAX_SHOWN_LINES: Final = 5
MAX_SHOWN_CHARACTERS: Final = 200
GYRO_UNITS: Final = ("rad/s", "deg/s", "mdps", "deg/s/131")
ACCEL_UNITS: Final = ("m/s²", "g", "mg", "g/16384")
USUAL_GYRO_UNITS: Final = {"g": "deg/s", "mg": "deg/s", "g/16384": "deg/s/131"}
"""Unit of the gyroscope that boards usually send together with a unit of the accelerometer, if not rad/s."""
NO_BYTES_ADVICE: Final = (
    "check the power and the wiring of TX and RX; a sensor that only answers requests, such as a BNO055, "
    "cannot be identified"
)


@dataclass(frozen=True, slots=True)
class IdentifiedSource:
    """Port or file whose wire format has been identified."""

    source: str  # port or path
    format: IdentifiedFormat
    baudrate: int | None = None  # None for a file


def identify_file(path: Path) -> IdentifiedSource:
    """Identify the wire format in a file of captured bytes.

    Raises
    ------
    NotReady
        If no decoder finds samples.
    """
    with safe_file_reading.open_regular_file(path) as file:
        data = file.read(MAX_BYTES)
    found = identify_wire_format(data)
    if found is None:
        text = _describe_text(decode_readable_lines(data))
        raise NotReady(f"{path}: {text or f'no decoder finds samples in the first {len(data)} bytes'}")
    return IdentifiedSource(str(path), found)


def identify_port(port: str, listen_s: float, report: Callable[[str], None]) -> IdentifiedSource:
    """Listen to a serial port at each baud rate until a wire format is identified.

    Parameters
    ----------
    port
        Device or URL of pyserial. A network connection has no baud rate, so it is read once.
    listen_s
        Maximum time in s to listen at each baud rate.
    report
        Function that receives one line of text for each baud rate without a result.

    Raises
    ------
    ConfigError
        If the port is a URL of an unknown kind.
    LinkUnavailable
        If the port cannot be opened.
    NotReady
        If no decoder finds samples at any baud rate.
    """
    received = 0
    for baudrate in BAUD_RATES[:1] if "://" in port else BAUD_RATES:
        try:
            data, seconds = _listen(port, baudrate, listen_s)
        except LinkUnavailable as error:
            if baudrate == BAUD_RATES[0]:
                raise
            report(f"{baudrate} baud: {error}")  # the port does not support this baud rate
            continue
        received += len(data)
        found = identify_wire_format(data)
        if found is not None:
            rate_hz = found.rate_hz or (found.samples / seconds if seconds > 0.0 else None)
            return IdentifiedSource(port, replace(found, rate_hz=rate_hz), baudrate)
        if text := _describe_text(decode_readable_lines(data)):
            raise NotReady(f"{port}: {baudrate} baud: {text}")
        report(f"{baudrate} baud: {len(data)} bytes, no known format")
    if not received:
        raise NotReady(f"{port}: no bytes at any baud rate; {NO_BYTES_ADVICE}")
    raise NotReady(f"{port}: no decoder finds samples at any baud rate; try a longer time with --seconds")


def _describe_text(lines: Sequence[str]) -> str:
    """Return a message about readable text without a known layout; "" if there are no lines."""
    quoted = ", ".join(map(_to_toml, show_text(lines)))
    advice = "print all axes of a sample in one line, with the same text between the numbers"
    if len(lines) < MIN_LINES + 2:  # the first and the last line are not examined
        advice = f"at least {MIN_LINES + 2} lines are needed; try a longer time with --seconds"
    return f"the text is readable, but its lines have no known layout: {quoted}; {advice}" if lines else ""


def show_text(lines: Sequence[str]) -> list[str]:
    """Return the first lines of received text, shortened and with escaped control characters."""
    return [
        "".join(one if one.isprintable() else repr(one)[1:-1] for one in line[:MAX_SHOWN_CHARACTERS])
        for line in lines[:MAX_SHOWN_LINES]
    ]


def _listen(port: str, baudrate: int, listen_s: float) -> tuple[bytes, float]:
    """Return the received bytes and the time in s from the first to the last byte."""
    checked = check_table(serial_link.Settings, {"port": port, "baudrate": baudrate})
    if checked.problems or checked.value is None:
        raise ConfigError(*map(str, checked.problems))
    link = serial_link.build(checked.value)
    data = b""
    first_s = last_s = 0.0
    link.open()
    try:
        until_s = monotonic() + listen_s
        while len(data) < MAX_BYTES and (now_s := monotonic()) < until_s:
            chunks = link.wait_for_chunks_or_timeout(until_s - now_s)
            if chunks:
                last_s = monotonic()
                first_s = first_s or last_s
                data += b"".join(chunk.data for chunk in chunks)
    except LinkLost as error:
        raise LinkUnavailable(str(error)) from error
    finally:
        link.close()
    return data, last_s - first_s


def write_configuration(found: IdentifiedSource) -> str:
    """Return the configuration of a device with the identified wire format as TOML."""
    lines = ["[[device]]", 'name = "imu"']
    if found.format.rate_hz is not None:
        lines.append(f"# rate = {found.format.rate_hz:.4g}  # Hz, as measured; the program measures it again")
    lines += ["", "[device.driver]"]
    if found.baudrate is None:
        lines += ['link = "replay"', f"path = {_to_toml(found.source)}"]
    else:
        lines += ['link = "serial"', f"port = {_to_toml(found.source)}", f"baudrate = {found.baudrate}"]
    lines.append(f'decoder = "{found.format.decoder}"')
    if found.format.options:
        lines += ["", "[device.driver.decoder_options]"]
    options = dict(found.format.options)
    if found.format.decoder == TEXT_DECODER:
        lines += [f"# {line}" for line in ("received text:", *show_text(found.format.text_lines))]
        lines.append("# the columns are guessed from labels and gravity; turn the sensor to check axes and units")
    elif UNKNOWN in options.values():
        lines.append('# replace "?"; imu-monitor check names the possible values')
    lines += [f"{key} = {_to_toml(value)}" for key, value in options.items()]
    if found.format.decoder == TEXT_DECODER:
        columns = options.get("columns") or re.findall(r"\(\?P<(\w+)>", options["pattern"])
        usual = {"accel_unit": "m/s²", "gyro_unit": USUAL_GYRO_UNITS.get(options.get("accel_unit", ""), "rad/s")}
        for key, choices in (("gyro_unit", GYRO_UNITS), ("accel_unit", ACCEL_UNITS)):
            if key not in options and any(name[0] == key[0] for name in columns if name in AXES):
                listed = ", ".join(map(_to_toml, choices))
                lines.append(
                    f"{key} = {_to_toml(usual[key])}  # CHOOSE the unit, which the text does not show: {listed}, …"
                )
    return "\n".join(lines) + "\n"


def _to_toml(value: object) -> str:
    return msgspec.json.encode(value).decode()
