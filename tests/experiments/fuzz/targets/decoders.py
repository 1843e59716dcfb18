"""Fuzz targets of every decoder, followed by ``SampleClock``.

The input of a stream decoder consists of raw bytes, frames with a valid checksum around any payload, damaged frames,
truncated frames and repetitions. The samples must not depend on how the stream is divided into chunks, and
``tests.experiments.fuzz.formats`` must find each sample. The samples of frames and messages must not depend on whether
the decoder receives them one by one or all at once.
"""

import struct
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import msgspec
import numpy as np

from drivers import decoders
from drivers.data_types import AXES, EXTENDED_ID, NO_TICK, Chunk, CounterTimedFormat, SampleBlock, make_block
from drivers.decoders.base import Decoder
from drivers.decoders.dbc import DbcDecoder
from drivers.decoders.dbc import Settings as DbcSettings
from drivers.decoders.dbc.database import ConfiguredDbcMessages
from drivers.decoders.messages.iio import AXIS_CHANNELS
from drivers.decoders.text_lines.text import Settings as TextSettings
from drivers.validation import module_lookup
from drivers.zenoh.sample_message import COLUMNS, SCHEMA, SCHEMAS
from tests.contracts.decoder_examples import CAN_DATABASE, CAN_SIGNALS, DECODER_NAMES, EXAMPLES, Example
from tests.experiments.fuzz.binary_formats import BINARY_FORMATS
from tests.experiments.fuzz.checked_clock import CheckedClock
from tests.experiments.fuzz.checks import feed_and_check, summarize_blocks
from tests.experiments.fuzz.formats import FORMATS as BASIC_FORMATS
from tests.experiments.fuzz.formats import is_subsequence
from tests.experiments.fuzz.framed_formats import FRAMED_FORMATS
from tests.experiments.fuzz.input_reader import InputReader, encode_pieces
from tests.experiments.fuzz.target import Check, target
from tests.support.settings import read_settings

FORMATS: Final = BASIC_FORMATS | BINARY_FORMATS | FRAMED_FORMATS
MAX_STREAM_BYTES: Final = 3000
"""Limit of the length of a stream in bytes, including repetitions."""
MAX_CALLS: Final = 4
MAX_TIMED_BLOCKS: Final = 6
"""Limit of the blocks that are passed to the clock, which has a separate target."""
START_NS: Final = 1_000_000_000
RATES_HZ: Final = (None, 100.0, 1000.0, 12.5)
EXTRA_EXAMPLES: Final = (
    Example("vectornav_binary", {"compensated": True}),
    Example("witmotion", {"packet": "bluetooth"}),
    Example("text", {"columns": ("gx", "-", "az"), "header": 1, "first_line": "keep", "delimiter": " "}),
)
"""Examples with settings that ``decoder_examples`` does not contain."""


