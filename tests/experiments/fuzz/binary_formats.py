"""Simple second implementation of further binary wire formats, as in ``tests.experiments.fuzz.formats``."""

import struct
from collections.abc import Iterator
from typing import Final

from tests.experiments.fuzz.formats import DEGREE, Format, G, Reading, Settings, find_offsets, has_finite_values

# --- Epson

EPSON_SCALES: Final = {"g364pdca": (0.00375, 0.125), "g366pdg0": (1 / 66, 0.25)}
"""Value of one 16-bit LSB in °/s and mg for the models of the examples."""
EPSON_FIELDS: Final = ("flags", "temperature", "gyro", "accel", "gpio", "count")


def _epson_format(settings: Settings) -> str:
    number = "i" if settings.get("bits") == 32 else "h"
    formats = {"temperature": number, "gyro": 3 * number, "accel": 3 * number}
    return ">" + "".join(formats.get(field, "H") for field in settings.get("fields", EPSON_FIELDS))


def _sum_of_words(data: bytes) -> int:
    return sum(int.from_bytes(data[at : at + 2], "big") for at in range(0, len(data), 2)) % 65536


def _epson_wrap(data: bytes, settings: Settings) -> bytes:
    size = struct.calcsize(_epson_format(settings))
    body = data[:size].ljust(size, b"\0")
    return b"\x80" + body + _sum_of_words(body).to_bytes(2, "big") + b"\r"


def _epson_readings(stream: bytes, settings: Settings) -> Iterator[Reading]:
    form = _epson_format(settings)
    size = struct.calcsize(form)
    gyro, accel = EPSON_SCALES[settings["model"]]
    finer = 65536 if settings.get("bits") == 32 else 1
    for at in find_offsets(stream, b"\x80"):
        body = stream[at + 1 : at + 1 + size]
        if stream[at + 1 + size : at + 4 + size] != _sum_of_words(body).to_bytes(2, "big") + b"\r":
            continue
        names = [name for field in EPSON_FIELDS for name in ([field] * 3 if field in ("gyro", "accel") else [field])]
        numbers = list(zip(names, struct.unpack(form, body), strict=True))
        rates = [number * gyro * DEGREE / finer for name, number in numbers if name == "gyro"]
        accelerations = [number * accel * G / 1000 / finer for name, number in numbers if name == "accel"]
        if not dict(numbers)["flags"] % 2:
            yield (*rates, *accelerations)


# --- MIP


def _mip_checksum(body: bytes) -> bytes:
    first = second = 0
    for byte in body:
        first = (first + byte) % 256
        second = (second + first) % 256
    return bytes([first, second])


def _mip_wrap(data: bytes, settings: Settings) -> bytes:
    data = data[:255]
    body = b"\x75\x65" + (b"\x82" if data[:1] > b"\xf0" else b"\x80") + bytes([len(data)]) + data
    return body + _mip_checksum(body)


def _mip_fields(payload: bytes) -> list[tuple[int, bytes]] | None:
    fields = []
    while payload:
        if len(payload) < 2 or not 2 <= payload[0] <= len(payload):
            return None
        fields.append((payload[1], payload[2 : payload[0]]))
        payload = payload[payload[0] :]
    return fields


def _mip_readings(stream: bytes, settings: Settings) -> Iterator[Reading]:
    for at in find_offsets(stream, b"\x75\x65\x80"):
        size = stream[at + 3] if len(stream) > at + 3 else len(stream)
        end = at + 4 + size
        if len(stream) < end + 2 or stream[end : end + 2] != _mip_checksum(stream[at:end]):
            continue
        row = _mip_row(_mip_fields(stream[at + 4 : end]), bool(settings.get("increments")))
        if row is not None and has_finite_values(row):
            yield tuple(row)


def _mip_row(fields: list[tuple[int, bytes]] | None, increments: bool) -> list[float | None] | None:
    """Return the six values of a packet, or None if the packet is invalid or contains no sample."""
    first: dict[tuple[int, int], bytes] = {}
    for descriptor, data in fields or ():
        first.setdefault((descriptor, len(data)), data)
    seconds = 1.0
    if increments:
        if (0xD6, 8) not in first:
            return None
        seconds = int.from_bytes(first[0xD6, 8], "big", signed=True) / 1e9
        if seconds <= 0:
            return None
    if (0x18, 2) in first and first[0x18, 2][1] & 0x77:
        return None
    row: list[float | None] = []
    for descriptor, unit in ((0x07, 1.0), (0x08, G)) if increments else ((0x05, 1.0), (0x04, G)):
        data = first.get((descriptor, 12))
        row += [None] * 3 if data is None else [number * unit / seconds for number in struct.unpack(">3f", data)]
    return row


# --- sbgECom

SBG_SIZES: Final = {b"\x2c\0": 32, b"\x03\0": 58}


def _sbg_crc(data: bytes) -> bytes:
    register = 0
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = register >> 1 ^ (0x8408 if register & 1 else 0)
    return register.to_bytes(2, "little")


def _sbg_wrap(data: bytes, settings: Settings) -> bytes:
    header = b"\x03\0" if settings.get("message") == "imu_data" else b"\x2c\0"
    if data[:1] > b"\xe0":
        header = data[:2].ljust(2, b"\0")
    size = SBG_SIZES.get(header, len(data))
    inner = header + size.to_bytes(2, "little") + data[:size].ljust(size, b"\0")
    return b"\xff\x5a" + inner + _sbg_crc(inner) + b"\x33"


def _sbg_readings(stream: bytes, settings: Settings) -> Iterator[Reading]:
    has_floats = settings.get("message") == "imu_data"
    header = b"\x03\0" if has_floats else b"\x2c\0"
    size = SBG_SIZES[header]
    start = b"\xff\x5a" + header + size.to_bytes(2, "little")
    for at in find_offsets(stream, start):
        end = at + 6 + size
        if len(stream) < end + 3 or stream[end : end + 3] != _sbg_crc(stream[at + 2 : end]) + b"\x33":
            continue
        status, *numbers = struct.unpack_from("<H6f" if has_floats else "<H6i", stream, at + 10)
        scale = 12304174.0 if status & 0x400 else 67108864.0
        divisors = [1.0] * 6 if has_floats else [1048576.0] * 3 + [scale] * 3
        row: list[float | None] = [number / divisor for number, divisor in zip(numbers, divisors, strict=True)]
        if status & 0x3FF == 0x3FF and has_finite_values(row):
            yield (*row[3:], *row[:3])


# --- Silicon Sensing


def _dmu_wrap(data: bytes, settings: Settings) -> bytes:
    size = settings.get("length", 68) - 4
    body = b"\x55\xaa" + data[:size].ljust(size, b"\0")
    return body + (-_sum_of_words(body) % 65536).to_bytes(2, "big")


def _dmu_readings(stream: bytes, settings: Settings) -> Iterator[Reading]:
    size = settings.get("length", 68)
    for at in find_offsets(stream, b"\x55\xaa"):
        if len(stream) < at + size or _sum_of_words(stream[at : at + size]):
            continue
        numbers = struct.unpack_from(">6f", stream, at + 4)
        if has_finite_values(list(numbers)):
            yield (*[number * DEGREE for number in numbers[::2]], *[number * G for number in numbers[1::2]])


BINARY_FORMATS: Final = {
    "epson_uart": Format(_epson_wrap, _epson_readings),
    "microstrain_mip": Format(_mip_wrap, _mip_readings),
    "sbg_ecom": Format(_sbg_wrap, _sbg_readings),
    "silicon_sensing_dmu": Format(_dmu_wrap, _dmu_readings),
}
