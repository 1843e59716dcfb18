"""The whole-recording curve against published numbers and against allantools."""

import csv
import gzip
import os
from pathlib import Path

import allantools
import numpy as np
import pytest

from drivers.errors import ConfigError
from monitor.estimate.batch import cluster_sizes, overlapping


@pytest.fixture
def reference() -> Path:
    if "IMU_MONITOR_DATA" not in os.environ:
        pytest.skip("IMU_MONITOR_DATA does not point to the recordings")
    return Path(os.environ["IMU_MONITOR_DATA"]) / "reference"


def nist_1000():
    """The 1000 points of NIST SP 1065, 12.4: a prime-modulus generator."""
    n, points = 1234567890, []
    for _ in range(1000):
        points.append(n / 2147483647)
        n = 16807 * n % 2147483647
    return np.array(points)


def columns(path: Path, *names: str):
    with gzip.open(path, "rt") if path.suffix == ".gz" else path.open() as stream:
        rows = list(csv.DictReader(stream))
    return [np.array([float(row[name]) for row in rows]) for name in names]


def deviations(y, factors):
    avar, terms = overlapping(np.asarray(y, float)[:, None], np.asarray(factors, np.int64))
    return np.sqrt(avar[:, 0]), terms[:, 0]


def test_thousand_points_of_nist_sp_1065():
    found, terms = deviations(nist_1000(), [1, 10, 100])
    assert found == pytest.approx([2.922319e-01, 9.159953e-02, 3.241343e-02], abs=5e-8)
    assert terms.tolist() == [999, 981, 801]


@pytest.mark.parametrize("offset", [0.0, 9.81, -1e3])
@pytest.mark.parametrize("seed", range(4))
def test_equals_allantools(seed, offset):
    rng = np.random.default_rng(seed)
    y = 1e-2 * rng.standard_normal(3000) + 1e-4 * np.cumsum(rng.standard_normal(3000))
    factors = np.unique(rng.integers(1, 1500, 12))
    found, _ = deviations(y + offset, factors)
    _, expected, _, terms = allantools.oadev(y, rate=1.0, data_type="freq", taus=factors)
    # the offset costs the input itself digits: 2^-53 of it
    within = 1e-10 if not offset else 1e-8
    assert found[: len(expected)] == pytest.approx(expected, rel=within)
    assert (terms > 0).all()


def test_missing_samples_strike_out_the_terms_that_touch_them():
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
        avar, terms = overlapping(y, np.array([m]))
        assert terms.tolist() == [[len(squares), 0]]
        assert avar[0, 0] == pytest.approx(0.5 * np.mean(squares), rel=1e-12)
        assert np.isnan(avar[0, 1])


def test_too_long_clusters_have_no_answer():
    avar, terms = overlapping(np.ones((10, 1)), np.array([5, 6]))
    assert avar[0, 0] == 0.0
    assert np.isnan(avar[1, 0])
    assert terms.ravel().tolist() == [1, 0]


def test_input_is_left_alone():
    y = np.random.default_rng(0).standard_normal((50, 6)) + 3.0
    before = y.copy()
    overlapping(y, np.array([1, 2]))
    assert np.array_equal(y, before)


# --- published results on real data


@pytest.mark.data
def test_phase_dat_of_stable32(reference):
    (x,) = columns(reference / "phase-dat.csv", "x")
    m, dev, n = columns(reference / "phase-dat-stable32-oadev.csv", "m", "dev", "n")
    found, terms = deviations(np.diff(x), m)
    # the last rows are printed with fewer digits than the others
    assert found == pytest.approx(dev, rel=5e-5)
    assert terms.tolist() == n.astype(int).tolist()


@pytest.mark.data
def test_pink_noise_of_stable32(reference):
    (y,) = columns(reference / "pink-frequency.csv", "y")
    m, dev = columns(reference / "pink-stable32-oadev.csv", "m", "dev")
    found, _ = deviations(y, m)
    assert found == pytest.approx(dev, rel=5e-5)


@pytest.mark.data
def test_oscillator_of_stable32(reference):
    (f,) = columns(reference / "ocxo-frequency.csv.gz", "y")
    m, dev = columns(reference / "ocxo-stable32-oadev-octave-ci.csv", "m", "dev")
    found, _ = deviations(f / 1e7 - 1.0, m)
    assert found == pytest.approx(dev, rel=1.5e-3)


@pytest.mark.data
def test_adis16405_of_the_avar_package(reference):
    with (reference / "avar-package-allan-tables.csv").open() as stream:
        rows = [
            r for r in csv.DictReader(stream) if r["key"] == "adis" and r["type"] == "Gyroscope" and r["axis"] == "X"
        ]
    gx = np.load(reference.parent / "adis16405" / "run1.npz")["gx"].astype(float)
    factors = [2 ** (i + 1) for i in range(len(rows))]
    listed = np.array([float(r["adev"]) for r in rows])
    found, _ = deviations(np.rad2deg(gx), factors)
    single, _ = deviations(np.rad2deg(gx), [1])
    # the package lists τ of 2, 4, 8, … samples' spans or 1, 2, 4, …: whichever, all rows must fit one of them
    ones = np.concatenate([single, found[:-1]])
    assert min(np.max(np.abs(found / listed - 1)), np.max(np.abs(ones / listed - 1))) < 1e-5


# --- grids


@pytest.mark.parametrize("samples", [1, 2, 3, 4, 8, 100, 1000, 1023, 1024, 1025, 360_000])
@pytest.mark.parametrize("tau", ["octave", "decade10"])
def test_grids_ascend_from_one_to_a_quarter(samples, tau):
    factors = cluster_sizes(samples, 100.0, tau)
    assert factors[0] == 1
    assert (np.diff(factors) > 0).all()
    assert factors[-1] <= max(samples // 4, 1)
    assert factors[-1] > 0.35 * samples / 4 or samples < 8


def test_listed_tau_become_their_nearest_clusters():
    assert cluster_sizes(1000, 100.0, (0.01, 0.1, 0.104, 1.0, 5.0, 5.02, 100.0, 0.001)).tolist() == [1, 10, 100, 500]


def test_a_list_without_a_possible_tau_says_what_is_possible():
    with pytest.raises(ConfigError, match=r"one sample \(0.01 s\).*half the window \(5 s\)"):
        cluster_sizes(1000, 100.0, (0.001, 6.0))