def build_samples(data: bytes, decoder: Decoder) -> SampleBlock:
    """Build a few samples with small values from any bytes."""
    n = 1 + min(len(data) // 8, 7)
    table = np.frombuffer(data.ljust(8 * n, b"\0")[: 8 * n], np.int8).reshape(n, 8) / 16.0
    ticks = np.full(n, NO_TICK, np.int64)
    if isinstance(decoder.timing, CounterTimedFormat):
        ticks = (np.arange(n, dtype=np.int64) * 4 + (data[0] if data else 0)) % decoder.timing.modulus
    return make_block(START_NS + np.arange(n, dtype=np.int64) * 10**7, table[:, :6].copy(), 20.0 + table[:, 6], ticks)


# --- streams


@cache
def _settings(name: str, i: int) -> Any:
    example = _examples(name)[i]
    module = _import_decoder(name)
    return module.build, read_settings(module.Settings, dict(example.settings))


@cache
def _examples(name: str) -> tuple[Example, ...]:
    return tuple(e for e in (*EXAMPLES, *EXTRA_EXAMPLES) if e.name == name)


def _build_stream(reader: InputReader, wrap: Callable[[bytes], bytes], decoder: Decoder) -> bytes:
    out, last = b"", b""
    while reader and len(out) < MAX_STREAM_BYTES:
        kind, data = reader.read_byte() % 8, reader.read_piece()
        if kind == 1:
            last = wrap(data)
            out += last
        elif kind == 2:
            damaged = bytearray(wrap(data[1:]))
            damaged[data[0] % len(damaged) if data else 0] ^= 1 << len(data) % 8
            out += damaged
        elif kind == 3:
            out += wrap(data[1:])[: data[0] if data else 0]
        elif kind == 4:
            out += last * min(data[0] % 64 if data else 1, MAX_STREAM_BYTES // max(len(last), 1))
        elif kind == 5:
            out += b"".join(chunk.data for chunk in decoder.encode(build_samples(data, decoder)))
        else:
            out += data
    return out


def make_stream_check(name: str) -> Check:
    """Return the check of one stream decoder."""

    def check(data: bytes) -> None:
        reader = InputReader(data)
        i = reader.read_byte() % len(_examples(name))
        settings = _examples(name)[i].settings
        form = FORMATS["text-nmea" if settings.get("nmea") else name]
        step, rate, pace = 1 + reader.read_byte(), reader.choose(RATES_HZ), reader.read_byte()
        build, keys = _settings(name, i)
        wire = _build_stream(reader, lambda part: form.wrap(part, settings), build(keys))
        one, other = build(keys), build(keys)
        whole = feed_and_check(one, [[Chunk(wire, START_NS)]])
        step = max(step, len(wire) // MAX_CALLS)
        clock = CheckedClock(other.timing, rate)
        starts = range(0, len(wire), step)
        calls = [[Chunk(wire[at : at + step], START_NS + at * 1000 * (pace + 1))] for at in starts]
        parts = feed_and_check(other, calls)
        for each in parts[:MAX_TIMED_BLOCKS]:
            clock.assign_times(each)
        assert summarize_blocks(whole) == summarize_blocks(parts), "the samples depend on how the bytes are divided"
        assert one.bad == other.bad, "the number of bad frames depends on how the bytes are divided"
        if form.find_readings is not None:
            assert is_subsequence(summarize_blocks(whole)[0], form.find_readings(wire, settings)), (
                "a sample that no valid frame contains"
            )

    return check


def make_wire_check(name: str) -> Check:
    """Return the check of one stream decoder with raw bytes.

    The bytes are divided differently only if the decoder returns a sample.
    """

    def check(data: bytes) -> None:
        i = data[0] % len(_examples(name)) if data else 0
        settings = _examples(name)[i].settings
        form = FORMATS["text-nmea" if settings.get("nmea") else name]
        build, keys = _settings(name, i)
        one, wire = build(keys), data[1:]
        whole = feed_and_check(one, [[Chunk(wire, START_NS)]])
        if not whole:
            return
        if form.find_readings is not None:
            assert is_subsequence(summarize_blocks(whole)[0], form.find_readings(wire, settings)), (
                "a sample that no valid frame contains"
            )
        other, half = build(keys), len(wire) // 2
        parts = feed_and_check(other, [[Chunk(wire[:half], START_NS)], [Chunk(wire[half:], START_NS)]])
        assert summarize_blocks(whole) == summarize_blocks(parts), "the samples depend on how the bytes are divided"

    return check


def wire_seeds(name: str) -> Iterator[bytes]:
    """Return the bytes that a device would send."""
    rng = np.random.default_rng(5)
    for i in range(len(_examples(name))):
        build, keys = _settings(name, i)
        for n in (8, 24):
            yield bytes([i]) + b"".join(
                chunk.data for chunk in build(keys).encode(build_samples(rng.bytes(n), build(keys)))
            )


def stream_seeds(name: str) -> Iterator[bytes]:
    """Return encoded samples as raw bytes, samples to be encoded, and frames around payloads."""
    rng = np.random.default_rng(1)
    for i, example in enumerate(_examples(name)):
        build, keys = _settings(name, i)
        encoded = b"".join(chunk.data for chunk in build(keys).encode(build_samples(rng.bytes(24), build(keys))))
        head = bytes([i, 40, 1, 200])
        yield head + encode_pieces(encoded, b"\0")
        yield head + b"\5\x18" + rng.bytes(24) + b"\0\x09rubbish\r\n" + b"\5\x18" + rng.bytes(24)
        yield head + b"\1\x20" + rng.bytes(32) + b"\4\1\7" + b"\2\x20" + rng.bytes(32) + b"\3\x20" + rng.bytes(32)
        inner = encoded[CONTENT.get(name, slice(None))]
        if example.name in ("text", "vectornav_ascii"):
            inner = inner.strip().strip(b"$").partition(b"\r")[0].rpartition(b"*")[0] or inner
        yield head + b"".join(b"\1" + bytes([len(part)]) + part for part in [inner[:190]] * 4)


CONTENT: Final = {
    "epson_uart": slice(1, -3),
    "microstrain_mip": slice(4, -2),
    "sbg_ecom": slice(6, -3),
    "silicon_sensing_dmu": slice(2, -2),
    "stim300": slice(0, -4),
    "vectornav_binary": slice(1, -2),
    "xsens_mtdata2": slice(4, -1),
}
"""Part of an encoded frame that ``Format.wrap`` takes."""

WORDS: Final = {
    "epson_uart": (b"\x80", b"\x0d", b"\xfe\0", b"\xfe\1"),
    "mavlink": (b"\xfd\x3d\0\0", b"\xfe\x3e", b"\x69\0\0", b"\x1a\0\0", b"\xc0\x7f", b"\x7f\x80"),
    "microstrain_mip": (b"\x75\x65\x80", b"\x0e\4", b"\x0e\5", b"\x0e\7", b"\x0e\x08", b"\x0a\xd6", b"\4\x18"),
    "sbg_ecom": (b"\xff\x5a\x2c\0\x20\0", b"\xff\x5a\3\0\x3a\0", b"\xff\5", b"\xff\3", b"\x33", b"\0\0\xc0\x7f"),
    "silicon_sensing_dmu": (b"\x55\xaa", b"\x7f\xc0\0\0", b"\xff\x80\0\0"),
    "aceinna_dmu": (b"UUS0\x1e", b"UUS1\x18", b"UUz1\x28", b"UUs1\x34", b"\0\0\xc0\x7f"),
    "text": ("gx:", "az :", "nan", "-inf", "1e308", "1_0", "#", "$", "*", ",", ";", "\r\n", "4611686018427387904"),
    "bno055": (b"\xbb\x3c\xa0\xfb\x32\x0f", b"\xee\7", b"\xee\1", b"\6\0\x80"),
    "inertial_sense": (b"\xef\x49\4\3\x28\0", b"\xef\x49\4\x3a\x24\0", b"\0\0\x80\x3b", b"\0\0\xc0\x7f"),
    "inertial_labs": (b"\xaa\x55\1\x8f\x26\0", b"\xaa\x55\1\x81\x3a\0"),
    "novatel_rawimusx": (b"\xaa\x44\x13\x28\xb6\5", b"\xaa\x44\x12\x1c\xb5\5", b"\0\x20"),
    "ublox_esf": (b"\xb5b\x10\3", b"\xb5b\x10\2", b"\0\0\0\x0e", b"\0\0\0\x0c", b"$GNGGA,", b"*47\r\n"),
    "vectornav_ascii": ("$VNIMU,", "$VNYMR,", "nan", "inf", "*XX", "\r\n", "1e999"),
    "xsens_mtdata2": (b"\xfa\xff\x36", b"\x40\x20\x0c", b"\x80\x20\x0c", b"\x10\x60\x04", b"\x08\x10\x04", b"\x7f\xc0"),
    "vectornav_binary": (b"\xfa\1\1\2", b"\xfa\1\1\6", b"\x7f\xc0\0\0", b"\0\0\xc0\x7f"),
    "witmotion": (b"\x55\x51", b"\x55\x52", b"\x55\x61", b"\x55\x71"),
    "stim300": (b"\x90", b"\x91", b"\xa5", b"\x93", b"\xaf"),
}  # fmt: skip

# --- frames

SECOND_DATABASE: Final = """VERSION ""
BS_:
BU_: IMU
BO_ 100 Rates: 8 IMU
 SG_ x : 0|12@1- (0.01,0) [-20|20] "rad/s" IMU
 SG_ y : 12|12@1- (0.01,0) [-20|20] "rad/s" IMU
 SG_ z : 31|17@0+ (0.001,-65) [-65|65] "deg/s" IMU
 SG_ cnt : 56|4@1+ (1,0) [0|15] "" IMU
 SG_ ok : 60|2@1+ (1,0) [0|3] "" IMU
BO_ 2566844672 Forces: 8 IMU
 SG_ x : 0|32@1- (1,0) [0|0] "m/s^2" IMU
 SG_ y : 39|20@0- (0.0001,0) [0|0] "g" IMU
 SG_ cnt : 56|4@1+ (1,0) [0|15] "" IMU
BO_ 101 Warm: 2 IMU
 SG_ temp : 0|16@1+ (0.01,-273.15) [0|0] "degC" IMU
SIG_VALTYPE_ 2566844672 x : 1;
"""
SECOND_SIGNALS: Final = {"gx": "Rates.x", "gy": "-Rates.y", "gz": "Rates.z", "ax": "Forces.x", "ay": "Forces.y"}
J1939_SIGNALS: Final = {
    "gx": "AngularRateInformation.RollRate",
    "gz": "AngularRateInformation.YawRate",
    "ax": "AccelerationSensor.LongitudinalAcceleration",
    "az": "AccelerationSensor.VerticalAcceleration",
}
CANOPEN_SIGNALS: Final = {
    **{f"g{axis}": f"Tpdo2.Rate{axis.upper()}" for axis in "xyz"},
    **{f"a{axis}": f"Tpdo1.Acceleration{axis.upper()}" for axis in "xyz"},
    "temperature": "Tpdo1.Temperature",
}
OXTS_SIGNALS: Final = {
    **{f"g{axis}": f"RateVehicle.AngRate{axis.upper()}" for axis in "xyz"},
    **{f"a{axis}": f"AccelVehicle.Accel{axis.upper()}" for axis in "xyz"},
}
CAN: Final = (
    ("first", {"signals": CAN_SIGNALS}),
    ("second", {"signals": {**SECOND_SIGNALS, "temperature": "Warm.temp"}, "valid": "Rates.ok", "window": 0.005}),
    ("second", {"signals": SECOND_SIGNALS, "join": "counter", "counter": "cnt"}),
    ("second", {"signals": SECOND_SIGNALS, "counter": "Rates.cnt", "partial": True, "not_available": True}),
    ("j1939_imu", {"signals": J1939_SIGNALS}),
    ("j1939_imu", {"signals": J1939_SIGNALS, "source": 3, "tick": None, "partial": True}),
    ("sick_tmm61", {"signals": CANOPEN_SIGNALS, "window": 0.005}),
    ("dis_qg65d", {"signals": CANOPEN_SIGNALS, "partial": True}),
    ("oxts_rt", {"signals": OXTS_SIGNALS}),
)


@cache
def _can(i: int) -> tuple[Any, DbcSettings, Any]:
    file, keys = CAN[i]
    text = {"first": CAN_DATABASE, "second": SECOND_DATABASE}.get(file)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.dbc"
        path.write_text(text or "")
        settings = read_settings(DbcSettings, {"file": str(path) if text else file, **keys})
        database = ConfiguredDbcMessages(settings)
        return database.messages_with_configured_signals, settings, database.timing


def _can_decoder(i: int) -> DbcDecoder:
    messages, settings, timing = _can(i)
    return DbcDecoder(messages, settings, timing)


def _build_frames(reader: InputReader, decoder: DbcDecoder) -> list[Chunk]:
    """Return frames with addresses of the decoder and with other addresses."""
    addresses = [address & ~(1 << 30) for address in decoder.accepted_addresses]
    t_ns = START_NS
    chunks = []
    while reader and len(chunks) < 40:
        kind, data = reader.read_byte(), reader.read_piece()[:64]
        t_ns += (kind >> 4) * 1_000_000
        if kind % 4 == 3:
            samples = build_samples(data, decoder)
            chunks += [replace(chunk, t_ns=t_ns) for chunk in decoder.encode(samples)]
            continue
        address = addresses[kind // 4 % len(addresses)]
        if kind % 4 == 1:
            address = address & ~0xFF | data[0] if data else address ^ EXTENDED_ID
        elif kind % 4 == 2:
            data = data[:8].ljust(8, b"\0")
        chunks.append(Chunk(data, t_ns, address))
    return chunks


def _check_independence_of_chunks(
    build: Callable[[], Decoder], chunks: list[Chunk], rate_hz: float | None
) -> tuple[list[SampleBlock], Decoder]:
    """Return the samples of all chunks at once, and check that they equal the samples of single chunks."""
    one, other = build(), build()
    clock = CheckedClock(other.timing, rate_hz)
    parts = feed_and_check(other, [[chunk] for chunk in chunks])
    for each in parts[:MAX_TIMED_BLOCKS]:
        clock.assign_times(each)
    whole = feed_and_check(one, [chunks])
    assert summarize_blocks(whole) == summarize_blocks(parts), "single chunks give other samples"
    assert one.bad == other.bad, "single chunks give another number of bad frames"
    return whole, one


def _can_seeds() -> Iterator[bytes]:
    rng = np.random.default_rng(2)
    for i in range(len(CAN)):
        yield bytes([i, 1]) + b"".join(bytes([3 + 16 * k, 16]) + rng.bytes(16) for k in range(4))
        yield bytes([i, 0]) + b"".join(bytes([2 + 4 * k, 8]) + rng.bytes(8) for k in range(12))


def check_dbc(data: bytes) -> None:
    """Check frames that are decoded with a CAN database."""
    reader = InputReader(data)
    i, rate = reader.read_byte() % len(CAN), reader.choose(RATES_HZ)
    _check_independence_of_chunks(lambda: _can_decoder(i), _build_frames(reader, _can_decoder(i)), rate)


# --- messages


@cache
def _import_decoder(name: str) -> ModuleType:
    return module_lookup.import_module(decoders, name)


def _build_decoder(name: str) -> Decoder:
    module = _import_decoder(name)
    decoder: Decoder = module.build(module.Settings())
    return decoder


def check_ros2_routers(data: bytes) -> None:
    """Check that the values and the time of each sample are those of a CDR message."""
    reader = InputReader(data)
    rate = reader.choose(RATES_HZ)
    chunks = []
    while reader and len(chunks) < 20:
        kind, payload, attachment = reader.read_byte(), reader.read_piece(), reader.read_piece()
        if kind % 2:
            attachment = attachment.ljust(33 if kind % 4 == 1 else 77, b"\0")[: 33 if kind % 4 == 1 else 77]
        chunks.append(Chunk(payload, 5, attachment=attachment))
    whole, _ = _check_independence_of_chunks(lambda: _build_decoder("ros2_imu"), chunks, rate)
    known = iter([reading for chunk in chunks if (reading := _ros2_reading(chunk.data)) is not None])
    for one in whole:
        for t_ns, row in zip(one.t_ns.tolist(), one.values.tolist(), strict=True):
            assert any(t_ns == t and _rows_equal(row, values) for t, values in known), (
                "a sample that no message contains"
            )


def _rows_equal(row: list[float], values: list[float]) -> bool:
    return all(a != a or a == b for a, b in zip(row, values, strict=True))


def _ros2_reading(data: bytes) -> tuple[int, list[float]] | None:
    end = {b"\0\0": ">", b"\0\1": "<"}.get(data[:2])
    if end is None or len(data) < 16:
        return None
    sec, nanosec, n = struct.unpack_from(f"{end}iII", data, 4)
    body = data[4 + (12 + n + 7) // 8 * 8 :]
    if len(body) < 296:
        return None
    numbers = struct.unpack_from(f"{end}37d", body)
    return sec * 10**9 + nanosec, [*numbers[13:16], *numbers[25:28]]


def _ros2_seeds() -> Iterator[bytes]:
    rng = np.random.default_rng(3)
    for _ in range(3):
        decoder = _build_decoder("ros2_imu")
        chunks = decoder.encode(build_samples(rng.bytes(24), decoder))
        yield b"\1" + b"".join(
            b"\1" + bytes([203]) + chunk.data.ljust(392, b"\0") + bytes([33]) + chunk.attachment for chunk in chunks
        )
        yield b"\1" + b"".join(b"\0" + bytes([202]) + chunk.data.ljust(328, b"\0") + b"\0" for chunk in chunks)


def check_iio(data: bytes) -> None:
    """Check scans with valid and invalid layouts."""
    reader = InputReader(data)
    rate = reader.choose(RATES_HZ)
    chunks = []
    while reader and len(chunks) < 20:
        kinds = (
            "le:s16/16>>0",
            "be:s32/32>>0",
            "le:u12/16>>4",
            "be:s8/8X3>>0",
            "le:s16/16>>1",
            reader.read_piece()[:9],
        )
        elements = [
            {
                "channel": reader.choose((*AXIS_CHANNELS, "in_temp", "in_other")),
                "type": str(reader.choose(kinds)),
                "scale": reader.choose((1, -1e-3, 1e15, 1e300)),
                "offset": reader.choose((0, 1e15, -5)),
            }
            for _ in range(reader.read_byte() % 9)
        ]
        elements += [{"channel": "in_timestamp", "type": "le:s64/64>>0"}] * (reader.read_byte() % 2)
        layout = {"clock": "realtime", "elements": elements}
        attachment = msgspec.json.encode(layout) if reader.read_byte() % 4 else reader.read_piece()
        chunks.append(Chunk(reader.read_piece().ljust(8 * (reader.read_byte() % 9), b"\1"), 5, attachment=attachment))
    _check_independence_of_chunks(lambda: _build_decoder("iio"), chunks, rate)


def _iio_seeds() -> Iterator[bytes]:
    rng = np.random.default_rng(5)
    for n in (100, 400, 1000):
        yield rng.bytes(n)


def check_samples(data: bytes) -> None:
    """Check messages of other monitors, as raw bytes or built from fields."""
    reader = InputReader(data)
    rate = reader.choose(RATES_HZ)
    chunks = []
    while reader and len(chunks) < 20:
        chunks.append(Chunk(reader.read_piece() if reader.read_byte() % 2 else build_message(reader), 5))
    _check_independence_of_chunks(lambda: _build_decoder("samples"), chunks, rate)


def build_message(reader: InputReader) -> bytes:
    """Build a map with valid keys and often valid sizes."""
    kind = reader.read_byte()
    axes = [reader.choose((*COLUMNS, *AXES, "other")) for _ in range(1 + kind % 7)]
    rows = reader.read_byte() % 32
    numbers = [
        reader.read_byte() / 8.0 if kind & 8 else reader.read_special_float() for _ in range(rows * len(axes) % 50)
    ]
    payload: dict[str, Any] = {
        "schema": reader.choose((SCHEMA, *SCHEMAS, "other")),
        "axes": list(dict.fromkeys(axes)) if kind & 16 else axes,
        "samples": reader.choose((0, 1, rows, 1 << 53, reader.read_int64())),
    }
    width = len(payload["axes"])
    rows = len(numbers) // width
    payload["data"] = np.array(numbers[: rows * width]).tobytes()
    if kind & 32:
        payload["t"] = np.array([reader.read_special_float() for _ in range(rows)]).tobytes()
    else:
        payload |= {
            "t": reader.read_special_float(),
            "t0": reader.read_special_float(),
            "rate": reader.read_special_float(),
        }
    if kind & 64:
        payload["lost"] = reader.choose((0, 1, 1000, 1 << 40, 1 << 53, reader.read_int64()))
    return msgspec.msgpack.encode(payload)


def _samples_seeds() -> Iterator[bytes]:
    rng = np.random.default_rng(4)
    for _ in range(3):
        decoder = _build_decoder("samples")
        encoded = decoder.encode(build_samples(rng.bytes(24), decoder))[0].data
        n = 200 + -(-(len(encoded) - 200) // 64) if len(encoded) >= 200 else len(encoded)
        yield b"\1" + (b"\1" + bytes([n]) + encoded) * 2
        yield b"\1" + rng.bytes(400)


def make_message_check(name: str) -> Check:
    """Return the check of one message decoder with one raw message."""

    def check(data: bytes) -> None:
        feed_and_check(_build_decoder(name), [[Chunk(data, 5)]])

    return check


def _message_seeds(name: str) -> Iterator[bytes]:
    rng = np.random.default_rng(6)
    for n in (8, 24):
        yield from (
            chunk.data for chunk in _build_decoder(name).encode(build_samples(rng.bytes(n), _build_decoder(name)))
        )


def wire_dbc(data: bytes) -> None:
    """Check frames of eight bytes. A byte before each frame selects its address."""
    decoder = _can_decoder(data[0] % len(CAN) if data else 0)
    addresses = [address & ~(1 << 30) for address in decoder.accepted_addresses]
    cut = [data[at : at + 9] for at in range(1, min(len(data), 100), 9)]
    feed_and_check(decoder, [[Chunk(part[1:], START_NS, addresses[part[0] % len(addresses)]) for part in cut]])


PATTERN: Final = "(?P<t>[0-9]+)[ ,](?:g=)?(?P<gx>[^ ,]*)[ ,](?:a=)?(?P<az>.*)( T(?P<temperature>.*))?"


@cache
def _pattern_settings() -> TextSettings:
    return read_settings(TextSettings, {"pattern": PATTERN, "time_unit": "ms"})


def wire_text_pattern(data: bytes) -> None:
    """Check lines that are decoded with a regular expression, as a whole and in two halves."""
    build, keys, half = _import_decoder("text").build, _pattern_settings(), len(data) // 2
    one, other = build(keys), build(keys)
    whole = feed_and_check(one, [[Chunk(data, START_NS)]])
    parts = feed_and_check(other, [[Chunk(data[:half], START_NS)], [Chunk(data[half:], START_NS)]])
    assert summarize_blocks(whole) == summarize_blocks(parts), "the samples depend on how the bytes are divided"
    assert one.bad == other.bad, "the number of bad lines depends on how the bytes are divided"


target("wire-text-pattern", (b"\n1 g=0.5 a=-9.8 T20\r\n2,,nan\n3 1 2\nx\n",), 250, WORDS["text"])(wire_text_pattern)
target("wire-dbc", lambda: [bytes([i, *range(100)]) for i in range(len(CAN))], 100)(wire_dbc)
for _name in ("iio", "ros2_imu", "samples"):
    target(f"wire-{_name}", partial(_message_seeds, _name), 512)(make_message_check(_name))

NON_STREAM_TARGETS: Final = {
    "dbc": (check_dbc, _can_seeds),
    "iio": (check_iio, _iio_seeds),
    "ros2_imu": (check_ros2_routers, _ros2_seeds),
    "samples": (check_samples, _samples_seeds),
}
for _name in DECODER_NAMES:
    if _name in NON_STREAM_TARGETS:
        target(f"decoder-{_name}", NON_STREAM_TARGETS[_name][1], 1024)(NON_STREAM_TARGETS[_name][0])
    else:
        target(f"decoder-{_name}", partial(stream_seeds, _name), 400, WORDS.get(_name, ()))(make_stream_check(_name))
        target(f"wire-{_name}", partial(wire_seeds, _name), 250, WORDS.get(_name, ()))(make_wire_check(_name))
