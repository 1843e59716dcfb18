"""Tests of the MAVLink decoder, in comparison with the frames that the library pymavlink builds and reads.

The golden frames were built with pymavlink 2.4.50 from the dialect common.xml.
"""

import itertools

import numpy as np
import pytest
from pymavlink.dialects.v10 import common as version_1
from pymavlink.dialects.v20 import common

from drivers.data_types import (
    ArrivalTimedFormat,
    Chunk,
    CounterTimedFormat,
    SampleBlock,
    concatenate_blocks,
    make_block,
)
from drivers.decoders.binary_frames.mavlink import MAX_OTHER_MESSAGES, MESSAGES, Settings, build
from drivers.errors import ConfigError
from drivers.units import DEGREE, G0
from tests.support.settings import read_settings

HIGHRES = bytes.fromhex(
    "FD 3D 00 00 07 01 01 69 00 00 87 D6 12 00 00 00 00 00 CD CC CC 3D CD CC 4C BE C3 F5 1C C1 0A D7 23 3C 0A D7 A3 BC"
    "8F C2 F5 3C CD CC 4C 3E 00 00 00 00 CD CC CC 3E 00 50 7D 44 00 00 00 00 00 00 C8 42 00 00 C8 41 3F 9B EE"
)
SCALED = bytes.fromhex(
    "FD 18 00 00 07 01 01 1A 00 00 D2 04 00 00 0A 00 EC FF 18 FC 05 00 FA FF 07 00 C8 00 00 00 90 01 C4 09 08 7A"
)
RAW = bytes.fromhex(
    "FD 1D 00 00 07 01 01 1B 00 00 87 D6 12 00 00 00 00 00 0A 00 EC FF 18 FC 05 00 FA FF 07 00 C8 00 00 00 90 01 00 C4"
    "09 1C 50"
)
RAW_UNITS = {"gyro_unit": "deg/s/131", "accel_unit": "g/16384"}
ALL_UPDATED = 63


def decode_blocks(data: bytes, **settings: object) -> list[SampleBlock]:
    return build(Settings(**settings)).feed([Chunk(data, 77)])


def decode_bytes(data: bytes, **settings: object) -> SampleBlock:
    return concatenate_blocks(decode_blocks(data, **settings))


def make_sender(system: int = 1, component: int = 1, dialect=common):
    sender = dialect.MAVLink(None, system, component)
    sender.sequences = itertools.count()
    return sender


def pack(sender, message) -> bytes:
    sender.seq = next(sender.sequences) % 256
    return message.pack(sender)


def make_highres(time_us: int = 0, updated: int = ALL_UPDATED, instance: int = 0, gx: float = 0.5):
    return common.MAVLink_highres_imu_message(time_us, 1, 2, 3, gx, 5, 6, *[0] * 6, 20.5, updated, instance)


@pytest.mark.parametrize(
    ("frame", "settings", "gyro", "accel", "ticks"),
    [
        (HIGHRES, {}, [0.01, -0.02, 0.03], [0.1, -0.2, -9.81], 1_234_567),
        (SCALED, {"message": "SCALED_IMU"}, [0.005, -0.006, 0.007], [0.01 * G0, -0.02 * G0, -G0], 1234),
        (
            RAW,
            {"message": "RAW_IMU", **RAW_UNITS},
            np.array([5, -6, 7]) * DEGREE / 131,
            np.array([10, -20, -1000]) * G0 / 16384,
            1_234_567,
        ),
    ],
    ids=["HIGHRES_IMU", "SCALED_IMU", "RAW_IMU"],
)
def test_golden_frame_is_decoded(frame: bytes, settings: dict, gyro: list, accel: list, ticks: int) -> None:
    got = decode_bytes(frame, **settings)
    np.testing.assert_allclose(got.values[0], [*gyro, *accel], rtol=1e-6)
    assert got.temperature_c.tolist() == [25.0]
    assert got.ticks.tolist() == [ticks]


@pytest.mark.parametrize("name", MESSAGES)
def test_numbers_and_layouts_equal_those_of_pymavlink(name: str) -> None:
    reference = getattr(common, f"MAVLink_{name.lower()}_message")
    message = MESSAGES[name]
    assert (message.number, message.crc_extra) == (reference.id, reference.crc_extra)
    assert message.layout.itemsize == reference.unpacker.size


