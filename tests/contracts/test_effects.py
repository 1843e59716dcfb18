"""What every effect must pass, found by listing ``EFFECTS``: simulated data have the stated σ² and spectrum."""

import inspect
import pkgutil
from dataclasses import fields

import allantools
import numpy as np
import pytest
from scipy.signal import welch

import monitor.noise.effects as folder
from drivers.errors import ConfigError
from monitor.noise.effect import Source, units
from monitor.noise.effects import EFFECTS

RATE_HZ = 50.0
N = 1 << 17
RUNS = 12

NAMES = sorted(EFFECTS)


def example(name: str) -> Source:
    """The effect with every parameter at a value that is not one, so that a lost square shows."""
    return EFFECTS[name](**dict.fromkeys(units(EFFECTS[name]), 0.3))


def series(name: str, seed: int, n: int = N) -> np.ndarray:
    return example(name).start(RATE_HZ, np.random.default_rng(seed)).draw(n)


def test_every_file_of_the_folder_is_listed():
    assert sorted(m.name for m in pkgutil.iter_modules(folder.__path__)) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_says_what_it_is(name):
    effect = EFFECTS[name]
    assert effect.name == name
    assert effect.means.endswith(".")
    assert effect.means.count("\n") == 0
    assert all(gyro and accelerometer for gyro, accelerometer in units(effect).values())
    assert inspect.getdoc(inspect.getmodule(effect))
    assert ">>>" in inspect.getdoc(effect)


@pytest.mark.parametrize("name", NAMES)
def test_simulated_allan_variance_is_the_stated_one(name):
    factors = 2 ** np.arange(0, 13, 2)
    runs = []
    for seed in range(RUNS):
        measured = allantools.oadev(series(name, seed), rate=RATE_HZ, data_type="freq", taus=factors / RATE_HZ)
        runs.append(measured[1] ** 2)
    stated = example(name).avar(factors / RATE_HZ, 1.0 / RATE_HZ)
    error = np.std(runs, axis=0) / np.sqrt(RUNS)
    # five standard errors, and rounding: for a ramp or a constant nothing is random
    np.testing.assert_array_less(np.abs(np.mean(runs, axis=0) - stated), 5.0 * error + 1e-6 * stated + 1e-20)


@pytest.mark.parametrize("name", NAMES)
def test_simulated_spectrum_is_the_stated_one(name):
    # the Hann window keeps a walk's steep spectrum out of the higher frequencies; the lowest bins feel
    # the window and the detrending
    runs = [welch(series(name, seed), RATE_HZ, nperseg=1024, detrend="linear") for seed in range(RUNS)]
    f = runs[0][0][8:-1]
    measured = np.mean([density[8:-1] for _, density in runs], axis=0) / 2.0  # one-sided to two-sided
    stated = example(name).psd(f, 1.0 / RATE_HZ)
    if not stated.any():
        assert measured.max() < 1e-12
        return
    # groups of 25 bins of 3000 segments: scatter 0.5 %; leakage costs another percent
    for group in np.array_split(np.arange(f.size), 20):
        assert np.mean(measured[group] / stated[group]) == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("name", NAMES)
def test_blocks_of_any_size_give_the_same_series(name):
    whole = series(name, 5, 2000)
    started = example(name).start(RATE_HZ, np.random.default_rng(5))
    pieces = [started.draw(n) for n in (1, 0, 2, 7, 990, 1000)]
    np.testing.assert_array_equal(np.concatenate(pieces), whole)


@pytest.mark.parametrize("name", NAMES)
def test_same_seed_same_series_other_seed_another(name):
    np.testing.assert_array_equal(series(name, 1, 100), series(name, 1, 100))
    random = not np.array_equal(series(name, 1, 100), series(name, 2, 100))
    assert random == bool(example(name).psd(np.array([1.0]), 1.0 / RATE_HZ)[0] > 0.0)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("bad", [np.nan, np.inf, "1", True, None])
def test_refuses_what_is_no_number(name, bad):
    with pytest.raises(ConfigError, match=name):
        EFFECTS[name](**dict.fromkeys(units(EFFECTS[name]), bad))


@pytest.mark.parametrize("name", NAMES)
def test_refuses_negative_sizes(name):
    signed = {f.name for f in fields(EFFECTS[name]) if f.metadata["signed"]}
    for parameter in set(units(EFFECTS[name])) - signed:
        with pytest.raises(ConfigError, match=f"{parameter} must not be negative"):
            EFFECTS[name](**{**dict.fromkeys(units(EFFECTS[name]), 1.0), parameter: -1.0})
