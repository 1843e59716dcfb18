"""Simple second implementation of the wire formats, with which the fuzzed decoders are compared.

It shares only the tables of identifiers and field sizes with ``drivers.decoders``. ``wrap`` builds a frame with a valid
checksum from any bytes. ``find_readings`` finds the frames with a valid checksum at every offset of a stream. It
returns the six values of each frame: gx, gy and gz in rad/s, and ax, ay and az in m/s². The value is None if the frame
does not contain the axis. The samples of a decoder must be a subsequence of these readings.
"""

import math
import re
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, reduce
from operator import xor
from typing import Any, Final

from drivers.decoders.binary_frames.stim300 import IDENTIFIERS
from drivers.decoders.binary_frames.vectornav_binary import FIELD_SIZES

DEGREE: Final = math.pi / 180.0
G: Final = 9.80665

Reading = tuple[float | None, ...]
Settings = Mapping[str, Any]


@dataclass(frozen=True)
class Format:
    """Stream format. ``find_readings`` is None if the frames have no checksum."""

    wrap: Callable[[bytes, Settings], bytes]
    find_readings: Callable[[bytes, Settings], Iterator[Reading]] | None


@cache
def _build_crc_table(bits: int, polynomial: int) -> tuple[int, ...]:
    """Return the remainder of each byte, from a register that is 0."""
    table = []
    for byte in range(256):
        register = byte << (bits - 8)
        for _ in range(8):
            register = register << 1 ^ (polynomial if register >> (bits - 1) & 1 else 0)
        table.append(register & ((1 << bits) - 1))
    return tuple(table)


def compute_crc(data: bytes, bits: int, polynomial: int, register: int) -> int:
    """Return the cyclic redundancy check of the data, with the most significant bit first."""
    table, top, mask = _build_crc_table(bits, polynomial), bits - 8, (1 << bits) - 1
    for byte in data:
        register = (register << 8 ^ table[register >> top ^ byte]) & mask
    return register


def compute_xor(data: bytes) -> int:
    return reduce(xor, data, 0)


def find_offsets(stream: bytes, start: bytes) -> Iterator[int]:
    at = stream.find(start)
    while at >= 0:
        yield at
        at = stream.find(start, at + 1)


def has_finite_values(row: list[float | None]) -> bool:
    """Return True if a row contains a number and all its numbers are finite."""
    numbers = [x for x in row if x is not None]
    return bool(numbers) and all(math.isfinite(x) for x in numbers)


# --- STIM300


def _stim300_size(identifier: int) -> int:
    parts = IDENTIFIERS[identifier]
    sensors = 1 + (parts & 1) + (parts >> 1 & 1)
    return 1 + 10 * sensors + (7 * sensors if parts & 4 else 0) + (4 if parts & 8 else 0) + 3 + 4


def _stim300_check(body: bytes) -> bytes:
    return compute_crc(body + bytes(-len(body) % 4), 32, 0x04C11DB7, 0xFFFFFFFF).to_bytes(4, "big")


def _stim300_wrap(data: bytes, settings: Settings) -> bytes:
    known = sorted(IDENTIFIERS)
    identifier = settings.get("identifier") or known[data[0] % len(known) if data else 0]
    body = bytes([identifier]) + data[1:]
    size = _stim300_size(identifier) - 4
    body = body[:size].ljust(size, b"\0")
    return body + _stim300_check(body)


def _stim300_readings(stream: bytes, settings: Settings) -> Iterator[Reading]:
    rate = settings.get("rate", 1.0)
    gyro = rate / 2**21 if settings.get("gyro_output") == "increment" else 1 / 2**14
    accel = rate / 2**22 if settings.get("accelerometer_output") == "increment" else G / 2**19
    for at, first in enumerate(stream):
        if first not in IDENTIFIERS:
            continue
        frame = stream[at : at + _stim300_size(first)]
        if len(frame) < _stim300_size(first) or _stim300_check(frame[:-4]) != frame[-4:]:
            continue
        status = frame[10]
        row: list[float | None] = [DEGREE * gyro * _i24(frame, 1 + 3 * i) for i in range(3)] + [None] * 3
        if IDENTIFIERS[first] & 1:
            row[3:] = [accel * _i24(frame, 11 + 3 * i) for i in range(3)]
            status |= frame[20]
        if not status & 0b1101_1000:
            yield tuple(row)


def _i24(frame: bytes, at: int) -> int:
    return int.from_bytes(frame[at : at + 3], "big", signed=True)


