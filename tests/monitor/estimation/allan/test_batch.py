"""Tests of the Allan variance of a whole recording against published values, allantools and exact sums."""

import csv
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from itertools import product

import allantools
import numpy as np
import pytest

from drivers.errors import ConfigError
from monitor.estimation.allan.batch import (
    BLOCK,
    LANES,
    cluster_sizes,
    overlapping_allan_variances,
    overlapping_avar,
    overlapping_avar_axis,
    rate_slope_from_thirds,
)
from tests.support.allan_references import avar_with_gaps, columns, mean_squares_with_gaps, nist_1000


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


@pytest.mark.parametrize(
    ("loss", "burst", "factors"),
    [
        (0.05, 1, [1, 2, 4, 8, 16, 32, 64, 128]),
        (0.2, 1, [1, 2, 3, 5, 7, 10, 50, 100]),  # the sizes 4 and 8 are missing, so all powers of two are added
        (0.1, 12, [100]),
        (0.02, 40, [3, 30, 250]),
    ],
)
def test_clusters_with_missing_samples_equal_the_definition(loss, burst, factors):
    rng = np.random.default_rng(burst)
    y = rng.standard_normal((500, 3)) + 0.1 * np.cumsum(rng.standard_normal((500, 3)), axis=0) + 5.0
    for axis in range(2):
        for begin in rng.integers(0, 500, round(500 * loss / burst)):
            y[begin : begin + burst, axis] = np.nan
    y[:, 2] = np.nan
    avar, terms, excess = overlapping_allan_variances(y, np.array(factors))
    for i, m in enumerate(factors):
        for axis in range(2):
            raw, count, _ = mean_squares_with_gaps(y[:, axis], m)
            assert terms[i, axis] == count
            assert avar[i, axis] + excess[i, axis] == pytest.approx(raw, rel=1e-11)
            assert avar[i, axis] == pytest.approx(avar_with_gaps(y[:, axis], m), rel=1e-11)
    assert not terms[:, 2].any()
    assert np.isnan(avar[:, 2]).all()


def test_interpolated_octaves_hardly_change_the_result():
    """A grid of ten sizes per decade contains no powers of two above 32."""
    rng = np.random.default_rng(2)
    y = rng.standard_normal(3000) + 0.05 * np.cumsum(rng.standard_normal(3000))
    y[rng.random(3000) < 0.1] = np.nan
    factors = cluster_sizes(3000, 1.0, "decade10")
    avar, _, excess = overlapping_allan_variances(y[:, None], factors)
    octaves = 2 ** np.arange(10)
    expected, _, wanted = overlapping_allan_variances(y[:, None], np.union1d(factors, octaves))
    at = np.searchsorted(np.union1d(factors, octaves), factors)
    assert excess[:, 0] == pytest.approx(wanted[at, 0], rel=0.02)
    assert avar[:, 0] == pytest.approx(expected[at, 0], rel=2e-3)


@pytest.mark.parametrize(
    ("noise", "loss"),
    [
        *product(["white", "random walk"], ["random", "bursts", "every 50th"]),
        *product(
            ["quantization"], ["random", "every 50th"]
        ),  # biased under bursts, see docs/explanation/missing-samples
    ],
)
def test_missing_samples_cause_no_bias(noise, loss):
    """Without the correction, the bias of white and quantization noise is 10 to 100 standard errors of the mean."""
    rng, n, records = np.random.default_rng(3), 2048, 400
    white = rng.standard_normal((n + 1, records))
    y = {"white": white[1:], "random walk": np.cumsum(white[1:], axis=0), "quantization": np.diff(white, axis=0)}[noise]
    factors = 2 ** np.arange(9)
    complete, _ = overlapping_avar(y, factors)
    present = np.ones(y.shape, bool)
    if loss == "random":
        present = rng.random(y.shape) >= 0.05
    elif loss == "every 50th":
        present[::50] = False
    else:
        for axis in range(records):
            for begin in rng.integers(0, n, 10):
                present[begin : begin + 10, axis] = False
    avar, _, _ = overlapping_allan_variances(np.where(present, y, np.nan), factors)
    change = avar - complete
    error = change.std(axis=1) / records**0.5
    assert (np.abs(change.mean(axis=1)) < np.maximum(4.0 * error, 0.1 * complete.std(axis=1))).all()


