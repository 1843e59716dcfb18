"""Every decoder of the folder, with the ``SampleClock`` behind it.

Streams: a programme of raw bytes, frames with a check that holds around any payload, damaged and cut ones, repeats.
What comes out must be the same for two cuts of the stream, and each sample one that
``tests.experiments.fuzz.formats`` finds.
Frames and messages: one by one or all at once must make no difference.
"""

import importlib
import struct
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np

from drivers.data_types import AXES, EXTENDED_ID, NO_TICK, Chunk, CounterTimedFormat, SampleBlock, make_block
from drivers.decoders.base import Decoder
from drivers.decoders.dbc import DbcDecoder
from drivers.decoders.dbc import Settings as DbcSettings
from drivers.decoders.dbc.database import ConfiguredDbcMessages
from drivers.zenoh.sample_message import COLUMNS, SCHEMA, SCHEMAS
from tests.contracts.decoder_examples import CAN_DATABASE, CAN_SIGNALS, DECODER_NAMES, EXAMPLES, Example
from tests.experiments.fuzz.checks import fed, seen
from tests.experiments.fuzz.formats import FORMATS, some_of
from tests.experiments.fuzz.stamped import Stamped
from tests.experiments.fuzz.tape import Tape, pieces_of
from tests.experiments.fuzz.target import Check, target
from tests.support.settings import read_settings

LONGEST: Final = 3000
"""Bytes of a stream; repeats would make it longer."""
CALLS: Final = 4
STAMPED: Final = 6
"""Blocks that go on to the clock; it has a target of its own."""
START_NS: Final = 1_000_000_000
RATES_HZ: Final = (None, 100.0, 1000.0, 12.5)
MORE: Final = (
    Example("vectornav_binary", {"compensated": True}),
    Example("witmotion", {"packet": "bluetooth"}),
    Example("text", {"columns": ("gx", "-", "az"), "header": 1, "first_line": "keep", "delimiter": " "}),
)
"""Settings that the contract's examples leave out."""


def samples_of(data: bytes, decoder: Decoder) -> SampleBlock:
    """A few samples of small values, out of any bytes."""
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
    module = importlib.import_module(f"drivers.decoders.{name}")
    return module.build, read_settings(module.Settings, dict(example.settings))


@cache
def _examples(name: str) -> tuple[Example, ...]:
    return tuple(e for e in (*EXAMPLES, *MORE) if e.name == name)


