"""Sample blocks: read-only, absent is NaN, and loss stays where it happened."""

from dataclasses import replace

import numpy as np
import pytest

from drivers.data_types import AXES, NO_TICK, concatenate_blocks, make_block, merge_contiguous_blocks


def a_block(n=5, start=0, lost=0):
    t_ns = np.arange(start, start + n, dtype=np.int64)
    values = np.arange(6.0 * n).reshape(n, 6) + start
    return make_block(t_ns, values, 20.0 + t_ns, t_ns + 100, lost)


def test_axis_order_is_the_contract():
    assert AXES == ("gx", "gy", "gz", "ax", "ay", "az")


def test_temperature_and_counter_are_absent_unless_given():
    made = make_block(np.arange(3), np.zeros((3, 6)))
    assert np.isnan(made.temperature_c).all()
    assert made.ticks.tolist() == [NO_TICK] * 3
    assert made.lost == 0
    assert len(made) == 3


@pytest.mark.parametrize("name", ["t_ns", "values", "temperature_c", "ticks"])
def test_arrays_are_read_only(name):
    with pytest.raises(ValueError, match="read-only"):
        getattr(a_block(), name)[0] = 1


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
def test_a_part_keeps_loss_only_with_the_first_row(rows, lost):
    whole = a_block(lost=7)
    part = whole[rows]
    assert part.lost == lost
    for name in ("t_ns", "values", "temperature_c", "ticks"):
        assert np.array_equal(getattr(part, name), getattr(whole, name)[rows])


def test_cut_and_joined_is_the_same_block():
    whole = a_block(lost=3)
    again = concatenate_blocks([whole[:2], whole[2:3], whole[3:]])
    for name in ("t_ns", "values", "temperature_c", "ticks"):
        assert np.array_equal(getattr(again, name), getattr(whole, name))
    assert again.lost == 3


def test_join_sums_the_loss():
    joined = concatenate_blocks([a_block(2, lost=1), a_block(3, start=2, lost=4)])
    assert joined.lost == 5
    assert joined.t_ns.tolist() == [0, 1, 2, 3, 4]


def test_unbroken_joins_what_nothing_is_missing_between():
    t_ns = np.arange(10, dtype=np.int64)
    whole = make_block(t_ns, np.arange(60.0).reshape(10, 6))
    pieces = [whole[:2], replace(whole[2:3], lost=4), whole[3:7], replace(whole[7:], lost=1)]
    found = merge_contiguous_blocks(pieces)
    assert [(len(one), one.lost) for one in found] == [(2, 0), (5, 4), (3, 1)]
    np.testing.assert_array_equal(np.concatenate([one.values for one in found]), whole.values)
    assert merge_contiguous_blocks([]) == []
