"""Layout of the scans in the buffer of a Linux IIO device.

A scan contains one sample of each enabled channel. The kernel describes each channel in the sysfs folder
``scan_elements`` (Documentation/ABI/testing/sysfs-bus-iio). Each element is aligned to its own size, and the size of a
scan is a multiple of the size of its largest element.

The link writes the layout as JSON to ``Chunk.attachment``, and the decoder reads the layout from there. A recording of
the chunks is therefore complete.
"""

import re
from math import isfinite
from typing import Final, NamedTuple

import msgspec

from drivers.errors import DecodeError

TIMESTAMP: Final = "in_timestamp"
"""Channel with the time in ns at which the kernel captured the scan."""
MAX_FACTOR: Final = 1e15
"""Largest plausible absolute value of a scale or offset."""
SCAN_TYPE: Final = re.compile(r"(be|le):([su])(\d{1,2})/(8|16|32|64)(?:X(\d{1,2}))?>>(\d{1,2})")
"""Regular expression that matches the type of a channel, such as "le:s12/16>>4" or "le:s16/64X4>>0"."""


class ScanElement(msgspec.Struct, frozen=True):
    """Channel in a scan. The value in the unit of the kernel is (raw value + offset) · scale."""

    channel: str  # such as "in_anglvel_x"
    type: str  # as in sysfs, such as "le:s16/16>>0"
    scale: float = 1.0
    offset: float = 0.0


class ScanLayout(msgspec.Struct, frozen=True):
    """Channels of a scan in the order of the buffer, and the clock of the time stamps."""

    clock: str  # clock of the kernel, such as "realtime" or "monotonic"
    elements: list[ScanElement]

    def encode(self) -> bytes:
        """Return the layout as JSON."""
        return msgspec.json.encode(self)


class StoredNumber(NamedTuple):
    """Position and format of an integer in a scan."""

    offset: int  # number of bytes before the number
    byte_order: str  # "<" or ">"
    signed: bool
    bits: int  # number of significant bits
    size: int  # number of stored bytes
    shift: int  # number of bits to the right of the significant bits


def decode_layout(data: bytes) -> ScanLayout:
    """Return the layout that ``ScanLayout.encode`` has written. Raise ``DecodeError`` if the JSON is invalid."""
    try:
        layout = msgspec.json.decode(data, type=ScanLayout)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise DecodeError(f"no layout of an IIO scan: {error}") from error
    for one in layout.elements:
        if not (_is_plausible(one.scale) and _is_plausible(one.offset)):
            raise DecodeError(f"{one.channel}: scale {one.scale:g} and offset {one.offset:g} are not plausible")
    return layout


def locate_numbers(elements: list[ScanElement]) -> tuple[dict[str, StoredNumber], int]:
    """Return the position and format of each channel in a scan, and the size of a scan in bytes.

    If an element repeats a number, only the first number is returned.

    Parameters
    ----------
    elements
        Channels in the order of the buffer.

    Raises
    ------
    DecodeError
        If no channel is enabled or the type of a channel is unknown.

    Examples
    --------
    >>> numbers, size = locate_numbers([ScanElement("in_temp", "be:s16/16>>0"), ScanElement(TIMESTAMP, "le:s64/64>>0")])
    >>> numbers[TIMESTAMP].offset, size
    (8, 16)
    """
    numbers, end, largest = {}, 0, 1
    for element in elements:
        match = SCAN_TYPE.fullmatch(element.type)
        bits, storage_bits, repeat, shift = (int(one or 1) for one in match.groups()[2:]) if match else (0, 0, 0, 0)
        if match is None or not 1 <= bits <= storage_bits - shift or not repeat:
            raise DecodeError(f'{element.channel}: unknown type "{element.type}"; disable this channel of the buffer')
        size = storage_bits // 8
        start = _round_up(end, size * repeat)
        numbers[element.channel] = StoredNumber(
            start, ">" if match[1] == "be" else "<", match[2] == "s", bits, size, shift
        )
        end, largest = start + size * repeat, max(largest, size * repeat)
    if not numbers:
        raise DecodeError("no channel of the buffer is enabled")
    return numbers, _round_up(end, largest)


def _round_up(offset: int, size: int) -> int:
    return -(-offset // size) * size


def _is_plausible(factor: float) -> bool:
    return isfinite(factor) and abs(factor) <= MAX_FACTOR
