"""Means as samples come against those of the whole recording, wherever it is cut and whatever is missing."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monitor.drift.thermal.interval_means import compute_interval_means
from monitor.drift.thermal.running_interval_means import BUFFER_ROWS, RunningIntervalMeans


def recording(seed: int, n: int, holes: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    values = 9.81 + 1e-3 * rng.standard_normal((n, 6)) + 1e-5 * np.arange(n)[:, None]
    values[rng.random((n, 6)) < holes] = np.nan
    warmth = 25.0 + 0.01 * rng.standard_normal(n)
    warmth[rng.random(n) < 0.5 * holes] = np.nan
    return values, warmth


@pytest.mark.long
@given(
    length=st.integers(8, 300),
    seed=st.integers(0, 99),
    holes=st.sampled_from([0.0, 0.3, 0.55]),
    cuts=st.lists(st.integers(0, 1500), max_size=12),
    hole=st.tuples(st.integers(0, 1500), st.integers(0, 700)),
)
@settings(deadline=None)
def test_equal_to_those_of_the_whole(length, seed, holes, cuts, hole):
    values, warmth = recording(seed, 1500, holes)
    first, lost = hole[0], min(hole[1], 1500 - hole[0])
    values[first : first + lost], warmth[first : first + lost] = np.nan, np.nan
    means, found = RunningIntervalMeans(length), []
    edges = sorted({0, 1500, first, first + lost, *cuts} - set(range(first + 1, first + lost)))
    behind = 0
    for lo, hi in pairwise(edges):
        if lost and lo == first:
            behind = lost
        else:
            found += means.add_samples(values[lo:hi], warmth[lo:hi], behind)
            behind = 0
    if behind:  # missing samples travel with the block that follows them
        found += means.add_samples(values[:0], warmth[:0], behind)
    assert [one.end for one in found] == [length * (k + 1) for k in range(1500 // length)]
    for axis in range(6):
        want = compute_interval_means(values[:, axis], warmth, 1.0, float(length))
        np.testing.assert_allclose([one.bias[axis] for one in found], want.bias, rtol=1e-12)
        np.testing.assert_allclose([one.error[axis] for one in found], want.error, rtol=1e-6)
        np.testing.assert_allclose([one.temperature_c for one in found], want.temperature_c, rtol=1e-12)


def test_cuts_make_no_difference_at_all():
    values, warmth = recording(1, 5 * BUFFER_ROWS, 0.2)
    whole = RunningIntervalMeans(3 * BUFFER_ROWS).add_samples(values, warmth, 0)
    means = RunningIntervalMeans(3 * BUFFER_ROWS)
    single = [one for k in range(len(values)) for one in means.add_samples(values[k : k + 1], warmth[k : k + 1], 0)]
    assert len(whole) == len(single) == 1
    assert whole[0].bias.tolist() == single[0].bias.tolist()
    assert whole[0].error.tolist() == single[0].error.tolist()


def test_a_hole_of_years_is_passed_over_at_once():
    means = RunningIntervalMeans(100, longest=5)
    found = means.add_samples(np.ones((30, 6)), np.full(30, 20.0), 10**12)
    assert len(found) == 5
    assert found[-1].end == 10**12
    assert np.isnan(found[-1].bias).all()
    (after,) = means.add_samples(np.ones((70, 6)), np.full(70, 20.0), 0)
    assert (after.end, after.temperature_c) == (10**12 + 100, 20.0)
    assert after.bias.tolist() == pytest.approx([1.0] * 6)
