"""Tests of the methods that are compared with ``reconcile``, and of their score."""

import numpy as np
import pytest

from drivers.data_types import Floats
from monitor.noise.effects import AngleRandomWalk, QuantizationNoise, Sinusoidal
from monitor.noise.model import NoiseModel
from tests.experiments.benchmarks import five_terms, peers
from tests.experiments.benchmarks.peers import FoundEffect
from tests.experiments.blind.score import Outcome, score

RATE_HZ = 100.0
SAMPLES = 40_000
WHITE = NoiseModel({"gx": (AngleRandomWalk(N=0.1),), "ax": (AngleRandomWalk(N=0.1),)})  # variance 1 a sample
TRUTH = {
    "case": "cross_axis",
    "level": "plain",
    "seed": 0,
    "baseline": "exact",
    "hidden": [
        {
            "axis": "gx",
            "effect": "cross_axis",
            "parameters": {"source": "gy", "coefficient": 0.1},
            "gain": 60.0,
            "margin": 20.0,
        },
    ],
    "foreign": [],
}


def simulate_noise(seed: int) -> dict[str, Floats]:
    rng = np.random.default_rng(seed)
    return {"gx": rng.normal(size=SAMPLES), "ax": 9.81 + rng.normal(size=SAMPLES)}


def score_names(*names: FoundEffect) -> Outcome:
    return score(TRUTH, peers.make_report(names), 0, 1.0)


def test_wavelet_variance_of_the_baseline_is_half_its_allan_variance() -> None:
    baseline = peers.describe_baseline("gx", 1024, RATE_HZ, WHITE)
    assert baseline.variance == pytest.approx(1.0 / 2.0 ** np.arange(1, 11))
    assert baseline.density == pytest.approx(np.ones(512))


@pytest.mark.parametrize("peer", [peers.rank_models, peers.rank_additions])
def test_ranking_names_a_ramp_but_no_term_of_the_model(peer: peers.Peer) -> None:
    columns = simulate_noise(1)
    columns["ax"] += 2e-4 * np.arange(SAMPLES)
    found = list(peer(columns, RATE_HZ, WHITE, 0))
    assert FoundEffect("ax", "rate_ramp") in found
    assert all(one.effect != "angle_random_walk" for one in found)


@pytest.mark.parametrize("peer", [peers.rank_models, peers.rank_additions])
def test_increased_term_of_the_model_is_no_name(peer: peers.Peer) -> None:
    columns = {axis: 1.5 * values for axis, values in simulate_noise(2).items()}
    assert list(peer(columns, RATE_HZ, WHITE, 0)) == []


def test_rankings_name_a_term_that_the_model_lacks() -> None:
    error = np.diff(np.random.default_rng(30).normal(size=SAMPLES + 1))
    columns = {"gx": simulate_noise(3)["gx"] + error}
    quantized = NoiseModel({"gx": (*WHITE.effects["gx"], QuantizationNoise(Q=0.01))})
    assert FoundEffect("gx", "quantization_noise") in peers.rank_additions(columns, RATE_HZ, WHITE, 0)
    assert list(peers.rank_additions(columns, RATE_HZ, quantized, 0)) == []


def test_five_terms_and_notes_become_names() -> None:
    columns = simulate_noise(4)
    t_s = np.arange(SAMPLES) / RATE_HZ
    columns["gx"] += 0.5 * np.sin(2.0 * np.pi * 7.3 * t_s)
    columns["gx"][np.random.default_rng(40).permutation(SAMPLES)[:200]] += 40.0
    columns["ax"] = np.round(columns["ax"])
    line = NoiseModel({**WHITE.effects, "gx": (*WHITE.effects["gx"], Sinusoidal(amplitude=0.5, frequency=7.3))})
    found = five_terms.find_names(columns, RATE_HZ, WHITE)
    assert {("gx", "sinusoidal"), ("gx", "outliers"), ("ax", "resolution")} <= found
    assert found - five_terms.find_names(columns, RATE_HZ, line) == {("gx", "sinusoidal")}
    assert {axis for axis, _ in found} == {"gx", "ax"}


def test_five_terms_of_white_noise_are_no_names() -> None:
    assert five_terms.find_names(simulate_noise(5), RATE_HZ, WHITE) == set()
    assert ("gx", "angle_random_walk") in five_terms.find_names(simulate_noise(5), RATE_HZ, NoiseModel())


def test_names_are_scored_with_their_axis_and_source() -> None:
    assert score_names(FoundEffect("gx", "cross_axis", "gy")).right
    assert score_names(FoundEffect("gx", "cross_axis", "gz")).missed
    other = score_names(FoundEffect("gx", "cross_axis", "gy"), FoundEffect("gy", "rate_ramp"))
    assert not other.missed
    assert [one.effect for one in other.false] == ["rate_ramp"]
    assert score_names().missed


def test_tables_count_names_and_false_ones() -> None:
    found = {
        "reconcile": [score_names(FoundEffect("gx", "cross_axis", "gy")), score_names(FoundEffect("gy", "rate_ramp"))]
    }
    assert "1 of 2" in peers.summary(found)
    assert "| `cross_axis` | 1 of 2, 1 false |" in peers.by_effect(found)
