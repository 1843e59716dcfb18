"""Tests of the Allan variance of a whole recording against published values, allantools and exact sums."""

import csv
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction

import allantools
import numpy as np
import pytest

from drivers.errors import ConfigError
from monitor.estimation.allan.batch import (
    BLOCK,
    LANES,
    cluster_sizes,
    overlapping_avar,
    overlapping_avar_axis,
    rate_slope_from_thirds,
)
from tests.support.allan_references import columns, nist_1000


def compute_deviations(y, factors):
    avar, terms = overlapping_avar(np.asarray(y, float)[:, None], np.asarray(factors, np.int64))
    return np.sqrt(avar[:, 0]), terms[:, 0]


def test_nist_sp_1065_values_are_reproduced():
    found, terms = compute_deviations(nist_1000(), [1, 10, 100])
    assert found == pytest.approx([2.922319e-01, 9.159953e-02, 3.241343e-02], abs=5e-8)
    assert terms.tolist() == [999, 981, 801]


@pytest.mark.parametrize("offset", [0.0, 9.81, -1e3])
@pytest.mark.parametrize("seed", range(4))
def test_deviations_equal_allantools(seed, offset):
    rng = np.random.default_rng(seed)
    y = 1e-2 * rng.standard_normal(3000) + 1e-4 * np.cumsum(rng.standard_normal(3000))
    factors = np.unique(rng.integers(1, 1500, 12))
    found, _ = compute_deviations(y + offset, factors)
    _, expected, _, terms = allantools.oadev(y, rate=1.0, data_type="freq", taus=factors)
    # an offset reduces the precision of the input to 2^-53 of the offset
    within = 1e-10 if not offset else 1e-8
    assert found[: len(expected)] == pytest.approx(expected, rel=within)
    assert (terms > 0).all()


def test_terms_with_missing_samples_are_left_out():
    rng = np.random.default_rng(1)
    y = rng.standard_normal((60, 2)) + 5.0
    y[[7, 30, 31, 59], 0] = np.nan
    y[:, 1] = np.nan
    for m in (1, 2, 5, 11):
        squares = []
        for k in range(60 - 2 * m + 1):
            span = y[k : k + 2 * m, 0]
            if not np.isnan(span).any():
                squares.append((span[m:].mean() - span[:m].mean()) ** 2)
        avar, terms = overlapping_avar(y, np.array([m]))
        assert terms.tolist() == [[len(squares), 0]]
        assert avar[0, 0] == pytest.approx(0.5 * np.mean(squares), rel=1e-12)
        assert np.isnan(avar[0, 1])