def test_offset_and_ramp_cancel_in_clusters_with_missing_samples():
    rng, factors = np.random.default_rng(4), 2 ** np.arange(11)
    y = 1e-3 * rng.standard_normal((20_000, 1))
    y[rng.random(len(y)) < 0.05] = np.nan
    plain, terms, _ = overlapping_allan_variances(y, factors)
    offset, _, _ = overlapping_allan_variances(y + 9.81, factors)
    assert offset == pytest.approx(plain, rel=1e-10)
    slope = 1e-6
    ramp, _, _ = overlapping_allan_variances(y + slope * np.arange(20_000.0)[:, None], factors)
    rise = (ramp - plain)[-2:, 0]
    assert rise == pytest.approx(0.5 * (slope * factors[-2:]) ** 2, rel=0.15)
    assert (terms > 0).all()


def compute_mean_squares_exactly(y, factors):
    """Compute half the mean square of the differences that count without rounding, with Python integers.

    The unit is the finest double. The squares are summed separately for each pair of sample counts.
    """
    parts = [Fraction(float(v)) if np.isfinite(v) else None for v in y]
    unit = max(part.denominator for part in parts if part is not None)
    phase, gaps = [0], [0]
    for part in parts:
        phase.append(phase[-1] + (0 if part is None else part.numerator * (unit // part.denominator)))
        gaps.append(gaps[-1] + (part is None))
    found = []
    for m in map(int, factors):
        sums, count = {}, 0
        for k in range(2 * m, len(phase)):
            older, newer = m - (gaps[k - m] - gaps[k - 2 * m]), m - (gaps[k] - gaps[k - m])
            if 5 * min(older, newer) >= 3 * m:
                d = (phase[k] - phase[k - m]) * older - (phase[k - m] - phase[k - 2 * m]) * newer
                sums[older * newer] = sums.get(older * newer, 0) + d * d
                count += 1
        total = sum(Fraction(total, shares * shares) for shares, total in sums.items())
        found.append(float(total / (2 * unit * unit * count)))
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
    assert avar == pytest.approx(compute_mean_squares_exactly(y, factors), rel=within)
    assert terms.tolist() == (n + 1 - 2 * factors).tolist()


def test_gaps_in_a_long_recording_leave_the_sum_exact():
    n = BLOCK + 3 * LANES + 17  # more than one block and an incomplete row
    rng = np.random.default_rng(4)
    y = 9.81 + simulate_random_walk(rng, n)
    y[rng.integers(0, n, 5)] = np.nan
    y[[0, n - 1, BLOCK - 1, BLOCK, BLOCK + 1]] = [np.inf, -np.inf, np.nan, np.nan, np.nan]
    factors = np.array([1, 5, 100, 700])
    avar, terms, excess = overlapping_allan_variances(y[:, None], factors)
    assert (avar + excess)[:, 0] == pytest.approx(compute_mean_squares_exactly(y, factors), rel=1e-14)
    assert (terms > 0).all()


@pytest.mark.parametrize(
    ("added", "within"),
    [(lambda n: 9.81, 1e-12), (lambda n: np.linspace(8.81, 10.81, n), 1e-9)],  # 20 000 times the noise
    ids=["gravity", "steep ramp"],
)
def test_random_loss_keeps_the_precision(added, within):
    n = 12_000
    rng = np.random.default_rng(8)
    y = simulate_random_walk(rng, n) + added(n)
    y[rng.random(n) < 0.1] = np.nan
    factors = np.array([1, 4, 7, 64, 1000, 5000])
    avar, _, excess = overlapping_allan_variances(y[:, None], factors)
    assert (avar + excess)[:, 0] == pytest.approx(compute_mean_squares_exactly(y, factors), rel=within)


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
    y[700:810, 1] = np.nan
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