# --- MAVLink

MAVLINK_IMU: Final = {"HIGHRES_IMU": 105, "SCALED_IMU": 26, "SCALED_IMU2": 116, "SCALED_IMU3": 129, "RAW_IMU": 27}
MAVLINK_CRC_EXTRA: Final = {105: 93, 26: 170, 116: 76, 129: 46, 27: 144}


def compute_reflected_crc(data: bytes) -> int:
    """Return the CRC-16/MCRF4XX, with the least significant bit first."""
    register = 0xFFFF
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = register >> 1 ^ (0x8408 if register & 1 else 0)
    return register


def _mavlink_wrap(data: bytes, settings: Settings) -> bytes:
    kind, payload = (data[0] if data else 0), data[1:256]
    numbers = (MAVLINK_IMU[settings.get("message", "HIGHRES_IMU")], *MAVLINK_CRC_EXTRA, 0, 30)
    number = numbers[kind % 8]
    if kind & 16:
        head, tail = bytes([0xFE, len(payload), kind, 1, 1, number]), b""
    else:
        head = bytes([0xFD, len(payload), kind >> 7, 0, kind, 1, 1, number, 0, 0])
        tail = bytes(13 * (kind >> 7))
    crc = compute_reflected_crc(head[1:] + payload + bytes([MAVLINK_CRC_EXTRA.get(number, 50)]))
    return head + payload + crc.to_bytes(2, "little") + tail


def _mavlink_readings(stream: bytes, settings: Settings) -> Iterator[Reading]:
    wanted = MAVLINK_IMU[settings.get("message", "HIGHRES_IMU")]
    for at, first in enumerate(stream):
        header = {0xFD: 10, 0xFE: 6}.get(first)
        if header is None or len(stream) < at + header:
            continue
        frame = stream[at : at + header + stream[at + 1] + 2]
        number = int.from_bytes(frame[7:10], "little") if first == 0xFD else frame[5]
        if number != wanted or len(frame) < header + frame[1] + 2:
            continue
        if compute_reflected_crc(frame[1:-2] + bytes([MAVLINK_CRC_EXTRA[number]])).to_bytes(2, "little") != frame[-2:]:
            continue
        payload = frame[header:-2].ljust(63, b"\0")
        row: list[float | None]
        if number == 105:
            row = list(struct.unpack_from("<3f", payload, 20) + struct.unpack_from("<3f", payload, 8))
            row = [x if payload[60] >> bit & 1 else None for x, bit in zip(row, (3, 4, 5, 0, 1, 2), strict=True)]
        else:
            counts = struct.unpack_from("<6h", payload, 8 if number == 27 else 4)
            gyro, accel = (DEGREE / 131, G / 16384) if number == 27 else (1e-3, 1e-3 * G)
            row = [gyro * x for x in counts[3:]] + [accel * x for x in counts[:3]]
        if has_finite_values(row):
            yield tuple(row)


# --- VectorNav


def _vectornav_fields(header: bytes) -> tuple[dict[tuple[int, int], int], int] | None:
    """Return the offset of each field and the length of the message, or None if the header is invalid."""
    if not header or header[0] in (0,) or header[0] & 0x80:
        return None
    groups = [g for g in range(1, 8) if header[0] >> (g - 1) & 1]
    at = 2 + 2 * len(groups)
    if len(header) < 1 + 2 * len(groups):
        return None
    fields = {}
    for i, group in enumerate(groups):
        mask = int.from_bytes(header[1 + 2 * i : 3 + 2 * i], "little")
        sizes = FIELD_SIZES.get(group, ())
        if not mask or mask >= 1 << len(sizes):
            return None
        for bit, size in enumerate(sizes):
            if mask >> bit & 1:
                fields[group, bit] = at
                at += size
    return fields, at + 2


def _vectornav_wrap(data: bytes, settings: Settings) -> bytes:
    found = _vectornav_fields(data)
    size = found[1] - 3 if found else len(data)
    inner = data[:size].ljust(size, b"\0")
    return b"\xfa" + inner + compute_crc(inner, 16, 0x1021, 0).to_bytes(2, "big")


