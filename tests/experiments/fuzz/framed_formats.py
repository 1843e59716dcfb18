"""Simple second implementation of further wire formats whose frames have a header, a length and a checksum.

See ``tests.experiments.fuzz.formats`` for the meaning of ``wrap`` and ``find_readings``.
"""

import struct
from collections.abc import Iterator
from typing import Final

from drivers.decoders.binary_frames.ublox_esf import CLASSES
from tests.experiments.fuzz.formats import (
    DEGREE,
    Format,
    G,
    Reading,
    Settings,
    compute_crc,
    compute_xor,
    find_offsets,
    has_finite_values,
)

# --- Aceinna

ACEINNA_SIZES: Final = {b"S0": 30, b"S1": 24, b"z1": 40, b"s1": 52}


def _aceinna_wrap(data: bytes, settings: Settings) -> bytes:
    """Build a packet of the configured type, of another type or of an unknown type."""
    code = settings.get("packet", "S1").encode()
    if data[:1] > b"\xe0":
        code = (b"S0", b"z1", b"pG")[data[0] % 3]
    size = ACEINNA_SIZES.get(code, len(data) % 200)
    body = code + bytes([size]) + data[1 : 1 + size].ljust(size, b"\0")
    return b"UU" + body + compute_crc(body, 16, 0x1021, 0x1D0F).to_bytes(2, "big")


def _aceinna_readings(stream: bytes, settings: Settings) -> Iterator[Reading]:
    code = settings.get("packet", "S1").encode()
    size = ACEINNA_SIZES[code]
    for at in find_offsets(stream, b"UU" + code + bytes([size])):
        payload, check = stream[at + 5 : at + 5 + size], stream[at + 5 + size : at + 7 + size]
        if compute_crc(stream[at + 2 : at + 5 + size], 16, 0x1021, 0x1D0F).to_bytes(2, "big") != check:
            continue
        if code in (b"S0", b"S1"):
            numbers = struct.unpack_from(">6h", payload)
            if not payload[-1] & 1 and not payload[-2] & 0x10:
                yield (*(DEGREE * 1260 / 65536 * x for x in numbers[3:]), *(G * 20 / 65536 * x for x in numbers[:3]))
            continue
        floats = struct.unpack_from("<6f", payload, 4 if code == b"z1" else 12)
        unit = G if settings.get("accel_unit") == "g" else 1.0
        if has_finite_values(list(floats)):
            yield (*(DEGREE * x for x in floats[3:]), *(unit * x for x in floats[:3]))


# --- BNO055


