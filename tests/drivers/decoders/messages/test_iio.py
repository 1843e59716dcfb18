"""Tests of the decoder of IIO scans: the layouts of kernel drivers, time stamps, and invalid messages."""

import struct
from collections.abc import Mapping

import numpy as np
import pytest

from drivers.data_types import ArrivalTimedFormat, Chunk, SampleBlock, SenderTimedFormat, concatenate_blocks
from drivers.decoders.messages import iio
from drivers.host.iio_scan_layout import ScanElement, ScanLayout

TIME_NS = 1_763_900_000_123_456_789
STAMP = ScanElement("in_timestamp", "le:s64/64>>0")
X_AXIS = [ScanElement("in_anglvel_x", "le:s16/16>>0", 0.001), STAMP]


def make_axes(prefix: str, kind: str, scale: float) -> list[ScanElement]:
    return [ScanElement(f"{prefix}_{axis}", kind, scale) for axis in "xyz"]


def make_chunk(elements: list[ScanElement], data: bytes, clock: str = "realtime", t_ns: int = 5) -> Chunk:
    return Chunk(data, t_ns, attachment=ScanLayout(clock, elements).encode())


def feed(elements: list[ScanElement], data: bytes, **keys: object) -> SampleBlock:
    decoder = iio.build(iio.Settings.model_validate(keys))
    return concatenate_blocks(decoder.feed([make_chunk(elements, data)]))


DRIVERS: Mapping[str, tuple[list[ScanElement], bytes, list[float], float]] = {
    "bmi160": (
        [
            *make_axes("in_anglvel", "le:s16/16>>0", 0.001065),
            *make_axes("in_accel", "le:s16/16>>0", 0.000598),
            STAMP,
        ],
        struct.pack("<6h4xq", 1, -2, 32767, 0, -16393, -32768, TIME_NS),
        [0.001065, -0.00213, 34.896855, 0.0, -9.803014, -19.595264],
        np.nan,
    ),
    # the temperature has an offset, which is added before scaling
    "icm42600 gyro": (
        [
            *make_axes("in_anglvel", "be:s16/16>>0", 0.001065264),
            ScanElement("in_temp", "le:s16/16>>0", 7.548309, 3312.0),
            STAMP,
        ],
        struct.pack(">3h", 100, -100, 3) + struct.pack("<hq", 64, TIME_NS),
        [0.1065264, -0.1065264, 0.003195792, np.nan, np.nan, np.nan],
        (64 + 3312) * 7.548309e-3,
    ),
    "lsm6dsx accel": (
        [*make_axes("in_accel", "le:s16/16>>0", 0.000598205), STAMP],
        struct.pack("<3h2xq", 16393, -1, 0, TIME_NS),
        [np.nan, np.nan, np.nan, 9.806374565, -0.000598205, 0.0],
        np.nan,
    ),
    "adis16475": (
        [
            *make_axes("in_anglvel", "be:s32/32>>0", 1e-7),
            *make_axes("in_accel", "be:s32/32>>0", 1e-6),
            ScanElement("in_temp0", "be:s16/16>>0", 100.0),
            STAMP,
        ],
        struct.pack(">6ih6x", 1, -1, 2**31 - 1, 0, -9_806_650, -(2**31), 251) + struct.pack("<q", TIME_NS),
        [1e-7, -1e-7, 214.7483647, 0.0, -9.80665, -2147.483648],
        25.1,
    ),
    "unsigned, with an offset, and a counter of another type": (
        [
            ScanElement("in_count", "le:u8/8>>0"),
            ScanElement("in_anglvel_y", "be:u32/32>>0", 1e-9, -(2.0**31)),
            STAMP,
        ],
        struct.pack(">B3xI", 7, 2**31 + 1) + struct.pack("<q", TIME_NS),
        [np.nan, 1e-9, np.nan, np.nan, np.nan, np.nan],
        np.nan,
    ),
    "12 significant bits": (
        [ScanElement("in_accel_z", "le:s12/16>>4", 0.01), STAMP],
        struct.pack("<H6xq", 0xFFE5, TIME_NS),
        [np.nan, np.nan, np.nan, np.nan, np.nan, -0.02],
        np.nan,
    ),
}


@pytest.mark.parametrize("name", DRIVERS)
def test_layouts_of_kernel_drivers_are_decoded(name: str) -> None:
    elements, data, values, temperature_c = DRIVERS[name]
    got = feed(elements, data)
    assert got.values[0] == pytest.approx(values, rel=1e-12, nan_ok=True)
    assert got.temperature_c[0] == pytest.approx(temperature_c, rel=1e-12, nan_ok=True)
    assert got.t_ns.tolist() == [TIME_NS]


def test_several_scans_in_a_message_are_decoded() -> None:
    data = b"".join(struct.pack("<h6xq", i, TIME_NS + i) for i in range(5))
    got = feed(X_AXIS, data)
    assert got.values[:, 0] == pytest.approx(0.001 * np.arange(5))
    assert got.t_ns.tolist() == list(range(TIME_NS, TIME_NS + 5))


def test_layout_may_change_after_the_link_has_been_reopened() -> None:
    decoder = iio.build(iio.Settings())
    other = [ScanElement("in_anglvel_x", "be:s32/32>>0", 0.5), STAMP]
    chunks = [
        make_chunk(X_AXIS, struct.pack("<h6xq", 8, 1)),
        make_chunk(other, struct.pack(">i4x", 8) + struct.pack("<q", 2)),
        make_chunk(X_AXIS, struct.pack("<h6xq", 8, 3)),
    ]
    got = concatenate_blocks(decoder.feed(chunks))
    assert got.values[:, 0] == pytest.approx([0.008, 4.0, 0.008])
    assert (decoder.bad, got.lost) == (0, 0)


def test_arrival_times_need_no_time_stamps() -> None:
    assert iio.build(iio.Settings()).timing == SenderTimedFormat()
    assert iio.build(iio.Settings(clock="arrival")).timing == ArrivalTimedFormat()
    assert feed(X_AXIS[:1], struct.pack("<h", 1), clock="arrival").t_ns.tolist() == [5]
    assert feed(X_AXIS, struct.pack("<h6xq", 1, TIME_NS), clock="arrival").t_ns.tolist() == [5]


@pytest.mark.parametrize(
    ("chunk", "reason"),
    [
        (make_chunk(X_AXIS[:1], b"\0\0"), 'no in_timestamp: enable this channel, or set clock = "arrival"'),
        (make_chunk(X_AXIS, bytes(16), "monotonic"), "are on the clock monotonic: write realtime to current_timestamp"),
        (make_chunk(X_AXIS, bytes(15)), "15 bytes are not a whole number of scans of 16 bytes"),
        (make_chunk(X_AXIS, struct.pack("<h6xq", 1, -1)), "a time stamp of the kernel is no Unix time"),
        (make_chunk([], bytes(16)), "no channel of the buffer is enabled"),
        (Chunk(bytes(16), 5), "no layout of an IIO scan"),
    ],
)
def test_unusable_message_is_bad_and_gives_the_reason(chunk: Chunk, reason: str) -> None:
    decoder = iio.build(iio.Settings())
    good = make_chunk(X_AXIS, struct.pack("<h6xq", 1, TIME_NS))
    blocks = decoder.feed([good, chunk, good])
    assert [(len(block), block.lost) for block in blocks] == [(1, 0), (1, 1)]
    assert decoder.bad == 1
    assert reason in decoder.recent_problem