def _vectornav_readings(stream: bytes, settings: Settings) -> Iterator[Reading]:
    gyro_fields = ((1, 9, 12), (3, 3, 0)), ((1, 5, 0), (3, 10, 0))
    accel_fields = ((1, 9, 0), (3, 2, 0)), ((1, 8, 0), (3, 9, 0))
    step = -1 if settings.get("compensated") else 1
    for at in find_offsets(stream, b"\xfa"):
        found = _vectornav_fields(stream[at + 1 : at + 20])
        if found is None or len(stream) < at + found[1]:
            continue
        fields, length = found
        inner = stream[at + 1 : at + length - 2]
        if compute_crc(inner, 16, 0x1021, 0).to_bytes(2, "big") != stream[at + length - 2 : at + length]:
            continue
        row: list[float | None] = []
        for kind in (gyro_fields, accel_fields):
            offsets = [fields[g, b] + inside for g, b, inside in sum(kind[::step], ()) if (g, b) in fields]
            row += struct.unpack_from("<3f", stream, at + offsets[0]) if offsets else [None] * 3
        if has_finite_values(row):
            yield tuple(row)


def _ascii_wrap(data: bytes, settings: Settings) -> bytes:
    body = data.replace(b"\n", b",")
    if data[:1] < b"\x40":
        body = (b"VNIMU," if data[:1] < b"\x20" else b"VNYMR,") + body[1:]
    if data[-1:] > b"\xd0":
        return b"$%b*%04X\r\n" % (body, compute_crc(body, 16, 0x1021, 0))
    return b"$%b*%02X\r\n" % (body, compute_xor(body))


def _ascii_readings(stream: bytes, settings: Settings) -> Iterator[Reading]:
    order = {b"VNIMU": (6, 7, 8, 3, 4, 5, 11), b"VNYMR": (9, 10, 11, 6, 7, 8, 12)}
    for at in find_offsets(stream, b"$VN"):
        line = stream[at + 1 :].partition(b"\n")[0].removesuffix(b"\r")
        body, star, stated = line.rpartition(b"*")
        if not star or stated not in (b"%02X" % compute_xor(body), b"%04X" % compute_crc(body, 16, 0x1021, 0)):
            continue
        name, *words = body.split(b",")
        if name not in order:
            continue
        *columns, width = order[name]
        try:
            numbers = [float(word) for word in words[:width]]
        except ValueError:
            continue
        if len(numbers) == width and has_finite_values([numbers[i] for i in columns]):
            yield tuple(numbers[i] for i in columns)


# --- Xsens


def _xsens_wrap(data: bytes, settings: Settings) -> bytes:
    n = len(data)
    body = b"\xff\x36" + (bytes([n]) if n < 255 else b"\xff" + n.to_bytes(2, "big")) + data
    return b"\xfa" + body + bytes([-sum(body) % 256])


def _xsens_readings(stream: bytes, settings: Settings) -> Iterator[Reading]:
    wanted = (0x8040, 0x4040) if settings.get("high_rate") else (0x8020, 0x4020)
    for at in find_offsets(stream, b"\xfa\xff\x36"):
        head = stream[at + 3 : at + 6]
        if len(head) < 3:
            continue
        start, n = (at + 6, head[1] << 8 | head[2]) if head[0] == 0xFF else (at + 4, head[0])
        payload = stream[start : start + n]
        if len(stream) <= start + n or sum(stream[at + 1 : start + n + 1]) % 256:
            continue
        items = _xsens_items(payload)
        if items is None:
            continue
        row: list[float | None] = []
        for kind in wanted:
            triples = [t for did, data in items if did & 0xFFF0 == kind and (t := _xsens_triple(did, data))]
            row += triples[0] if triples else [None] * 3
        if has_finite_values(row):
            yield tuple(row)


def _xsens_items(payload: bytes) -> list[tuple[int, bytes]] | None:
    items = []
    while len(payload) >= 3:
        n = payload[2]
        if len(payload) < 3 + n:
            return None
        items.append((payload[0] << 8 | payload[1], payload[3 : 3 + n]))
        payload = payload[3 + n :]
    return None if payload else items


def _xsens_triple(did: int, data: bytes) -> list[float] | None:
    kind = did & 3
    if len(data) != 3 * (4, 4, 6, 8)[kind]:
        return None
    if kind == 0:
        return list(struct.unpack(">3f", data))
    if kind == 1:
        return [x / 2**20 for x in struct.unpack(">3i", data)]
    if kind == 2:
        parts = struct.unpack(">IhIhIh", data)
        return [whole + fraction / 2**32 for fraction, whole in zip(parts[::2], parts[1::2], strict=True)]
    return list(struct.unpack(">3d", data))


# --- WitMotion


