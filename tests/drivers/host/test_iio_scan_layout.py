"""Tests of the layout of IIO scans."""

import pytest

from drivers.errors import DecodeError
from drivers.host.iio_scan_layout import ScanElement, ScanLayout, StoredNumber, decode_layout, locate_numbers


def test_elements_are_aligned_to_their_own_size() -> None:
    types = {"a": "le:u8/8>>0", "b": "be:s12/16>>4", "c": "le:s16/16X4>>0", "d": "le:u8/8>>0", "e": "be:s24/32>>8"}
    numbers, size = locate_numbers([ScanElement(name, kind) for name, kind in types.items()])
    assert [number.offset for number in numbers.values()] == [0, 2, 8, 16, 20]
    assert size == 24
    assert numbers["b"] == StoredNumber(2, ">", True, 12, 2, 4)
    assert numbers["d"] == StoredNumber(16, "<", False, 8, 1, 0)


def test_size_of_a_scan_is_a_multiple_of_its_largest_element() -> None:
    assert locate_numbers([ScanElement("t", "le:s64/64>>0"), ScanElement("x", "le:s16/16>>0")])[1] == 16


def test_layout_survives_json() -> None:
    layout = ScanLayout("realtime", [ScanElement("in_temp", "le:s16/16>>0", 0.5, -3.0)])
    assert decode_layout(layout.encode()) == layout


@pytest.mark.parametrize(
    "kind",
    ["", "le:s16", "xe:s16/16>>0", "le:f32/32>>0", "le:s16/24>>0", "le:s16/16>>1", "le:s0/16>>0", "le:s8/8X0>>0"],
)
def test_unknown_type_is_refused(kind: str) -> None:
    with pytest.raises(DecodeError, match=r'^in_x: unknown type ".*"; disable this channel of the buffer$'):
        locate_numbers([ScanElement("in_x", kind)])


def test_layout_without_channels_is_refused() -> None:
    with pytest.raises(DecodeError, match="no channel"):
        locate_numbers([])


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff",
        b"[]",
        b'{"clock": "realtime"}',
        b'{"clock": "realtime", "elements": [{"channel": "a", "type": "le:s8/8>>0", "scale": 1e300}]}',
        b'{"clock": "realtime", "elements": [{"channel": "\xff", "type": "le:s8/8>>0"}]}',
    ],
)
def test_invalid_json_is_refused(data: bytes) -> None:
    with pytest.raises(DecodeError) as raised:
        decode_layout(data)
    assert "\n" not in str(raised.value)
