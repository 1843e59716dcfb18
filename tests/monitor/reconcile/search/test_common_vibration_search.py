"""Tests of the search for vibration that several axes share, and of leaks, shocks and independent noise."""

from functools import cache

import numpy as np
import pytest

from monitor.noise.effects import CommonVibration, CrossAxis
from monitor.reconcile.diagnostics.whiteness_tests import diagnose_leaks_from_other_axes
from monitor.reconcile.likelihood.hypothesis_fit import fit_with_model_sizes
from monitor.reconcile.likelihood.whitening import whiten_axis
from monitor.reconcile.search.common_vibration_search import (
    _cross_spectra_of_halves,
    _fit_gains_with_spectra,
    _Vibration,
    _without_weak_axes,
    build_cross_spectra,
    name_common_vibrations,
)
from monitor.reconcile.search.search import AxisSearchResult, search_missing_effects
from tests.monitor.reconcile.axes import (
    GYRO_AXES,
    STRICT,
    WALK,
    WHITE,
    N,
    axes,
    correlated,
    draw_resonance,
    walk,
    white,
)

n = 30_000
MODEL = (WHITE, WALK)
GAINS = {"gx": 2e-4, "gy": -4e-4, "gz": 3e-4}


@cache
def draw_noise(seed: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {name: white(n, rng) + walk(n, rng) for name in GYRO_AXES}


def add_vibration(unit: np.ndarray, seed: int = 0, names: tuple[str, ...] = GYRO_AXES) -> dict[str, np.ndarray]:
    return {name: y + (GAINS[name] * unit if name in names else 0.0) for name, y in draw_noise(seed).items()}


def search_all_axes(values: dict[str, np.ndarray]) -> dict[str, AxisSearchResult]:
    """Return the result of the search on each axis and of the search for common vibration."""
    null = dict.fromkeys(values, STRICT)
    each = {
        name: search_missing_effects(one, MODEL, STRICT, np.random.default_rng(1))
        for name, one in axes(values, MODEL).items()
    }
    return name_common_vibrations(each, null)


def list_vibrations(found: dict[str, AxisSearchResult]) -> dict[str, CommonVibration]:
    return {
        name: effect
        for name, one in found.items()
        for effect in one.hypothesis.added
        if isinstance(effect, CommonVibration)
    }


@pytest.mark.parametrize("names", [("gx", "gy"), GYRO_AXES], ids=len)
def test_resonance_of_several_axes_has_one_name(names):
    found = search_all_axes(add_vibration(draw_resonance(n, np.random.default_rng(5), 1.0, 17.0, 0.5), names=names))
    named = list_vibrations(found)
    assert set(named) == set(names)
    assert {one.source_number for one in named.values()} == {1.0}
    sign = np.sign(named["gx"].gain)  # the sign of the source is arbitrary
    for name, one in named.items():
        assert sign * one.gain == pytest.approx(GAINS[name], rel=0.2)
        assert one.frequency == pytest.approx(17.0, abs=0.2)
        assert [effect.name for effect in found[name].hypothesis.added] == ["common_vibration"]
        assert found[name].final.findings["other_axes"].gain < STRICT["other_axes"].threshold


def test_common_vibration_without_a_peak_is_found():
    named = list_vibrations(search_all_axes(add_vibration(correlated(n, np.random.default_rng(6), 1.0, 0.1))))
    assert set(named) == set(GYRO_AXES)
    for name, one in named.items():
        assert one.frequency is None
        assert abs(one.gain) == pytest.approx(abs(GAINS[name]), rel=0.2)
        assert one.bandwidth == pytest.approx(1.0 / (np.pi * 0.1), rel=0.3)


def test_common_vibration_whose_strength_varies_is_found_without_a_resonance_on_an_axis():
    unit = draw_resonance(n, np.random.default_rng(5), 1.0, 17.0, 4.0)
    vibration = 4e-4 * np.repeat([0.4, 1.4] * 5, n // 10) * unit
    noise = draw_noise(0)
    found = search_all_axes(noise | {"gx": noise["gx"] + vibration, "gy": noise["gy"] - vibration})
    assert set(list_vibrations(found)) == {"gx", "gy"}
    for one in list_vibrations(found).values():
        assert one.frequency == pytest.approx(17.0, abs=1.0)
        assert one.bandwidth == pytest.approx(4.0, rel=0.5)


@pytest.mark.parametrize("seed", range(3))
def test_equal_but_independent_resonances_are_no_common_vibration(seed):
    rng = np.random.default_rng(seed + 50)
    values = {name: y + GAINS[name] * draw_resonance(n, rng, 1.0, 17.0, 0.5) for name, y in draw_noise(seed).items()}
    assert list_vibrations(search_all_axes(values)) == {}


def test_leak_is_no_common_vibration():
    values = add_vibration(draw_resonance(n, np.random.default_rng(7), 1.0, 17.0, 0.5), names=("gx",))
    found = search_all_axes(values | {"gy": values["gy"] + 0.3 * values["gx"]})
    assert list_vibrations(found) == {}
    assert any(isinstance(effect, CrossAxis) for effect in found["gy"].hypothesis.added)


def test_two_axes_with_a_leak_are_not_searched():
    values = {name: y for name, y in draw_noise(4).items() if name != "gz"}
    found = search_all_axes(values | {"gy": values["gy"] + 0.3 * values["gx"]})
    assert list_vibrations(found) == {}
    assert any(isinstance(effect, CrossAxis) for one in found.values() for effect in one.hypothesis.added)


def test_knock_is_no_common_vibration():
    knock = np.zeros(n)
    knock[4000:4100] = 10.0 * np.random.default_rng(8).standard_normal(100)
    assert list_vibrations(search_all_axes(add_vibration(knock))) == {}


@pytest.mark.parametrize("leak", [0.0, 0.1])
def test_leak_beside_a_known_vibration_is_found(leak):
    unit = draw_resonance(60_000, np.random.default_rng(9), 1.0, 17.0, 0.5)
    rng = np.random.default_rng(3)
    values = {name: white(60_000, rng) + GAINS[name] * unit for name in ("gx", "gy")}
    values["gx"] -= leak * white(60_000, np.random.default_rng(11), N)
    values["gy"] += white(60_000, np.random.default_rng(11), N) if leak else 0.0
    effects = {
        name: (WHITE, CommonVibration(source_number=1, gain=GAINS[name], bandwidth=0.5, frequency=17.0))
        for name in values
    }
    one = axes(values, effects)["gx"]
    gain = diagnose_leaks_from_other_axes(whiten_axis(fit_with_model_sizes(one, effects["gx"]).fit)).gain
    alone = diagnose_leaks_from_other_axes(whiten_axis(fit_with_model_sizes(one, (WHITE,)).fit)).gain
    assert alone > 100.0
    assert (gain > 50.0) == (leak > 0.0)
    assert leak or gain < 8.0


@pytest.mark.parametrize("shared", ["whole", "first half", "not at all"])
def test_axis_belongs_to_a_vibration_with_evidence_in_both_halves(shared):
    shape, unit = (17.3, 1.0), draw_resonance(n, np.random.default_rng(7), 1.0, 17.3, 1.0)
    values = add_vibration(unit, 3, ("gx", "gy"))
    part = {"whole": n, "first half": n // 2, "not at all": 0}[shared]
    values["gz"] = values["gz"] + np.where(np.arange(n) < part, GAINS["gz"] * unit, 0.0)
    hypotheses = [fit_with_model_sizes(one, MODEL) for one in axes(values, MODEL).values()]
    whitened = [whiten_axis(one.fit) for one in hypotheses]
    spectra = build_cross_spectra(whitened, [shape])
    vibration = _Vibration(shape, np.array(list(GAINS.values())), 0.0)
    joint = _fit_gains_with_spectra(spectra, vibration, hypotheses)
    left = _without_weak_axes(joint, spectra, _cross_spectra_of_halves(joint, whitened, [shape]))
    assert (left.vibration.gains != 0.0).tolist() == [True, True, shared == "whole"]


def test_product_of_large_coefficients_is_limited_by_the_power_of_the_bin():
    k, at = np.arange(n), 10_000
    cosine = np.cos(np.pi * (k + 0.5) * at / n) * np.sqrt(2.0 / n)  # one row of the cosine transform
    size = {"gx": 30.0, "gy": 66.0, "gz": 0.0}
    values = {name: y + size[name] * N * 10.0 * cosine for name, y in draw_noise(3).items()}
    whitened = [whiten_axis(fit_with_model_sizes(one, MODEL).fit) for one in axes(values, MODEL).values()]
    spectra = build_cross_spectra(whitened, [(0.5 * 100.0 * at / n, 0.01)])
    assert (np.abs(spectra.products[0, 1]) <= spectra.bins.count * (1.0 + 1e-9)).all()
