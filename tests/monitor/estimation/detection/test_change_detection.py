"""The detector finds what changes, when, and says the letters; it keeps silent else, however samples are cut."""

import numpy as np
import pytest
from scipy.signal import lfilter

from drivers.data_types import AXES
from drivers.errors import ConfigError
from monitor.estimation.detection.change_detection import LEARN_S, NoiseAndBiasChangeDetector
from monitor.estimation.detection.change_kernel import TICK_SAMPLES, F, N, S
from monitor.estimation.detection.changed_coefficient_identification import (
    HaarVariancesBeforeAfter,
    identify_changed_coefficients,
)
from monitor.noise.effects.ieee952.angle_random_walk import AngleRandomWalk
from monitor.noise.effects.ieee952.bias_instability import BiasInstability
from monitor.noise.effects.ieee952.quantization_noise import QuantizationNoise
from monitor.noise.effects.ieee952.rate_ramp import RateRamp
from monitor.noise.effects.ieee952.rate_random_walk import RateRandomWalk
from monitor.noise.model import NoiseModel

SIGMA = 1e-3
GZ = 2


def white(n, seed=0):
    return SIGMA * np.random.default_rng(seed).standard_normal((n, 6)) + [0.0, 0.0, 0.1, 0.0, 0.0, 9.81]


def found(values, rate_hz=100.0, **options):
    detector = NoiseAndBiasChangeDetector(rate_hz, **options)
    detector.process_samples(values)
    return detector.take_changes()


def only(values, **options):
    changes = found(values, **options)
    assert len(changes) == 1, [change.text for change in changes]
    assert changes[0].axis == GZ
    return changes[0]


# --- one truth, whatever the cut


def eventful():
    values = white(30_000)
    values[12_000:16_000, 0] *= 1.7
    values[20_000:, 1] += 5 * SIGMA
    values[21_000:21_100:3, 4] += 0.1
    values[np.random.default_rng(9).choice(30_000, 40, replace=False)] = np.nan
    return values


@pytest.mark.parametrize("seed", range(3))
def test_blocks_of_any_cut_equal_one_by_one(seed):
    values = eventful()
    whole, cut = NoiseAndBiasChangeDetector(100.0), NoiseAndBiasChangeDetector(100.0)
    whole.process_samples(values)
    edges = np.unique(np.random.default_rng(seed).integers(0, len(values), 200))
    for part in np.split(values, edges):
        cut.process_samples(part)
    one, other = whole.take_changes(), cut.take_changes()
    assert {change.kind for change in one} == {"noise_changed", "bias_stepped", "outlier_burst"}
    assert one == other
    for a, b in zip(whole._state, cut._state, strict=True):
        assert np.array_equal(a, b)


def test_one_by_one_equals_the_block():
    values = eventful()[:13_000]
    whole, single = NoiseAndBiasChangeDetector(100.0), NoiseAndBiasChangeDetector(100.0)
    whole.process_samples(values)
    for row in values:
        single.process_samples(row[None])
    assert whole.take_changes() == single.take_changes()
    assert np.array_equal(whole._state.cusum, single._state.cusum)


def test_the_reference_is_the_allan_variance_of_disjoint_pairs():
    values = white(1 << 16)
    detector = NoiseAndBiasChangeDetector(100.0)
    detector.process_samples(values)
    band = detector._state.band
    for j in (0, 3, 4, 5, 8):
        means = values[:, GZ].reshape(-1, 1 << j).mean(1)
        squares = 0.5 * (means[1::2] - means[::2]) ** 2
        assert band[GZ, j, N] == squares.size
        assert band[GZ, j, S] / band[GZ, j, N] == pytest.approx(squares.mean(), rel=2e-3)  # clipping takes 2e-4
    assert (band[:, :6, F] < 2.0).all()


def test_a_missing_sample_costs_its_own_differences_only():
    values = white(4096)
    values[1000, GZ] = np.nan
    detector = NoiseAndBiasChangeDetector(100.0)
    detector.process_samples(values)
    terms = detector._state.band[GZ, :9, N]
    pairs = 4096 // (2 << np.arange(9))
    short = 2 ** np.arange(9) < TICK_SAMPLES
    # blocks of a tick and more bear the loss of a sixteenth
    assert np.array_equal(terms, pairs - short) or terms[8] == 0.0
    assert np.array_equal(terms[:5], pairs[:5] - 1)
    assert terms[5] == pairs[5]


def test_skipped_samples_are_missing_samples():
    values = white(12_000)
    one, other = NoiseAndBiasChangeDetector(100.0), NoiseAndBiasChangeDetector(100.0)
    one.process_samples(values[:5000])
    one.skip_missing_samples(700)
    one.process_samples(values[5000:])
    other.process_samples(np.concatenate([values[:5000], np.full((700, 6), np.nan), values[5000:]]))
    assert one.samples_since_start == other.samples_since_start == 12_700
    assert np.array_equal(one._state.cum, other._state.cum)


# --- silence


def test_unchanging_noise_is_nothing():
    assert found(white(300_000, seed=4)) == []