@pytest.mark.parametrize("name", MESSAGES)
def test_encoded_frames_are_read_by_pymavlink(name: str) -> None:
    samples = make_block(
        np.array([5]), np.array([[0.5, -0.25, 0.125, 1.5, -2.5, 9.75]]), np.array([21.5]), np.array([4_000_000])
    )
    units = RAW_UNITS if name == "RAW_IMU" else {}
    decoder = build(Settings(message=name, system=9, component=8, **units))
    data = b"".join(chunk.data for _ in range(3) for chunk in decoder.encode(samples))
    messages = common.MAVLink(None).parse_buffer(data)
    assert [m.get_type() for m in messages] == [name] * 3
    assert [m.get_seq() for m in messages] == [0, 1, 2]
    assert (messages[0].get_srcSystem(), messages[0].get_srcComponent()) == (9, 8)
    gyro, accel = {"HIGHRES_IMU": (1, 1), "RAW_IMU": (DEGREE / 131, G0 / 16384)}.get(name, (1e-3, 1e-3 * G0))
    fields = messages[0].to_dict()
    assert [fields["xgyro"], fields["zacc"]] == pytest.approx([0.5 / gyro, 9.75 / accel], abs=0.5)
    assert fields["temperature"] == (21.5 if name == "HIGHRES_IMU" else 2150)
    assert fields.get("time_usec", fields.get("time_boot_ms")) == 4_000_000


def test_version_1_and_signed_frames_are_decoded() -> None:
    sender = make_sender(dialect=version_1)
    message = version_1.MAVLink_highres_imu_message(9, 1, 2, 3, 4, 5, 6, *[0] * 6, 20.5, ALL_UPDATED)
    data = b"".join(pack(sender, message) for _ in range(3))
    assert data[0] == 0xFE
    assert decode_bytes(data).values.tolist() == [[4, 5, 6, 1, 2, 3]] * 3
    sender = make_sender()
    sender.signing.secret_key, sender.signing.sign_outgoing = bytes(32), True
    sender.signing.link_id, sender.signing.timestamp = 0, 1
    data = b"".join(pack(sender, make_highres(i)) for i in range(3))
    assert len(data) > 3 * (10 + 61 + 2 + 12)
    got = decode_bytes(data)
    assert (len(got), got.lost) == (3, 0)


