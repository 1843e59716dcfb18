"""Simple second implementation of further wire formats whose frames have a header, a length and a checksum.

See ``tests.experiments.fuzz.formats`` for the meaning of ``wrap`` and ``find_readings``.
"""

import struct
from collections.abc import Iterator
from typing import Final

from tests.experiments.fuzz.formats import (
    DEGREE,
    Format,
    G,
    Reading,
    Settings,
    compute_crc,
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


# --- BNO08x RVC


def _rvc_wrap(data: bytes, settings: Settings) -> bytes:
    body = data[:16].ljust(16, b"\0")
    return b"\xaa\xaa" + body + bytes([sum(body) % 256])


def _rvc_readings(stream: bytes, settings: Settings) -> Iterator[Reading]:
    for at in find_offsets(stream, b"\xaa\xaa"):
        frame = stream[at : at + 19]
        if len(frame) == 19 and sum(frame[2:18]) % 256 == frame[18]:
            yield (None, None, None, *(G * x / 1000 for x in struct.unpack_from("<3h", frame, 9)))


FRAMED_FORMATS: Final = {
    "aceinna_dmu": Format(_aceinna_wrap, _aceinna_readings),
    "bno08x_rvc": Format(_rvc_wrap, _rvc_readings),
}