def _bno055_wrap(data: bytes, settings: Settings) -> bytes:
    """Build error answers, an answer with any measurements, or both."""
    errors = bytes([0xEE, 1 + data[0] % 12]) * (data[0] // 16) if data and data[0] > 0x80 else b""
    registers = bytearray(data[1:61].ljust(60, b"\0"))
    registers[:4], registers[7] = b"\xa0\xfb\x32\x0f", 0
    return errors if data[:1] > b"\xf0" else errors + b"\xbb\x3c" + registers


def _bno055_readings(stream: bytes, settings: Settings) -> Iterator[Reading]:
    for at in find_offsets(stream, b"\xbb\x3c\xa0\xfb\x32\x0f"):
        registers = stream[at + 2 : at + 62]
        if len(registers) < 60 or registers[7] or registers[0x39] == 1:
            continue
        accel, gyro = struct.unpack_from("<3h", registers, 8), struct.unpack_from("<3h", registers, 20)
        rate = 1 / 900 if registers[0x3B] & 2 else DEGREE / 16
        force = G / 1000 if registers[0x3B] & 1 else 0.01
        if any(accel + gyro):
            yield (*(rate * x for x in gyro), *(force * x for x in accel))


# --- BNO08x RVC


def _rvc_wrap(data: bytes, settings: Settings) -> bytes:
    body = data[:16].ljust(16, b"\0")
    return b"\xaa\xaa" + body + bytes([sum(body) % 256])


def _rvc_readings(stream: bytes, settings: Settings) -> Iterator[Reading]:
    for at in find_offsets(stream, b"\xaa\xaa"):
        frame = stream[at : at + 19]
        if len(frame) == 19 and sum(frame[2:18]) % 256 == frame[18]:
            yield (None, None, None, *(G * x / 1000 for x in struct.unpack_from("<3h", frame, 9)))


# --- Inertial Labs

INERTIAL_LABS_PAYLOADS: Final = {0x8F: (32, 0, 26), 0x81: (52, 12, 46)}  # size, offset of the rates and of the status


def _inertial_labs_wrap(data: bytes, settings: Settings) -> bytes:
    code = 0x82 if data[:1] > b"\xe0" else 0x8F if data[:1] < b"\x80" else 0x81
    size = INERTIAL_LABS_PAYLOADS.get(code, (len(data), 0, 0))[0]
    body = bytes([1, code]) + (size + 6).to_bytes(2, "little") + data[1 : 1 + size].ljust(size, b"\0")
    return b"\xaa\x55" + body + (sum(body) % 65536).to_bytes(2, "little")


def _inertial_labs_readings(stream: bytes, settings: Settings) -> Iterator[Reading]:
    for at in find_offsets(stream, b"\xaa\x55\1"):
        size, start, status_at = INERTIAL_LABS_PAYLOADS.get(stream[at + 3] if at + 3 < len(stream) else 0, (0, 0, 0))
        frame = stream[at : at + size + 8]
        if not size or len(frame) < size + 8 or int.from_bytes(frame[4:6], "little") != size + 6:
            continue
        if (sum(frame[2:-2]) % 65536).to_bytes(2, "little") != frame[-2:]:
            continue
        numbers = struct.unpack_from("<6i", frame, 6 + start)
        if not int.from_bytes(frame[6 + status_at : 8 + status_at], "little") & 0x1C2C:
            yield (*(DEGREE * x / 1e5 for x in numbers[:3]), *(G * x / 1e6 for x in numbers[3:]))


# --- Inertial Sense

INERTIAL_SENSE_SETS: Final = {"pimu": (3, 40, 16), "imu": (58, 36, 12), "imu_raw": (97, 36, 12)}
"""Number of each data set, size of its payload, and offset of the rates."""


def _inertial_sense_wrap(data: bytes, settings: Settings) -> bytes:
    """Build a packet with arbitrary values, often with a valid time and duration, or a packet of another type."""
    number, size, start = INERTIAL_SENSE_SETS[settings.get("data_set", "pimu")]
    head, payload = data[:1], data[1 : 1 + size].ljust(size, b"\0")
    if head < b"\xc0":
        payload = (
            struct.pack("<d", payload[0] * 100.0) + (b"\0\0\x80\x3b" if start == 16 else b"") + payload[start - 4 :]
        )
    flags = 4
    if head > b"\xe0":
        flags, number, payload = data[0] & 0x2F, data[0] % 100, data[1:]
    body = b"\xef\x49" + bytes([flags, number]) + len(payload).to_bytes(2, "little") + payload
    return body + _ublox_check(body)


def _inertial_sense_readings(stream: bytes, settings: Settings) -> Iterator[Reading]:
    number, size, start = INERTIAL_SENSE_SETS[settings.get("data_set", "pimu")]
    for at in find_offsets(stream, b"\xef\x49\4" + bytes([number, size, 0])):
        packet = stream[at : at + size + 8]
        if len(packet) < size + 8 or _ublox_check(packet[:-2]) != packet[-2:]:
            continue
        seconds, duration = struct.unpack_from("<df", packet, 6)
        status, *numbers = struct.unpack_from("<I6f", packet, 2 + start)
        scale = duration if start == 16 else 1.0
        is_saturated = status & 63 if status & 0x3F0000 else status >> 30
        is_valid = 0.0 <= seconds < 2**48 / 1e6 and 0.0 < scale < float("inf")
        if is_valid and not is_saturated and has_finite_values(numbers):
            yield tuple(x / scale for x in numbers)


# --- NovAtel


def _novatel_check(body: bytes) -> bytes:
    """Return the CRC-32, bit by bit."""
    register = 0
    for byte in body:
        register ^= byte
        for _ in range(8):
            register = register >> 1 ^ (0xEDB88320 if register & 1 else 0)
    return register.to_bytes(4, "little")


def _novatel_wrap(data: bytes, settings: Settings) -> bytes:
    """Build a log of a STIM300 with any values and often a valid time, or another log."""
    head, payload = data[:1], data[1:41].ljust(40, b"\0")
    if head < b"\xc0":
        payload = b"\0\x20" + payload[2:4] + struct.pack("<d", payload[4] * 2000.0) + payload[12:]
    if head < b"\x80":
        body = b"\xaa\x44\x13\x28" + struct.pack("<H", 1462) + bytes(6) + payload
    elif head < b"\xe0":
        body = b"\xaa\x44\x12\x1c" + struct.pack("<HHH", 1461, 0, 40) + bytes(18) + payload
    else:
        body = b"\xaa\x44\x13" + bytes([len(data[1:]) % 256]) + b"\1\2" + bytes(6) + data[1 : 1 + len(data[1:]) % 256]
    return body + _novatel_check(body)


def _novatel_readings(stream: bytes, settings: Settings) -> Iterator[Reading]:
    gyro, accel = DEGREE * 125 / 2**21, 125 / 2**22
    for at in find_offsets(stream, b"\xaa\x44"):
        head = 12 if stream[at + 2 : at + 4] == b"\x13\x28" else stream[at + 3] if at + 3 < len(stream) else 0
        is_long = stream[at + 2 : at + 3] == b"\x12" and head >= 28 and stream[at + 8 : at + 10] == b"\x28\0"
        frame = stream[at : at + head + 44]
        if not (is_long or stream[at + 2 : at + 4] == b"\x13\x28") or len(frame) < head + 44:
            continue
        if _novatel_check(frame[:-4]) != frame[-4:] or frame[4:6] not in (b"\xb6\5", b"\xb5\5"):
            continue
        info, kind, _, seconds, _, *numbers = struct.unpack("<BBHdI6i", frame[head:-4])
        if kind == 32 and not info & 3 and 0 <= seconds < 604800:
            az, ay, ax, gz, gy, gx = numbers
            yield (gyro * gx, -gyro * gy, gyro * gz, accel * ax, -accel * ay, accel * az)


# --- u-blox

UBLOX_AXES: Final = {14: 0, 13: 1, 5: 2, 16: 3, 17: 4, 18: 5}


def _ublox_check(body: bytes) -> bytes:
    a = b = 0
    for byte in body:
        a = (a + byte) % 256
        b = (b + a) % 256
    return bytes([a, b])


def _ublox_wrap(data: bytes, settings: Settings) -> bytes:
    """Build a message with any measurements, an NMEA sentence or another message."""
    is_meas = settings.get("message") == "esf-meas"
    head, data = data[:1], data[1:]
    if head > b"\xf0":
        return b"$%b*%02X\r\n" % (b"GNGGA,1,2", compute_xor(b"GNGGA,1,2"))
    if head > b"\xe0":
        code, payload = b"\x01\x07", data
    elif is_meas:
        code, payload = b"\x10\x02", data[: len(data) // 4 * 4].ljust(8, b"\0")
    else:
        code, payload = b"\x10\x03", bytes(4) + data[: len(data) // 8 * 8]
    body = code + len(payload).to_bytes(2, "little") + payload
    return b"\xb5\x62" + body + _ublox_check(body)


def _ublox_readings(stream: bytes, settings: Settings) -> Iterator[Reading]:
    """Return each complete set of axes whose tags are close to the tag of its first measurement."""
    is_meas = settings.get("message") == "esf-meas"
    modulus, window = (1 << 32, 5) if is_meas else (1 << 24, 0)
    partial: dict[int, float] = {}
    first = 0
    for tag, word in _ublox_measurements(stream, is_meas):
        axis = UBLOX_AXES.get(word >> 24 & 63)
        if axis is None:
            continue
        apart = abs(tag % modulus - first)
        if axis in partial or min(apart, modulus - apart) > window:
            partial = {}
        if not partial:
            first = tag % modulus
        number = word % (1 << 24)
        number -= (number >> 23) << 24
        partial[axis] = number * (DEGREE / 4096 if axis < 3 else 1 / 1024)
        if len(partial) == 6:
            yield tuple(partial[i] for i in range(6))
            partial = {}


def _ublox_measurements(stream: bytes, is_meas: bool) -> Iterator[tuple[int, int]]:
    """Yield the tags and words of all messages, without the messages inside of others."""
    end = 0
    for at in find_offsets(stream, b"\xb5\x62"):
        size = int.from_bytes(stream[at + 4 : at + 6], "little")
        frame = stream[at : at + 8 + size]
        if at < end or len(frame) < 8 + size or size > 4096 or _ublox_check(frame[2:-2]) != frame[-2:]:
            continue
        payload = frame[6:-2]
        if frame[2:4] == b"\x10\x03" and size % 8 == 4:
            end = at + len(frame)
            words = struct.unpack(f"<{size // 4}I", payload)
            yield from () if is_meas else zip(words[2::2], words[1::2], strict=True)
        elif frame[2:4] == b"\x10\x02" and size % 4 == 0 and size >= 8:
            end = at + len(frame)
            words = struct.unpack(f"<{size // 4}I", payload)
            measured = words[2:-1] if payload[4] & 8 else words[2:]
            yield from ((words[0], word) for word in measured) if is_meas else ()
        elif frame[2:4] not in (b"\x10\x03", b"\x10\x02") and frame[2] in CLASSES:
            end = at + len(frame)


FRAMED_FORMATS: Final = {
    "aceinna_dmu": Format(_aceinna_wrap, _aceinna_readings),
    "bno055": Format(_bno055_wrap, _bno055_readings),
    "bno08x_rvc": Format(_rvc_wrap, _rvc_readings),
    "inertial_labs": Format(_inertial_labs_wrap, _inertial_labs_readings),
    "inertial_sense": Format(_inertial_sense_wrap, _inertial_sense_readings),
    "novatel_rawimusx": Format(_novatel_wrap, _novatel_readings),
    "ublox_esf": Format(_ublox_wrap, _ublox_readings),
}
