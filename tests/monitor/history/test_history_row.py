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
from tests.monitor.history.random_rows import (
    COLUMN_NAMES,
    aggregate_column,
    equal_with_nan,
    get_column_values,
    make_row,
)

OTHER_NAMES = ("gz.N", "gx.N", "rate")


@given(seed=st.integers(0, 2**32), cuts=st.lists(st.integers(1, 30), max_size=4), count=st.integers(1, 30))
def test_merging_in_groups_equals_merging_at_once(seed: int, cuts: list[int], count: int) -> None:
    rng = np.random.default_rng(seed)
    rows = [make_row(60 * i, rng, names=OTHER_NAMES if rng.random() < 0.3 else COLUMN_NAMES) for i in range(count)]
    edges = sorted({0, count, *(cut for cut in cuts if cut < count)})
    pieces = [merge_rows(rows[a:b], 60 * a, 60 * (b - a)) for a, b in pairwise(edges)]
    whole = merge_rows(pieces, 0, 60 * count)
    for name in {*COLUMN_NAMES, *OTHER_NAMES}:
        assert equal_with_nan(get_column_values(whole, name), aggregate_column(rows, name)), name
    assert whole.counts == tuple(sum(r.counts[i] for r in rows) for i in range(4))
    assert whole.state == max(r.state for r in rows)
    assert whole.newest_s == max(r.newest_s for r in rows)


@given(seed=st.integers(0, 2**32), count=st.integers(1, 40))
def test_packed_columns_are_unpacked_unchanged(seed: int, count: int) -> None:
    names = tuple(f"a{i}" for i in range(count))
    row = make_row(0, np.random.default_rng(seed), names=names)
    found = unpack_count_min_max_last(pack_count_min_max_last(row), count)
    for part, expected in zip(found, (row.n, row.low, row.high, row.last), strict=True):
        np.testing.assert_array_equal(part, expected)


@given(data=st.binary(max_size=200), count=st.integers(0, 300))
def test_invalid_bytes_are_refused(data: bytes, count: int) -> None:
    with pytest.raises(RecordingError):
        unpack_count_min_max_last(data + b"\xff", max(count, 1))


def test_small_input_that_unpacks_to_many_columns_is_refused() -> None:
    many = make_row(0, np.random.default_rng(1), names=tuple(f"a{i}" for i in range(4000)), missing=1.0)
    with pytest.raises(RecordingError, match="not 48"):
        unpack_count_min_max_last(pack_count_min_max_last(many), 3)


@given(st.lists(st.tuples(*[st.floats(width=32, allow_infinity=False)] * 3), min_size=1, max_size=30))
def test_minimum_maximum_and_last_are_those_of_the_values(inputs: list[tuple[float, float, float]]) -> None:
    seen = RunningMinMaxLast(COLUMN_NAMES)
    for values in inputs:
        seen.add_value_per_column(np.array(values))
    for i in range(3):
        present = [values[i] for values in inputs if values[i] == values[i]]
        expected = (len(present), min(present), max(present), present[-1]) if present else (0, *[float("nan")] * 3)
        assert equal_with_nan(
            (int(seen.count[i]), float(seen.minimum[i]), float(seen.maximum[i]), float(seen.last[i])), expected
        )


def test_late_row_does_not_replace_the_last_value() -> None:
    rng = np.random.default_rng(3)
    first, second = make_row(0, rng, missing=0.0), make_row(60, rng, missing=0.0)
    np.testing.assert_array_equal(merge_rows([second, first], 0, 120).last, second.last)


def test_selected_columns_keep_their_names() -> None:
    full = make_row(0, np.random.default_rng(4), missing=0.0)
    few = select_columns(full, ("rate", "not there"))
    assert get_column_values(few, "rate") == get_column_values(full, "rate")
    assert equal_with_nan(get_column_values(few, "not there"), aggregate_column([], "not there"))
    assert isinstance(few, HistoryRow)