def _witmotion_wrap(data: bytes, settings: Settings) -> bytes:
    """Build a pair of packets, or one packet of another type."""
    if settings.get("packet") == "bluetooth":
        return b"\x55" + (b"\x71" if data[:1] > b"\xf0" else b"\x61") + data[1:19].ljust(18, b"\0")
    data = data.ljust(17, b"\0")
    kinds = (0x51, 0x52) if data[0] < 128 else (0x50 + data[0] % 16,)
    bodies = [bytes([0x55, kind]) + data[1 + 8 * i : 9 + 8 * i] for i, kind in enumerate(kinds)]
    return b"".join(body + bytes([sum(body) % 256]) for body in bodies)


def _witmotion_readings(stream: bytes, settings: Settings) -> Iterator[Reading]:
    gyro, accel = 2000 * DEGREE / 32768, 16 * G / 32768
    bluetooth = settings.get("packet") == "bluetooth"
    for at in find_offsets(stream, b"\x55\x61" if bluetooth else b"\x55\x51"):
        if bluetooth:
            if stream[at + 20 : at + 22] not in (b"\x55\x61", b"\x55\x71"):
                continue
            words = struct.unpack_from("<6h", stream, at + 2)
        else:
            first, second = stream[at : at + 11], stream[at + 11 : at + 22]
            is_valid = all(len(p) == 11 and sum(p[:10]) % 256 == p[10] for p in (first, second))
            if not is_valid or second[:2] != b"\x55\x52":
                continue
            words = struct.unpack_from("<3h", first, 2) + struct.unpack_from("<3h", second, 2)
        yield tuple([gyro * w for w in words[3:]] + [accel * w for w in words[:3]])


# --- text


def _text_wrap(data: bytes, settings: Settings) -> bytes:
    if not settings.get("nmea"):
        return data + b"\r\n"
    body = data.replace(b"\n", b",").replace(b"\r", b",").replace(b"$", b",").replace(b"*", b",")
    return b"$%b*%02X\r\n" % (body, compute_xor(body))


def _split_text(body: bytes) -> list[bytes]:
    return [word.strip() for word in body.replace(b";", b",").replace(b"\t", b",").split(b",")]


def _text_readings(stream: bytes, settings: Settings) -> Iterator[Reading]:
    """Return the readings of sentences with a checksum, in SI units."""
    axes = ("gx", "gy", "gz", "ax", "ay", "az")
    columns = settings["columns"]
    for line in stream.replace(b"\r", b"\n").split(b"\n"):
        body, star, stated = line.strip().rpartition(b"*")
        body = body.rpartition(b"$")[2]
        try:
            is_valid = star and len(stated) == 2 and int(stated, 16) == compute_xor(body)
            words = _split_text(body)
            if len(words) != len(columns):
                words = _split_text(re.sub(rb"[ \t]*:[ \t]*", b":", body))
            labelled = [word.rpartition(b":") for word in words]
            if any(colon and not re.search(rb"[A-Za-z]", label) for label, colon, _ in labelled):
                continue
            words = [word.strip() for _, _, word in labelled]
            numbers = dict(zip(columns, [float(word) if word else math.nan for word in words], strict=True))
        except ValueError:
            continue
        row = [None if math.isnan(numbers[axis]) else numbers[axis] for axis in axes]
        if is_valid and has_finite_values(row):
            yield tuple(row)


FORMATS: Final = {
    "mavlink": Format(_mavlink_wrap, _mavlink_readings),
    "stim300": Format(_stim300_wrap, _stim300_readings),
    "text": Format(_text_wrap, None),
    "text-nmea": Format(_text_wrap, _text_readings),
    "vectornav_ascii": Format(_ascii_wrap, _ascii_readings),
    "vectornav_binary": Format(_vectornav_wrap, _vectornav_readings),
    "witmotion": Format(_witmotion_wrap, _witmotion_readings),
    "xsens_mtdata2": Format(_xsens_wrap, _xsens_readings),
}


def is_subsequence(rows: list[Reading], known: Iterator[Reading]) -> bool:
    """Return True if the rows are a subsequence of the known readings."""
    return all(any(_equal(row, reading) for reading in known) for row in rows)


def _equal(first: Reading, second: Reading) -> bool:
    return all(
        (a is None) == (b is None) and (a is None or b is None or math.isclose(a, b, rel_tol=1e-9, abs_tol=1e-15))
        for a, b in zip(first, second, strict=True)
    )
