"""Tests that compiled vectors give the same results as NumPy arrays of eight elements."""

import numpy as np

from monitor.common.compiled import compiled
from monitor.common.compiled_vectors import (
    LANES,
    broadcast,
    load_column,
    load_vector,
    store_vector,
    sum_vector,
    to_floats,
    to_integers,
)


@compiled
def convert_to_floats(values, floats):
    for i in range(0, values.size, LANES):
        store_vector(floats, i, to_floats(load_vector(values, i)))


@compiled
def compute_with_vectors(floats, integers, counts, out, whole):
    x, y = load_vector(floats, 0), load_vector(floats, 3)
    store_vector(out, 0, x + y - 2.0 * x * y / (3 + y))
    store_vector(out, 8, 1.0 * (x <= y))
    store_vector(out, 16, 1.0 * (x <= 0.25))
    store_vector(out, 24, load_column(floats, 5) - broadcast(floats[1]))
    store_vector(out, 32, to_floats(load_vector(counts, 0) - load_vector(counts, 8)))
    store_vector(whole, 0, load_vector(integers, 0) - load_vector(integers, 8) + 7)
    store_vector(whole, 8, to_integers(to_floats(load_vector(counts, 0))))
    out[40] = sum_vector(x)


def test_integers_are_rounded_to_the_nearest_floats():
    bits = np.random.default_rng(0).integers(-(1 << 63), (1 << 63) - 1, 10_000)
    edges = np.array([-(1 << 63), (1 << 63) - 1, 0, (1 << 53) + 1, -1, 1, 1 << 32, -(1 << 32)])
    values = np.concatenate([bits >> shift for shift in range(64)] + [edges])
    floats = np.empty(values.size)
    convert_to_floats(values, floats)
    assert np.array_equal(floats, values.astype(np.float64))


def test_compiled_and_interpreted_vectors_agree():
    rng = np.random.default_rng(1)
    floats, integers = rng.standard_normal(LANES * LANES), rng.integers(-(1 << 63), (1 << 63) - 1, 16)
    counts = rng.integers(-(1 << 31), (1 << 31) - 1, 16).astype(np.int32)  # differences wrap around
    results = []
    for compute in (compute_with_vectors, compute_with_vectors.py_func):
        out, whole = np.zeros(41), np.zeros(16, np.int64)
        compute(floats, integers, counts, out, whole)
        results.append((out, whole))
    (out, whole), (expected, expected_whole) = results
    assert np.array_equal(out[:40], expected[:40])
    np.testing.assert_allclose(out[40], expected[40], rtol=1e-14)
    assert np.array_equal(whole, expected_whole)
    assert np.array_equal(out[24:32], floats[5::LANES] - floats[1])
