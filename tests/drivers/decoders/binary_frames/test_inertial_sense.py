"""Tests of the decoder of Inertial Sense packets: checksum of published packets, layouts, status and other packets.

The first three published packets are from the ISB page of the manual, the fourth is from a public script. No packet
with samples from a real device has been published. The packets with samples are synthetic: they follow data_sets.h of
the SDK.
"""

import struct

import numpy as np
import pytest

from drivers.data_types import NO_TICK, ArrivalTimedFormat, Chunk, CounterTimedFormat, SampleBlock
from drivers.decoders.base import MAX_FRAMES_WITHOUT_SAMPLE
from drivers.decoders.binary_frames.inertial_sense import DATA, LONGEST, Settings, build, encode_packet

PUBLISHED = (
    "EF 49 06 00 00 00 3E 1F",
    "EF 49 08 00 00 00 40 27",
    "EF 49 05 09 0C 00 E2 3C 35 01 90 00 00 C0 00 01 00 00 F7 B0",
    "EF 49 03 00 08 00 03 00 28 00 00 00 00 00 6E 43",
)
WORKING = 0x003F0000
"""Status of an IMU whose sensors all work, in version 2 of the SDK."""
NEW_WORKING = 0x0000003F
"""The same in the development version of 2026."""


def make_pimu(time_s: float = 1.5, duration_s: float = 0.25, status: int = WORKING, x_angle: float = 0.5) -> bytes:
    numbers = (x_angle, -0.25, 0.125, 1.0, -2.0, 2.5)
    return encode_packet(DATA, 3, struct.pack("<dfI6f", time_s, duration_s, status, *numbers))


def make_imu(number: int = 58, time_s: float = 1.5, status: int = WORKING) -> bytes:
    return encode_packet(DATA, number, struct.pack("<dI6f", time_s, status, 0.5, -0.25, 0.125, 1.0, -2.0, 9.75))


def decode_one(packet: bytes, **settings: object) -> SampleBlock:
    (block,) = build(Settings(**settings)).feed([Chunk(packet, 77)])
    assert len(block) == 1
    return block


@pytest.mark.parametrize("text", PUBLISHED)
def test_published_packets_are_valid_and_make_no_samples(text: str) -> None:
    packet = bytes.fromhex(text)
    assert encode_packet(packet[2], packet[3], packet[6:-2]) == packet
    decoder = build(Settings())
    (block,) = decoder.feed([Chunk(make_pimu() + packet + make_pimu(), 0)])
    assert (len(block), block.lost, decoder.bad) == (2, 0, 0)


def test_request_of_the_documentation_asks_for_pimu() -> None:
    request = bytes.fromhex("EF 49 03 00 08 00 03 00 00 00 00 00 01 00 47 55")
    assert encode_packet(3, 0, struct.pack("<4H", 3, 0, 0, 1)) == request


def test_increments_are_divided_by_their_duration() -> None:
    assert len(make_pimu()) == 6 + 40 + 2
    got = decode_one(make_pimu())
    assert got.values.tolist() == [[2.0, -1.0, 0.5, 4.0, -8.0, 10.0]]
    assert (got.ticks.tolist(), got.t_ns.tolist()) == ([1_500_000], [77])
    assert np.isnan(got.temperature_c).all()
    assert build(Settings()).timing == CounterTimedFormat(1 << 48, 1e-6)


@pytest.mark.parametrize(("data_set", "number"), [("imu", 58), ("imu_raw", 97)])
def test_rates_and_accelerations_are_decoded(data_set: str, number: int) -> None:
    assert len(make_imu(number)) == 6 + 36 + 2
    got = decode_one(make_imu(number), data_set=data_set)
    assert got.values.tolist() == [[0.5, -0.25, 0.125, 1.0, -2.0, 9.75]]
    assert got.ticks.tolist() == [1_500_000]


def test_time_of_the_packets_can_be_ignored() -> None:
    assert build(Settings(clock="arrival")).timing == ArrivalTimedFormat()
    assert decode_one(make_pimu(), clock="arrival").ticks.tolist() == [NO_TICK]


@pytest.mark.parametrize(
    ("status", "bad"),
    [
        *[(WORKING | bit, 1) for bit in (0x01, 0x04, 0x20)],
        *[(NEW_WORKING | bit, 1) for bit in (0x40000000, 0x80000000)],
        *[(status, 0) for status in (0, WORKING, WORKING | 0x140, NEW_WORKING, NEW_WORKING | 0x02000340)],
    ],
)
def test_saturation_makes_the_sample_bad_in_both_layouts_of_the_status(status: int, bad: int) -> None:
    decoder = build(Settings())
    decoder.feed([Chunk(make_pimu(status=status), 0)])
    assert decoder.bad == bad
    assert ("saturated" in decoder.recent_problem) == bool(bad)


@pytest.mark.parametrize(
    "packet",
    [
        make_pimu(duration_s=0.0),
        make_pimu(duration_s=-0.25),
        make_pimu(duration_s=float("inf")),
        make_pimu(duration_s=float("nan")),
        make_pimu(time_s=float("nan")),
        make_pimu(time_s=-1.0),
        make_pimu(time_s=1e300),
        make_pimu(x_angle=float("nan")),
    ],
)
def test_impossible_numbers_make_the_sample_bad(packet: bytes) -> None:
    decoder = build(Settings())
    assert decoder.feed([Chunk(packet, 0)]) == []
    assert decoder.bad == 1


def test_packets_with_an_offset_and_other_data_sets_make_no_samples() -> None:
    part = encode_packet(DATA | 0x20, 3, b"\x08\x00" + bytes(38))
    longest = encode_packet(DATA, 13, bytes(LONGEST - 8))
    decoder = build(Settings())
    stream = make_pimu() + part + make_imu() + longest + make_pimu()
    blocks = decoder.feed([Chunk(stream[:1000], 0), Chunk(stream[1000:], 0)])
    assert [(len(block), block.lost) for block in blocks] == [(2, 0)]
    assert decoder.bad == 0


@pytest.mark.parametrize(
    "packet",
    [
        encode_packet(DATA, 3, bytes(41)),
        encode_packet(0, 3, bytes(40)),
        encode_packet(9, 3, bytes(40)),
        encode_packet(DATA, 13, bytes(LONGEST - 7)),
    ],
    ids=["length", "type 0", "type 9", "too long"],
)
def test_packets_with_an_impossible_header_are_rejected(packet: bytes) -> None:
    decoder = build(Settings())
    (block,) = decoder.feed([Chunk(make_pimu(), 0)])
    (block,) = decoder.feed([Chunk(packet + make_pimu(), 0)])
    assert block.lost == decoder.bad >= 1


@pytest.mark.parametrize(
    ("packet", "text"), [(make_imu(), 'set data_set = "imu"'), (bytes.fromhex(PUBLISHED[0]), "enable this data set")]
)
def test_missing_data_set_is_reported(packet: bytes, text: str) -> None:
    decoder = build(Settings())
    assert decoder.feed([Chunk(packet * MAX_FRAMES_WITHOUT_SAMPLE, 0)]) == []
    assert decoder.recent_problem == ""
    decoder.feed([Chunk(packet, 0)])
    assert text in decoder.recent_problem
    decoder.feed([Chunk(make_pimu(), 0)])
    assert decoder.recent_problem == ""
