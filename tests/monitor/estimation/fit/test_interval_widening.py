"""Tests of the increase of the interval widths that missing samples cause."""

import numpy as np
import pytest

from drivers.data_types import make_block
from monitor.estimation.analysis import analyze
from monitor.estimation.estimator import Estimator

RATE = 100.0


def simulate_values(n: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return 1e-3 * rng.standard_normal((n, 6)) + np.cumsum(5e-6 * rng.standard_normal((n, 6)), axis=0) + 9.81


def add_recording(values: np.ndarray, estimator: Estimator) -> None:
    estimator.add_samples(make_block(10_000_000 * np.arange(len(values)), values))


def widths(values: np.ndarray) -> np.ndarray:
    found = analyze([make_block(10_000_000 * np.arange(len(values)), values)], RATE).estimate.coefficients
    return found.hi - found.lo


@pytest.mark.parametrize("share", [0.05, 0.2])
def test_stated_widening_is_that_of_the_widths_with_and_without_loss(share: float) -> None:
    whole = simulate_values(360_000, 1)
    lossy = np.where(np.random.default_rng(2).random((len(whole), 1)) < share, np.nan, whole)
    estimator = Estimator(RATE, 3600.0)
    add_recording(lossy, estimator)
    estimator.get_converged_estimate()
    loss = estimator.loss_of_samples()
    assert loss.share == np.isnan(lossy).mean()
    ratio = np.median(widths(lossy) / widths(whole), axis=1) - 1.0
    assert loss.wider["N"] == pytest.approx(ratio[1], abs=0.01)
    assert loss.wider["K"] == pytest.approx(ratio[3], abs=0.02)


def test_complete_window_has_no_loss_and_samples_that_left_the_window_do_not_count() -> None:
    values = simulate_values(3000, 3)
    values[100:200] = np.nan
    values[1500:1600, 2] = np.nan
    estimator = Estimator(RATE, 20.0)
    add_recording(values[:2000], estimator)
    estimator.get_estimate()
    assert estimator.loss_of_samples().share == 0.1
    add_recording(values[2000:], estimator)
    estimator.get_estimate()
    assert estimator.loss_of_samples().share == 0.05
    estimator.restart_axis(2, 1000)
    estimator.get_estimate()
    loss = estimator.loss_of_samples()
    assert (loss.share, loss.wider) == (0.0, {})


def test_axis_without_samples_is_no_loss() -> None:
    values = simulate_values(2000, 4)
    values[:, 3:] = np.nan
    estimator = Estimator(RATE, 20.0)
    add_recording(values, estimator)
    estimator.get_estimate()
    assert estimator.loss_of_samples().share == 0.0
