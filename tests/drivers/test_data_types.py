"""Tests of sample blocks: read-only arrays, default values, slices and concatenation."""

from dataclasses import replace

import numpy as np
import pytest

from drivers.data_types import AXES, NO_TICK, concatenate_blocks, make_block, merge_contiguous_blocks


def make_test_block(n=5, start=0, lost=0):
    t_ns = np.arange(start, start + n, dtype=np.int64)
    values = np.arange(6.0 * n).reshape(n, 6) + start
    return make_block(t_ns, values, 20.0 + t_ns, t_ns + 100, lost)


def test_axes_have_the_documented_order():
    assert AXES == ("gx", "gy", "gz", "ax", "ay", "az")


def test_block_has_contiguous_arrays_whatever_the_layout_of_its_parts():
    table = np.arange(24.0).reshape(3, 8)
    block = make_block(np.arange(6)[::2], np.asfortranarray(table[:, :6]), table[:, 6], np.arange(6)[::2])
    arrays = (block.t_ns, block.values, block.temperature_c, block.ticks)
    assert all(one.flags.c_contiguous and not one.flags.writeable for one in arrays)
    np.testing.assert_array_equal(block.values, table[:, :6])


def test_temperature_and_ticks_are_absent_by_default():
    block = make_block(np.arange(3), np.zeros((3, 6)))
    assert np.isnan(block.temperature_c).all()
    assert block.ticks.tolist() == [NO_TICK] * 3
    assert block.lost == 0
    assert len(block) == 3


@pytest.mark.parametrize("name", ["t_ns", "values", "temperature_c", "ticks"])
def test_arrays_are_read_only(name):
    with pytest.raises(ValueError, match="read-only"):
        getattr(make_test_block(), name)[0] = 1


@pytest.mark.parametrize(
    ("rows", "lost"),
    [
        (slice(0, 2), 7),
        (slice(None), 7),
        (slice(-5, None), 7),
        (slice(1, None), 0),
        (slice(-1, None), 0),
    ],
)
def test_slice_keeps_the_lost_samples_only_with_the_first_row(rows, lost):
    block = make_test_block(lost=7)
    part = block[rows]
    assert part.lost == lost
    for name in ("t_ns", "values", "temperature_c", "ticks"):
        assert np.array_equal(getattr(part, name), getattr(block, name)[rows])


def test_concatenated_slices_equal_the_original_block():
    block = make_test_block(lost=3)
    joined = concatenate_blocks([block[:2], block[2:3], block[3:]])
    for name in ("t_ns", "values", "temperature_c", "ticks"):
        assert np.array_equal(getattr(joined, name), getattr(block, name))
    assert joined.lost == 3


def test_concatenation_adds_up_the_lost_samples():
    joined = concatenate_blocks([make_test_block(2, lost=1), make_test_block(3, start=2, lost=4)])
    assert joined.lost == 5
    assert joined.t_ns.tolist() == [0, 1, 2, 3, 4]


def test_contiguous_blocks_are_merged_up_to_the_next_gap():
    t_ns = np.arange(10, dtype=np.int64)
    block = make_block(t_ns, np.arange(60.0).reshape(10, 6))
    pieces = [block[:2], replace(block[2:3], lost=4), block[3:7], replace(block[7:], lost=1)]
    merged = merge_contiguous_blocks(pieces)
    assert [(len(part), part.lost) for part in merged] == [(2, 0), (5, 4), (3, 1)]
    np.testing.assert_array_equal(np.concatenate([part.values for part in merged]), block.values)
    assert merge_contiguous_blocks([]) == []