def compute_avar_exactly(y, factors):
    """Compute the variance without rounding, with Python integers in units of the finest double.

    Terms that contain a sample that is not finite are left out.
    """
    parts = [Fraction(float(v)) if np.isfinite(v) else None for v in y]
    unit = max(part.denominator for part in parts if part is not None)
    phase, gaps = [0], [0]
    for part in parts:
        phase.append(phase[-1] + (0 if part is None else part.numerator * (unit // part.denominator)))
        gaps.append(gaps[-1] + (part is None))
    found = []
    for m in map(int, factors):
        whole = [k for k in range(2 * m, len(phase)) if gaps[k] == gaps[k - 2 * m]]
        total = sum((phase[k] - 2 * phase[k - m] + phase[k - 2 * m]) ** 2 for k in whole)
        found.append(float(Fraction(total, 2 * m * m * unit * unit * len(whole))))
    return found


def simulate_random_walk(rng, n):
    return 1e-4 * rng.standard_normal(n) + 1e-6 * np.cumsum(rng.standard_normal(n))


@pytest.mark.parametrize(
    ("added", "within"),
    [
        (lambda n: 0.0, 1e-14),
        (lambda n: 9.81, 1e-14),
        (lambda n: -1e4, 1e-14),
        (lambda n: 9.81 + 100.0 * (np.arange(n) == n // 2), 1e-14),
        (lambda n: np.linspace(8.81, 10.81, n), 1e-10),  # 20 000 times the noise
    ],
    ids=["nothing", "gravity", "large mean", "single spike", "steep ramp"],
)
def test_avar_equals_a_sum_without_rounding(added, within):
    n = 12_000
    y = simulate_random_walk(np.random.default_rng(3), n) + added(n)
    factors = np.array([1, 2, 3, 7, 64, 1000, 3000, 6000])
    avar, terms = overlapping_avar_axis(y, factors)
    assert avar == pytest.approx(compute_avar_exactly(y, factors), rel=within)
    assert terms.tolist() == (n + 1 - 2 * factors).tolist()


def test_gaps_in_a_long_recording_leave_the_sum_exact():
    n = BLOCK + 3 * LANES + 17  # more than one block and an incomplete row
    rng = np.random.default_rng(4)
    y = 9.81 + simulate_random_walk(rng, n)
    y[rng.integers(0, n, 5)] = np.nan
    y[[0, n - 1, BLOCK - 1, BLOCK, BLOCK + 1]] = [np.inf, -np.inf, np.nan, np.nan, np.nan]
    factors = np.array([1, 5, 100, 700])
    avar, terms = overlapping_avar_axis(y, factors)
    assert avar == pytest.approx(compute_avar_exactly(y, factors), rel=1e-14)
    assert (terms > 0).all()


@pytest.mark.parametrize("n", [BLOCK - 1, BLOCK, 2 * BLOCK, 2 * BLOCK + 1, 3 * BLOCK + LANES - 1])
def test_blocks_and_rows_are_joined_exactly(n):
    y = np.random.default_rng(n).standard_normal(n)
    factors = np.array([1, LANES - 1, LANES, BLOCK // 4, BLOCK // 2 - 1, BLOCK // 2, n // 2])
    expected = allantools.oadev(y, rate=1.0, data_type="freq", taus=factors)[1]
    found, terms = overlapping_avar_axis(y, factors)
    assert np.sqrt(found)[: len(expected)] == pytest.approx(expected, rel=1e-12)
    assert terms.tolist() == (n + 1 - 2 * factors).tolist()


def test_single_precision_input_is_summed_in_double():
    y = (9.81 + 1e-3 * np.random.default_rng(5).standard_normal((30_000, 2))).astype(np.float32)
    factors = 2 ** np.arange(12)
    assert overlapping_avar(y, factors)[0] == pytest.approx(
        overlapping_avar(y.astype(np.float64), factors)[0], rel=1e-15
    )
    assert rate_slope_from_thirds(y) == pytest.approx(rate_slope_from_thirds(y.astype(np.float64)), rel=1e-12)


def test_parallel_axes_give_the_same_result():
    y = np.random.default_rng(6).standard_normal((5000, 6))
    y[77, 2] = np.nan
    with ThreadPoolExecutor(3) as pool:
        avar, terms = overlapping_avar(y, np.array([1, 10, 100]), map_axes=pool.map)
    assert avar.tolist() == overlapping_avar(y, np.array([1, 10, 100]))[0].tolist()
    assert terms[0].tolist() == [4999, 4999, 4997, 4999, 4999, 4999]


def test_rate_slope_ignores_missing_samples_and_needs_enough_samples():
    y = np.random.default_rng(7).standard_normal((1001, 3)) + 0.01 * np.arange(1001.0)[:, None]
    y[500, 1], y[600, 2], y[601, 2] = np.nan, np.inf, -np.inf
    found = rate_slope_from_thirds(y)
    assert found[0] == pytest.approx((y[668:, 0].mean() - y[2:335, 0].mean()) / 666.0, rel=1e-12)
    assert found[1:] == pytest.approx((y[668:, 1:].mean(axis=0) - y[2:335, 1:].mean(axis=0)) / 666.0, rel=1e-12)
    y[700:720, 1] = np.nan
    assert np.isnan(rate_slope_from_thirds(y)).tolist() == [False, True, False]
    assert np.isnan(rate_slope_from_thirds(y[:2])).all()


def test_too_long_clusters_give_no_value():
    avar, terms = overlapping_avar(np.ones((10, 1)), np.array([5, 6]))
    assert avar[0, 0] == 0.0
    assert np.isnan(avar[1, 0])
    assert terms.ravel().tolist() == [1, 0]


def test_input_is_not_modified():
    y = np.random.default_rng(0).standard_normal((50, 6)) + 3.0
    before = y.copy()
    overlapping_avar(y, np.array([1, 2]))
    assert np.array_equal(y, before)


# --- published results on real data


@pytest.mark.data
def test_stable32_values_of_phase_dat_are_reproduced(reference):
    (x,) = columns(reference / "phase-dat.csv", "x")
    m, dev, n = columns(reference / "phase-dat-stable32-oadev.csv", "m", "dev", "n")
    found, terms = compute_deviations(np.diff(x), m)
    # The last rows are printed with fewer digits.
    assert found == pytest.approx(dev, rel=5e-5)
    assert terms.tolist() == n.astype(int).tolist()


@pytest.mark.data
def test_stable32_values_of_pink_noise_are_reproduced(reference):
    (y,) = columns(reference / "pink-frequency.csv", "y")
    m, dev = columns(reference / "pink-stable32-oadev.csv", "m", "dev")
    found, _ = compute_deviations(y, m)
    assert found == pytest.approx(dev, rel=5e-5)


@pytest.mark.data
def test_stable32_values_of_an_oscillator_are_reproduced(reference):
    (f,) = columns(reference / "ocxo-frequency.csv.gz", "y")
    m, dev = columns(reference / "ocxo-stable32-oadev-octave-ci.csv", "m", "dev")
    found, _ = compute_deviations(f / 1e7 - 1.0, m)
    assert found == pytest.approx(dev, rel=1.5e-3)


@pytest.mark.data
def test_avar_package_values_of_adis16405_are_reproduced(reference):
    with (reference / "avar-package-allan-tables.csv").open() as stream:
        rows = [
            r for r in csv.DictReader(stream) if r["key"] == "adis" and r["type"] == "Gyroscope" and r["axis"] == "X"
        ]
    gx = np.load(reference.parent / "adis16405" / "run1.npz")["gx"].astype(float)
    factors = [2 ** (i + 1) for i in range(len(rows))]
    listed = np.array([float(r["adev"]) for r in rows])
    found, _ = compute_deviations(np.rad2deg(gx), factors)
    single, _ = compute_deviations(np.rad2deg(gx), [1])
    # The package lists τ of either 2, 4, 8, … or 1, 2, 4, … samples. All rows must agree with one of these lists.
    shifted = np.concatenate([single, found[:-1]])
    assert min(np.max(np.abs(found / listed - 1)), np.max(np.abs(shifted / listed - 1))) < 1e-5


# --- grids


@pytest.mark.parametrize("samples", [1, 2, 3, 4, 8, 100, 1000, 1023, 1024, 1025, 360_000])
@pytest.mark.parametrize("tau", ["octave", "decade10"])
def test_cluster_sizes_increase_from_one_to_a_quarter_of_the_samples(samples, tau):
    factors = cluster_sizes(samples, 100.0, tau)
    assert factors[0] == 1
    assert (np.diff(factors) > 0).all()
    assert factors[-1] <= max(samples // 4, 1)
    assert factors[-1] > 0.35 * samples / 4 or samples < 8


def test_listed_tau_give_the_nearest_cluster_sizes():
    assert cluster_sizes(1000, 100.0, (0.01, 0.1, 0.104, 1.0, 5.0, 5.02, 100.0, 0.001)).tolist() == [1, 10, 100, 500]


def test_list_without_a_possible_tau_is_refused_with_the_range():
    with pytest.raises(ConfigError, match=r"one sample \(0.01 s\).*half the window \(5 s\)"):
        cluster_sizes(1000, 100.0, (0.001, 6.0))