def test_single_outliers_are_nothing():
    values = white(60_000)
    values[7_000::5_000, GZ] += 1.0
    values[0, GZ] = 5.0
    assert found(values) == []


def test_steps_of_resolution_are_nothing():
    values = np.round(white(200_000) / (2.0 * SIGMA)) * 2.0 * SIGMA
    assert found(values) == []


def test_a_constant_axis_is_nothing():
    assert found(np.full((20_000, 6), 9.81)) == []


def test_what_changes_while_learning_becomes_the_reference():
    values = white(60_000)
    values[:2_000, GZ] *= 3.0
    assert found(values) == []


def test_a_steady_resonance_has_fewer_degrees_of_freedom():
    rng = np.random.default_rng(2)
    values = white(200_000)
    values[:, GZ] += 3.0 * SIGMA * lfilter([0.2], [1.0, -1.2, 0.98], rng.standard_normal(200_000))
    detector = NoiseAndBiasChangeDetector(100.0)
    detector.process_samples(values)
    assert detector.take_changes() == []
    assert detector._state.band[GZ, 1, F] > 3.0


# --- changes


@pytest.mark.parametrize("factor", [1.5, 3.0, 0.6])
def test_louder_white_noise_is_named(factor):
    values = white(60_000)
    values[40_000:, GZ] = 0.1 + factor * (values[40_000:, GZ] - 0.1)
    change = only(values)
    assert change.kind == "noise_changed"
    assert list(change.what) == ["N"]
    before, after = change.what["N"]
    assert before == pytest.approx(SIGMA / 10.0, rel=0.1)
    assert after / before == pytest.approx(factor, rel=0.15)
    assert abs(change.since - 40_000) < 200
    assert 0 < change.found - 40_000 < 1_000
    assert change.sigma > 6.0
    assert change.text.startswith(f"gz angle random walk {'rose' if factor > 1 else 'fell'} by ")


def test_accelerometers_have_their_own_words():
    values = white(40_000)
    values[20_000:, 5] = 9.81 + 2.0 * (values[20_000:, 5] - 9.81)
    (change,) = found(values)
    assert AXES[change.axis] == "az"
    assert change.text.startswith("az velocity random walk rose by ")


def test_a_new_resonance_is_a_band_of_frequencies():
    rng = np.random.default_rng(2)
    values = white(80_000)
    r, angle = np.exp(-np.pi / 100.0), 2.0 * np.pi * 0.2
    made = lfilter([1.0], [1.0, -2.0 * r * np.cos(angle), r * r], rng.standard_normal(60_000))
    values[20_000:, GZ] += SIGMA * made / made.std()
    change = found(values)[0]
    assert change.kind == "noise_changed"
    assert set(change.what) == {"band", "rms"}
    low, high = change.what["band"]
    assert low < 20.0 < high
    assert "Hz rose by" in change.text


def test_a_step_is_told_once_with_its_height():
    values = white(120_000)
    values[50_011:, GZ] += 4 * SIGMA
    change = only(values)
    assert change.kind == "bias_stepped"
    before, after = change.what["bias"]
    assert after - before == pytest.approx(4 * SIGMA, rel=0.25)
    assert abs(change.since - 50_011) <= 40
    assert change.text.startswith("gz bias stepped by +0.2")


def test_a_step_on_the_border_of_all_blocks_is_found_too():
    values = white(1 << 17)
    values[1 << 16 :, GZ] += 3 * SIGMA
    change = only(values)
    assert change.kind == "bias_stepped"
    assert abs(change.since - (1 << 16)) <= 40


def test_a_learned_ramp_is_no_step():
    values = white(200_000)
    values[:, GZ] += np.linspace(0.0, 50 * SIGMA, 200_000)
    assert [change.kind for change in found(values) if change.kind == "bias_stepped"] == []


def test_a_burst_is_told_once_and_forgotten():
    values = white(80_000)
    at = 20_000 + np.random.default_rng(1).choice(300, 20, replace=False)
    values[at, GZ] += 0.05 * np.random.default_rng(3).standard_normal(20)
    detector = NoiseAndBiasChangeDetector(100.0)
    detector.process_samples(values)
    (change,) = detector.take_changes()
    assert (change.kind, AXES[change.axis]) == ("outlier_burst", "gz")
    assert 8 <= change.what["count"][1] <= 20
    assert change.what["scale"][1] == pytest.approx(0.05, rel=0.5)
    assert detector._state.born[GZ] == 0


def test_after_a_change_the_new_noise_is_the_reference():
    values = white(120_000)
    values[40_000:, GZ] = 0.1 + 1.5 * (values[40_000:, GZ] - 0.1)
    values[90_000:, GZ] = 0.1 + (values[90_000:, GZ] - 0.1) / 1.5
    first, second = found(values)
    assert first.what["N"][1] > first.what["N"][0]
    assert second.what["N"][1] < second.what["N"][0]
    assert second.what["N"][0] == pytest.approx(1.5e-4, rel=0.05)


# --- the experiment of "Dynamic extraction of random drift error coefficients of MEMS gyroscopes"


