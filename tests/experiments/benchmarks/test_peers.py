"""What peers say of plain series becomes names, and names are scored as those of ``reconcile`` are."""

import numpy as np
import pytest

from drivers.data_types import Floats
from monitor.noise.effects import AngleRandomWalk, QuantizationNoise, Sinusoidal
from monitor.noise.model import NoiseModel
from tests.experiments.benchmarks import five_terms, peers
from tests.experiments.benchmarks.peers import Named
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


def noise(seed: int) -> dict[str, Floats]:
    rng = np.random.default_rng(seed)
    return {"gx": rng.normal(size=SAMPLES), "ax": 9.81 + rng.normal(size=SAMPLES)}


def said(*names: Named) -> Outcome:
    return score(TRUTH, peers.as_report(names), 0, 1.0)


def test_baseline_of_an_axis_is_half_its_allan_variance() -> None:
    law = peers.law_of("gx", 1024, RATE_HZ, WHITE)
    assert law.variance == pytest.approx(1.0 / 2.0 ** np.arange(1, 11))
    assert law.density == pytest.approx(np.ones(512))


@pytest.mark.parametrize("peer", [peers.ranking, peers.beside])
def test_ranking_names_a_ramp_and_not_what_the_model_has(peer: peers.Peer) -> None:
    columns = noise(1)
    columns["ax"] += 2e-4 * np.arange(SAMPLES)
    found = list(peer(columns, RATE_HZ, WHITE, 0))
    assert Named("ax", "rate_ramp") in found
    assert all(one.effect != "angle_random_walk" for one in found)


@pytest.mark.parametrize("peer", [peers.ranking, peers.beside])
def test_more_of_a_known_term_is_no_name(peer: peers.Peer) -> None:
    columns = {axis: 1.5 * values for axis, values in noise(2).items()}
    assert list(peer(columns, RATE_HZ, WHITE, 0)) == []


def test_rankings_name_a_term_that_the_model_lacks() -> None:
    error = np.diff(np.random.default_rng(30).normal(size=SAMPLES + 1))
    columns = {"gx": noise(3)["gx"] + error}
    quantized = NoiseModel({"gx": (*WHITE.effects["gx"], QuantizationNoise(Q=0.01))})
    assert Named("gx", "quantization_noise") in peers.beside(columns, RATE_HZ, WHITE, 0)
    assert list(peers.beside(columns, RATE_HZ, quantized, 0)) == []


def test_five_terms_and_notes_become_names() -> None:
    columns = noise(4)
    t_s = np.arange(SAMPLES) / RATE_HZ
    columns["gx"] += 0.5 * np.sin(2.0 * np.pi * 7.3 * t_s)
    columns["gx"][np.random.default_rng(40).permutation(SAMPLES)[:200]] += 40.0
    columns["ax"] = np.round(columns["ax"])
    line = NoiseModel({**WHITE.effects, "gx": (*WHITE.effects["gx"], Sinusoidal(amplitude=0.5, frequency=7.3))})
    found = five_terms.names(columns, RATE_HZ, WHITE)
    assert {("gx", "sinusoidal"), ("gx", "outliers"), ("ax", "resolution")} <= found
    assert found - five_terms.names(columns, RATE_HZ, line) == {("gx", "sinusoidal")}
    assert {axis for axis, _ in found} == {"gx", "ax"}


def test_plain_noise_gets_no_name_from_five_terms() -> None:
    assert five_terms.names(noise(5), RATE_HZ, WHITE) == set()
    assert ("gx", "angle_random_walk") in five_terms.names(noise(5), RATE_HZ, NoiseModel())


def test_names_are_scored_with_their_axis_and_source() -> None:
    assert said(Named("gx", "cross_axis", "gy")).right
    assert said(Named("gx", "cross_axis", "gz")).missed
    other = said(Named("gx", "cross_axis", "gy"), Named("gy", "rate_ramp"))
    assert not other.missed
    assert [one.effect for one in other.false] == ["rate_ramp"]
    assert said().missed


def test_tables_count_names_and_false_ones() -> None:
    found = {"reconcile": [said(Named("gx", "cross_axis", "gy")), said(Named("gy", "rate_ramp"))]}
    assert "1 of 2" in peers.summary(found)
    assert "| `cross_axis` | 1 of 2, 1 false |" in peers.by_effect(found)
