from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import RecordingError
from monitor.history.history_row import (
    HistoryRow,
    RunningMinMaxLast,
    merge_rows,
    pack_count_min_max_last,
    select_columns,
    unpack_count_min_max_last,
)
from tests.monitor.history.made import NAMES, numbers_of, row, same, together

OTHER = ("gz.N", "gx.N", "rate")


@given(seed=st.integers(0, 2**32), cuts=st.lists(st.integers(1, 30), max_size=4), count=st.integers(1, 30))
def test_merging_in_any_groups_is_merging_at_once(seed: int, cuts: list[int], count: int) -> None:
    rng = np.random.default_rng(seed)
    rows = [row(60 * i, rng, names=OTHER if rng.random() < 0.3 else NAMES) for i in range(count)]
    edges = sorted({0, count, *(cut for cut in cuts if cut < count)})
    pieces = [merge_rows(rows[a:b], 60 * a, 60 * (b - a)) for a, b in pairwise(edges)]
    whole = merge_rows(pieces, 0, 60 * count)
    for name in {*NAMES, *OTHER}:
        assert same(numbers_of(whole, name), together(rows, name)), name
    assert whole.counts == tuple(sum(one.counts[i] for one in rows) for i in range(4))
    assert whole.state == max(one.state for one in rows)
    assert whole.newest_s == max(one.newest_s for one in rows)


@given(seed=st.integers(0, 2**32), count=st.integers(1, 40))
def test_what_is_unpacked_is_what_was_packed(seed: int, count: int) -> None:
    names = tuple(f"a{i}" for i in range(count))
    one = row(0, np.random.default_rng(seed), names=names)
    found = unpack_count_min_max_last(pack_count_min_max_last(one), count)
    for part, expected in zip(found, (one.n, one.low, one.high, one.last), strict=True):
        np.testing.assert_array_equal(part, expected)


@given(data=st.binary(max_size=200), count=st.integers(0, 300))
def test_bytes_that_were_never_packed_are_said(data: bytes, count: int) -> None:
    with pytest.raises(RecordingError):
        unpack_count_min_max_last(data + b"\xff", max(count, 1))


def test_a_small_piece_that_unpacks_to_a_flood_is_refused() -> None:
    flood = row(0, np.random.default_rng(1), names=tuple(f"a{i}" for i in range(4000)), missing=1.0)
    with pytest.raises(RecordingError, match="not 48"):
        unpack_count_min_max_last(pack_count_min_max_last(flood), 3)


@given(st.lists(st.tuples(*[st.floats(width=32, allow_infinity=False)] * 3), min_size=1, max_size=30))
def test_extremes_are_those_of_the_numbers(looks: list[tuple[float, float, float]]) -> None:
    seen = RunningMinMaxLast(NAMES)
    for look in looks:
        seen.add_value_per_column(np.array(look))
    for i in range(3):
        there = [look[i] for look in looks if look[i] == look[i]]
        expected = (len(there), min(there), max(there), there[-1]) if there else (0, *[float("nan")] * 3)
        assert same((int(seen.count[i]), float(seen.minimum[i]), float(seen.maximum[i]), float(seen.last[i])), expected)


def test_a_late_row_does_not_have_the_last_word() -> None:
    rng = np.random.default_rng(3)
    first, second = row(0, rng, missing=0.0), row(60, rng, missing=0.0)
    np.testing.assert_array_equal(merge_rows([second, first], 0, 120).last, second.last)


def test_chosen_numbers_keep_their_names() -> None:
    one = row(0, np.random.default_rng(4), missing=0.0)
    few = select_columns(one, ("rate", "not there"))
    assert numbers_of(few, "rate") == numbers_of(one, "rate")
    assert same(numbers_of(few, "not there"), together([], "not there"))
    assert isinstance(few, HistoryRow)