def test_the_papers_experiment():
    """600 s at 100 Hz; at 250 s N doubles, B trebles, K and R begin to matter, Q stays.

    Q 2e-5 (which makes 5/6 of the first octave's variance), N 1.5e-4 → 3e-4, B 4e-5 → 1.2e-4, K 1.5e-6 → 2e-5,
    R 0 → 2e-6. At 1 s the variance goes from 2.4e-8 to 9.7e-8, of which B is 6e-9 and K 1e-10: that B and K changed
    needs clusters of 10 s and more, of which 250 s are too few to learn from. N is named, within ten seconds.
    """
    q = QuantizationNoise(Q=2e-5)
    calm = (q, AngleRandomWalk(N=1.5e-4), BiasInstability(B=4e-5), RateRandomWalk(K=1.5e-6))
    rough = (q, AngleRandomWalk(N=3e-4), BiasInstability(B=1.2e-4), RateRandomWalk(K=2e-5), RateRamp(R=2e-6))
    parts = [
        NoiseModel(dict.fromkeys(AXES, sources)).simulate(n, 100.0, seed)
        for sources, n, seed in ((calm, 25_000, 1), (rough, 35_000, 2))
    ]
    first = {}
    for change in found(np.concatenate(parts)):
        first.setdefault(change.axis, change)
    assert len(first) == 6
    assert abs(np.median([change.since for change in first.values()]) / 100.0 - 250.0) < 1.0
    for change in first.values():
        assert change.kind == "noise_changed"
        assert abs(change.since / 100.0 - 250.0) < 5.0
        assert change.found / 100.0 < 260.0
        assert "N" in change.what
        assert "Q" not in change.what
        assert change.what["N"][1] == pytest.approx(3e-4, rel=0.2)


# --- letters


def octaves(before, after, terms=10_000.0):
    tau = 0.01 * 2.0 ** np.arange(12)

    def variance(letters):
        sources = {"Q": QuantizationNoise, "N": AngleRandomWalk, "B": BiasInstability, "K": RateRandomWalk}
        return sum(sources[c](**{c: value}).avar(tau, 0.01) for c, value in letters.items())

    n = terms / 2.0 ** np.arange(12)
    return HaarVariancesBeforeAfter(variance(before), 10 * n, variance(after), n)


MIX = {"Q": 2e-6, "N": 1.5e-4, "B": 4e-5, "K": 1.5e-6}


@pytest.mark.parametrize(("letter", "factor"), [("N", 1.5), ("N", 0.7), ("Q", 10.0), ("B", 10.0), ("K", 100.0)])
def test_exact_variances_name_the_letter_that_changed(letter, factor):
    what = identify_changed_coefficients(octaves(MIX, MIX | {letter: factor * MIX[letter]}), 100.0)
    assert list(what) == [letter]
    assert what[letter][1] == pytest.approx(factor * MIX[letter], rel=0.05)


def test_two_letters():
    what = identify_changed_coefficients(octaves(MIX, MIX | {"Q": 2e-5, "N": 3e-4}, terms=100_000.0), 100.0)
    assert list(what) == ["Q", "N"]


def test_nothing_known_names_nothing():
    none = np.zeros(12)
    assert identify_changed_coefficients(HaarVariancesBeforeAfter(none, none, none, none), 100.0) == {}


# --- learning and refusing


def test_learned_after_its_time():
    detector = NoiseAndBiasChangeDetector(100.0)
    detector.process_samples(white(int(LEARN_S * 100) - TICK_SAMPLES))
    assert not detector.octaves_ready_for_alarm[0].any()
    detector.process_samples(white(4 * TICK_SAMPLES))
    assert detector.octaves_ready_for_alarm[0].all()
    assert detector.octaves_ready_for_alarm[:, 0].sum() >= 6
    detector.restart_references(GZ)
    assert detector.octaves_ready_for_alarm[0].tolist() == [True, True, False, True, True, True]
    detector.restart_references()
    assert not detector.octaves_ready_for_alarm[0].any()


@pytest.mark.parametrize(("rate", "alarms"), [(0.0, 1.0), (float("nan"), 1.0), (100.0, 0.0), (100.0, -1.0)])
def test_impossible_arguments(rate, alarms):
    with pytest.raises(ConfigError):
        NoiseAndBiasChangeDetector(rate, alarms)


def test_samples_of_another_shape():
    with pytest.raises(ValueError, match="expected is"):
        NoiseAndBiasChangeDetector(100.0).process_samples(np.zeros((3, 5)))


@pytest.mark.parametrize(("rate_hz", "alarms_per_day"), [(1e6, 1e-6), (1e-3, 1e4), (1e9, 1e-6)])
def test_thresholds_are_finite_at_the_ends_of_what_is_supported(rate_hz: float, alarms_per_day: float) -> None:
    """The share of false alarms for one look is far below the distance of 1 from the next smaller double."""
    levels = NoiseAndBiasChangeDetector(rate_hz, alarms_per_day)._state.levels
    assert np.isfinite(levels).all()
    assert levels[2] > 2.0  # standard deviations