def test_messages_without_imu_data_are_skipped_and_damage_is_counted() -> None:
    sender = make_sender()
    other = [
        common.MAVLink_heartbeat_message(2, 12, 81, 3, 4, 3),
        common.MAVLink_attitude_message(1, *[0.5] * 6),
        common.MAVLink_statustext_message(6, b"Ready"),
        common.MAVLink_servo_output_raw_message(5, 0, *[1500] * 8),
    ]
    frames = [pack(sender, make_highres(i) if i % 2 else other[i // 2 % 4]) for i in range(400)]
    decoder = build(Settings())
    got = concatenate_blocks(decoder.feed([Chunk(b"".join(frames), 1)]))
    assert got.ticks.tolist() == list(range(1, 400, 2))
    assert (got.lost, decoder.bad, decoder.recent_problem) == (0, 0, "")
    damaged = bytearray(frames[21])
    damaged[30] ^= 4
    frames[21] = bytes(damaged)
    decoder = build(Settings())
    got = concatenate_blocks(decoder.feed([Chunk(b"".join(frames), 1)]))
    assert got.ticks.tolist() == [i for i in range(1, 400, 2) if i != 21]
    assert (got.lost, decoder.bad) == (1, 1)


def test_damaged_message_without_imu_data_is_rejected() -> None:
    frame = pack(make_sender(), common.MAVLink_attitude_message(1, *[0.5] * 6))
    start, end = pack(make_sender(), make_highres(1)), pack(make_sender(), make_highres(2))
    rejected = 0
    for bit in range(8 * 10, 8 * (len(frame) - 2)):
        damaged = bytearray(frame)
        damaged[bit // 8] ^= 1 << bit % 8
        decoder = build(Settings())
        got = concatenate_blocks(decoder.feed([Chunk(start + damaged + end, 1)]))
        assert got.ticks.tolist() == [1, 2]
        rejected += decoder.bad
    assert rejected > 0.95 * 8 * (len(frame) - 12)


def test_sender_message_and_instance_are_selected() -> None:
    senders = [make_sender(1, 1), make_sender(1, 2), make_sender(2, 1)]
    frames = [
        pack(sender, make_highres(i, instance=instance, gx=10 * k + instance))
        for i in range(5)
        for k, sender in enumerate(senders)
        for instance in (0, 1)
    ]
    data = b"".join(frames)
    for settings, value in (
        ({}, 0),
        ({"instance": 1}, 1),
        ({"component": 2}, 10),
        ({"system": 2, "component": 1, "instance": 1}, 21),
    ):
        assert decode_bytes(data, **settings).values[:, 0].tolist() == [value] * 5, settings
    decoder = build(Settings())
    decoder.feed([Chunk(frames[0], 1)])
    assert decoder.feed([Chunk(frames[4], 1)]) == []
    decoder.forget_stream_state()
    assert len(decoder.feed([Chunk(frames[4], 1)])) == 1


def test_axes_without_update_are_not_measured() -> None:
    sender = make_sender()
    got = decode_bytes(b"".join(pack(sender, make_highres(i, updated)) for i, updated in enumerate((63, 7, 56, 6))))
    np.testing.assert_array_equal(
        np.isnan(got.values), np.array([[0] * 6, [1, 1, 1, 0, 0, 0], [0, 0, 0, 1, 1, 1], [1, 1, 1, 1, 0, 0]], bool)
    )
    decoder = build(Settings())
    blocks = decoder.feed([Chunk(b"".join(pack(sender, make_highres(i, i % 2 * 63)) for i in range(10)), 1)])
    assert sum(map(len, blocks)) == 5
    assert decoder.bad == 0


def test_temperature_of_zero_means_not_measured() -> None:
    sender = make_sender()
    frames = [pack(sender, common.MAVLink_scaled_imu_message(i, *range(1, 10), 100 * i)) for i in range(3)]
    np.testing.assert_array_equal(
        decode_bytes(b"".join(frames), message="SCALED_IMU").temperature_c, [np.nan, 1.0, 2.0]
    )
    decoder = build(Settings(message="SCALED_IMU"))
    samples = make_block(np.arange(2), np.ones((2, 6)), np.array([0.0, np.nan]), np.arange(2))
    got = concatenate_blocks(decoder.feed(decoder.encode(samples)))
    np.testing.assert_array_equal(got.temperature_c, [0.01, np.nan])


def test_problem_lists_the_imu_messages_that_arrive() -> None:
    sender = make_sender(3, 4)
    frame = pack(sender, common.MAVLink_scaled_imu2_message(1, *range(1, 10), 0))
    decoder = build(Settings())
    assert decoder.feed([Chunk(frame * (MAX_OTHER_MESSAGES + 1), 1)]) == []
    assert decoder.recent_problem == (
        "MAVLink arrives, but no sample of HIGHRES_IMU; IMU messages that arrive: SCALED_IMU2 of system 3, component 4"
    )
    decoder.feed([Chunk(pack(sender, make_highres()), 1)])
    assert decoder.recent_problem == ""


def test_non_finite_values_are_bad() -> None:
    sender = make_sender()
    decoder = build(Settings())
    values = (1.0, float("nan"), float("inf"), 2.0)
    blocks = decoder.feed([Chunk(b"".join(pack(sender, make_highres(gx=x)) for x in values), 1)])
    assert [(len(b), b.lost) for b in blocks] == [(1, 0), (1, 2)]
    assert decoder.bad == 2


def test_clock_is_the_time_of_the_message_or_the_arrival() -> None:
    assert build(Settings()).timing == CounterTimedFormat(1 << 52, 1e-6)
    assert build(Settings(message="SCALED_IMU3")).timing == CounterTimedFormat(1 << 32, 1e-3)
    assert build(Settings(clock="arrival")).timing == ArrivalTimedFormat()
    last = pack(make_sender(), make_highres((1 << 64) - 1))
    assert decode_bytes(last).ticks.tolist() == [(1 << 52) - 1]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"message": "RAW_IMU"}, r"gyro_unit: missing; RAW_IMU needs the unit of a count, such as \"mrad/s\""),
        ({"message": "RAW_IMU", "gyro_unit": "mrad/s"}, r"^accel_unit: missing"),
        ({"message": "RAW_IMU", "gyro_unit": "mg", "accel_unit": "mg"}, '"mg" is not a unit of angular rate'),
        ({"system": 256}, "system"),
    ],
)
def test_wrong_settings_are_refused(settings: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        read_settings(Settings, settings)