def _stream(tape: Tape, wrap: Callable[[bytes], bytes], decoder: Decoder) -> bytes:
    out, last = b"", b""
    while tape and len(out) < LONGEST:
        kind, data = tape.byte() % 8, tape.piece()
        if kind == 1:
            last = wrap(data)
            out += last
        elif kind == 2:
            hurt = bytearray(wrap(data[1:]))
            hurt[data[0] % len(hurt) if data else 0] ^= 1 << len(data) % 8
            out += hurt
        elif kind == 3:
            out += wrap(data[1:])[: data[0] if data else 0]
        elif kind == 4:
            out += last * min(data[0] % 64 if data else 1, LONGEST // max(len(last), 1))
        elif kind == 5:
            out += b"".join(chunk.data for chunk in decoder.encode(samples_of(data, decoder)))
        else:
            out += data
    return out


def stream_check(name: str) -> Check:
    """The target of one stream decoder."""

    def check(data: bytes) -> None:
        tape = Tape(data)
        i = tape.byte() % len(_examples(name))
        settings = _examples(name)[i].settings
        form = FORMATS["text-nmea" if settings.get("nmea") else name]
        step, rate, pace = 1 + tape.byte(), tape.choice(RATES_HZ), tape.byte()
        build, keys = _settings(name, i)
        wire = _stream(tape, lambda part: form.wrap(part, settings), build(keys))
        one, other = build(keys), build(keys)
        whole = fed(one, [[Chunk(wire, START_NS)]])
        step = max(step, len(wire) // CALLS)
        clock = Stamped(other.timing, rate)
        starts = range(0, len(wire), step)
        calls = [[Chunk(wire[at : at + step], START_NS + at * 1000 * (pace + 1))] for at in starts]
        parts = fed(other, calls)
        for each in parts[:STAMPED]:
            clock.put(each)
        assert seen(whole) == seen(parts), "another cut gives other samples"
        assert one.bad == other.bad, "another cut counts other bad frames"
        if form.readings is not None:
            assert some_of(seen(whole)[0], form.readings(wire, settings)), "a sample that no valid frame holds"

    return check


def wire_check(name: str) -> Check:
    """The target of one stream decoder, raw: no programme, and two cuts only where a sample comes out."""

    def check(data: bytes) -> None:
        i = data[0] % len(_examples(name)) if data else 0
        settings = _examples(name)[i].settings
        form = FORMATS["text-nmea" if settings.get("nmea") else name]
        build, keys = _settings(name, i)
        one, wire = build(keys), data[1:]
        whole = fed(one, [[Chunk(wire, START_NS)]])
        if not whole:
            return
        if form.readings is not None:
            assert some_of(seen(whole)[0], form.readings(wire, settings)), "a sample that no valid frame holds"
        other, half = build(keys), len(wire) // 2
        parts = fed(other, [[Chunk(wire[:half], START_NS)], [Chunk(wire[half:], START_NS)]])
        assert seen(whole) == seen(parts), "another cut gives other samples"

    return check


def wire_seeds(name: str) -> Iterator[bytes]:
    """What a device would send."""
    rng = np.random.default_rng(5)
    for i in range(len(_examples(name))):
        build, keys = _settings(name, i)
        for n in (8, 24):
            yield bytes([i]) + b"".join(
                chunk.data for chunk in build(keys).encode(samples_of(rng.bytes(n), build(keys)))
            )


def stream_seeds(name: str) -> Iterator[bytes]:
    """Encoded samples, as raw bytes and as orders to encode; frames of payloads."""
    rng = np.random.default_rng(1)
    for i, example in enumerate(_examples(name)):
        build, keys = _settings(name, i)
        made = b"".join(chunk.data for chunk in build(keys).encode(samples_of(rng.bytes(24), build(keys))))
        head = bytes([i, 40, 1, 200])
        yield head + pieces_of(made, b"\0")
        yield head + b"\5\x18" + rng.bytes(24) + b"\0\x09rubbish\r\n" + b"\5\x18" + rng.bytes(24)
        yield head + b"\1\x20" + rng.bytes(32) + b"\4\1\7" + b"\2\x20" + rng.bytes(32) + b"\3\x20" + rng.bytes(32)
        inner = {"vectornav_binary": made[1:-2], "xsens_mtdata2": made[4:-1], "stim300": made[:-4]}.get(name, made)
        if example.name in ("text", "vectornav_ascii"):
            inner = inner.strip().strip(b"$").partition(b"\r")[0].rpartition(b"*")[0] or inner
        yield head + b"".join(b"\1" + bytes([len(part)]) + part for part in [inner[:190]] * 4)


WORDS: Final = {
    "text": ("nan", "inf", "-inf", "1e308", "1e-320", "1_0", "#", "$", "*", ",", ";", "\r\n", "4611686018427387904"),
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
CAN: Final = (
    ("first", {"signals": CAN_SIGNALS}),
    ("second", {"signals": {**SECOND_SIGNALS, "temperature": "Warm.temp"}, "valid": "Rates.ok", "window": 0.005}),
    ("second", {"signals": SECOND_SIGNALS, "join": "counter", "counter": "cnt"}),
    ("second", {"signals": SECOND_SIGNALS, "counter": "Rates.cnt", "partial": True, "not_available": True}),
    ("j1939_imu", {"signals": J1939_SIGNALS}),
    ("j1939_imu", {"signals": J1939_SIGNALS, "source": 3, "tick": None, "partial": True}),
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
        return database.messages, settings, database.timing


def _can_decoder(i: int) -> DbcDecoder:
    messages, settings, timing = _can(i)
    return DbcDecoder(messages, settings, timing)


def _frames(tape: Tape, decoder: DbcDecoder) -> list[Chunk]:
    """Frames to the decoder's addresses and to others."""
    addresses = [address & ~(1 << 30) for address in decoder.addresses]
    t_ns = START_NS
    chunks = []
    while tape and len(chunks) < 40:
        kind, data = tape.byte(), tape.piece()[:64]
        t_ns += (kind >> 4) * 1_000_000
        if kind % 4 == 3:
            samples = samples_of(data, decoder)
            chunks += [replace(chunk, t_ns=t_ns) for chunk in decoder.encode(samples)]
            continue
        address = addresses[kind // 4 % len(addresses)]
        if kind % 4 == 1:
            address = address & ~0xFF | data[0] if data else address ^ EXTENDED_ID
        elif kind % 4 == 2:
            data = data[:8].ljust(8, b"\0")
        chunks.append(Chunk(data, t_ns, address))
    return chunks


def _same_one_by_one(
    build: Callable[[], Decoder], chunks: list[Chunk], rate_hz: float | None
) -> tuple[list[SampleBlock], Decoder]:
    """The samples of all chunks at once, which are those of the chunks one by one."""
    one, other = build(), build()
    clock = Stamped(other.timing, rate_hz)
    parts = fed(other, [[chunk] for chunk in chunks])
    for each in parts[:STAMPED]:
        clock.put(each)
    whole = fed(one, [chunks])
    assert seen(whole) == seen(parts), "one by one gives other samples"
    assert one.bad == other.bad, "one by one counts other bad frames"
    return whole, one


def _can_seeds() -> Iterator[bytes]:
    rng = np.random.default_rng(2)
    for i in range(len(CAN)):
        yield bytes([i, 1]) + b"".join(bytes([3 + 16 * k, 16]) + rng.bytes(16) for k in range(4))
        yield bytes([i, 0]) + b"".join(bytes([2 + 4 * k, 8]) + rng.bytes(8) for k in range(12))


def check_dbc(data: bytes) -> None:
    """Frames through a CAN database."""
    tape = Tape(data)
    i, rate = tape.byte() % len(CAN), tape.choice(RATES_HZ)
    _same_one_by_one(lambda: _can_decoder(i), _frames(tape, _can_decoder(i)), rate)


# --- messages


def _plain(name: str) -> Decoder:
    module = importlib.import_module(f"drivers.decoders.{name}")
    decoder: Decoder = module.build(module.Settings())
    return decoder


def check_ros2(data: bytes) -> None:
    """CDR messages: numbers that come out stand in the payload, at its own stamp."""
    tape = Tape(data)
    rate = tape.choice(RATES_HZ)
    chunks = []
    while tape and len(chunks) < 20:
        kind, payload, beside = tape.byte(), tape.piece(), tape.piece()
        if kind % 2:
            beside = beside.ljust(33 if kind % 4 == 1 else 77, b"\0")[: 33 if kind % 4 == 1 else 77]
        chunks.append(Chunk(payload, 5, attachment=beside))
    whole, _ = _same_one_by_one(lambda: _plain("ros2_imu"), chunks, rate)
    known = iter([reading for chunk in chunks if (reading := _ros2_reading(chunk.data)) is not None])
    for one in whole:
        for t_ns, row in zip(one.t_ns.tolist(), one.values.tolist(), strict=True):
            assert any(t_ns == t and _same(row, values) for t, values in known), "a sample that no message holds"


def _same(row: list[float], values: list[float]) -> bool:
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
        decoder = _plain("ros2_imu")
        chunks = decoder.encode(samples_of(rng.bytes(24), decoder))
        yield b"\1" + b"".join(
            b"\1" + bytes([203]) + chunk.data.ljust(392, b"\0") + bytes([33]) + chunk.attachment for chunk in chunks
        )
        yield b"\1" + b"".join(b"\0" + bytes([202]) + chunk.data.ljust(328, b"\0") + b"\0" for chunk in chunks)


def check_samples(data: bytes) -> None:
    """Messages of other monitors, raw or put together."""
    tape = Tape(data)
    rate = tape.choice(RATES_HZ)
    chunks = []
    while tape and len(chunks) < 20:
        chunks.append(Chunk(tape.piece() if tape.byte() % 2 else message_of(tape), 5))
    _same_one_by_one(lambda: _plain("samples"), chunks, rate)


def message_of(tape: Tape) -> bytes:
    """A map with the right keys, and often the right sizes."""
    kind = tape.byte()
    axes = [tape.choice((*COLUMNS, *AXES, "other")) for _ in range(1 + kind % 7)]
    rows = tape.byte() % 32
    numbers = [tape.byte() / 8.0 if kind & 8 else tape.wild() for _ in range(rows * len(axes) % 50)]
    payload: dict[str, Any] = {
        "schema": tape.choice((SCHEMA, *SCHEMAS, "other")),
        "axes": list(dict.fromkeys(axes)) if kind & 16 else axes,
        "samples": tape.choice((0, 1, rows, 1 << 53, tape.int64())),
    }
    width = len(payload["axes"])
    rows = len(numbers) // width
    payload["data"] = np.array(numbers[: rows * width]).tobytes()
    if kind & 32:
        payload["t"] = np.array([tape.wild() for _ in range(rows)]).tobytes()
    else:
        payload |= {"t": tape.wild(), "t0": tape.wild(), "rate": tape.wild()}
    if kind & 64:
        payload["lost"] = tape.choice((0, 1, 1000, 1 << 40, 1 << 53, tape.int64()))
    return msgspec.msgpack.encode(payload)


def _samples_seeds() -> Iterator[bytes]:
    rng = np.random.default_rng(4)
    for _ in range(3):
        decoder = _plain("samples")
        made = decoder.encode(samples_of(rng.bytes(24), decoder))[0].data
        n = 200 + -(-(len(made) - 200) // 64) if len(made) >= 200 else len(made)
        yield b"\1" + (b"\1" + bytes([n]) + made) * 2
        yield b"\1" + rng.bytes(400)


def wire_message(name: str) -> Check:
    """The target of one decoder of messages, raw: one message."""

    def check(data: bytes) -> None:
        fed(_plain(name), [[Chunk(data, 5)]])

    return check


def _messages(name: str) -> Iterator[bytes]:
    rng = np.random.default_rng(6)
    for n in (8, 24):
        yield from (chunk.data for chunk in _plain(name).encode(samples_of(rng.bytes(n), _plain(name))))


def wire_dbc(data: bytes) -> None:
    """Frames of eight bytes, each behind a byte that says to which address."""
    decoder = _can_decoder(data[0] % len(CAN) if data else 0)
    addresses = [address & ~(1 << 30) for address in decoder.addresses]
    cut = [data[at : at + 9] for at in range(1, min(len(data), 100), 9)]
    fed(decoder, [[Chunk(part[1:], START_NS, addresses[part[0] % len(addresses)]) for part in cut]])


target("wire-dbc", lambda: [bytes([i, *range(100)]) for i in range(len(CAN))], 100)(wire_dbc)
for _name in ("ros2_imu", "samples"):
    target(f"wire-{_name}", partial(_messages, _name), 512)(wire_message(_name))

ALONE: Final = {
    "dbc": (check_dbc, _can_seeds),
    "ros2_imu": (check_ros2, _ros2_seeds),
    "samples": (check_samples, _samples_seeds),
}
for _name in DECODER_NAMES:
    if _name in ALONE:
        target(f"decoder-{_name}", ALONE[_name][1], 1024)(ALONE[_name][0])
    else:
        target(f"decoder-{_name}", partial(stream_seeds, _name), 400, WORDS.get(_name, ()))(stream_check(_name))
        target(f"wire-{_name}", partial(wire_seeds, _name), 250, WORDS.get(_name, ()))(wire_check(_name))
