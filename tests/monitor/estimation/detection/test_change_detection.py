"""Tests of the detection of changes in noise and bias: kinds, times, letters and false alarms."""

import numpy as np
import pytest
from scipy.signal import lfilter

from drivers.data_types import AXES
from drivers.errors import ConfigError
from monitor.estimation.detection.change_detection import LEARN_S, NoiseAndBiasChangeDetector
from monitor.estimation.detection.change_kernel import (
    FOUND,
    GAP_N,
    GAP_S,
    KIND,
    MIN_REFERENCE_TERMS,
    TICK_SAMPLES,
    F,
    N,
    S,
)
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


def simulate_white_noise(n, seed=0):
    return SIGMA * np.random.default_rng(seed).standard_normal((n, 6)) + [0.0, 0.0, 0.1, 0.0, 0.0, 9.81]


def octaves_ready_for_alarm(detector):
    """Return True where the reference is long enough to raise an alarm, [octaves, 6]."""
    state, band = detector._state, detector._state.band
    known = (band[:, :, N] >= MIN_REFERENCE_TERMS * band[:, :, F] ** 2) & (band[:, :, S] > 0.0)
    old_enough = detector.samples_since_start - state.born >= LEARN_S * detector.rate_hz
    return (known & old_enough[:, None]).T


def find_changes(values, rate_hz=100.0, **options):
    detector = NoiseAndBiasChangeDetector(rate_hz, **options)
    detector.process_samples(values)
    return detector.take_changes()


def find_single_change(values, **options):
    changes = find_changes(values, **options)
    assert len(changes) == 1, [change.text for change in changes]
    assert changes[0].axis == GZ
    return changes[0]


# --- block sizes


def simulate_changing_noise():
    values = simulate_white_noise(30_000)
    values[12_000:16_000, 0] *= 1.7
    values[20_000:, 1] += 5 * SIGMA
    values[21_000:21_100:3, 4] += 0.1
    values[np.random.default_rng(9).choice(30_000, 40, replace=False)] = np.nan
    return values


@pytest.mark.parametrize("seed", range(3))
def test_any_block_sizes_give_the_same_changes(seed):
    values = simulate_changing_noise()
    whole, cut = NoiseAndBiasChangeDetector(100.0), NoiseAndBiasChangeDetector(100.0)
    whole.process_samples(values)
    edges = np.unique(np.random.default_rng(seed).integers(0, len(values), 200))
    for part in np.split(values, edges):
        cut.process_samples(part)
    first, second = whole.take_changes(), cut.take_changes()
    assert {change.kind for change in first} == {"noise_changed", "bias_stepped", "outlier_burst"}
    assert first == second
    for a, b in zip(whole._state, cut._state, strict=True):
        assert np.array_equal(a, b)


def test_single_samples_give_the_same_state_as_a_block():
    values = simulate_changing_noise()[:13_000]
    whole, single = NoiseAndBiasChangeDetector(100.0), NoiseAndBiasChangeDetector(100.0)
    whole.process_samples(values)
    for row in values:
        single.process_samples(row[None])
    assert whole.take_changes() == single.take_changes()
    assert np.array_equal(whole._state.cusum, single._state.cusum)


def test_reference_is_the_allan_variance_of_disjoint_pairs():
    values = simulate_white_noise(1 << 16)
    detector = NoiseAndBiasChangeDetector(100.0)
    detector.process_samples(values)
    band = detector._state.band
    for j in (0, 3, 4, 5, 8):
        means = values[:, GZ].reshape(-1, 1 << j).mean(1)
        squares = 0.5 * (means[1::2] - means[::2]) ** 2
        assert band[GZ, j, N] == squares.size
        assert band[GZ, j, S] / band[GZ, j, N] == pytest.approx(
            squares.mean(), rel=2e-3
        )  # clipping reduces the variance by 2e-4
    assert (band[:, :6, F] < 2.0).all()


def test_missing_sample_removes_only_its_own_differences():
    values = simulate_white_noise(4096)
    values[1000, GZ] = np.nan
    detector = NoiseAndBiasChangeDetector(100.0)
    detector.process_samples(values)
    terms = detector._state.band[GZ, :9, N]
    pairs = 4096 // (2 << np.arange(9))
    # Blocks of one or two samples must be complete.
    assert np.array_equal(terms[:7], pairs[:7] - (np.arange(7) < 2))


def lose(values, loss, seed=5):
    """Return the samples with random loss, or with bursts of a given length that remove 10 % of the samples."""
    rng, values = np.random.default_rng(seed), values.copy()
    if loss < 1:
        values[rng.random(len(values)) < loss] = np.nan
    for begin in rng.integers(0, len(values) - loss, round(0.1 * len(values) / loss)) if loss >= 1 else ():
        values[begin : begin + loss] = np.nan
    return values


@pytest.mark.parametrize("loss", [0.05, 0.2, 10, 300])
@pytest.mark.parametrize("walk", [0.0, 0.03])
def test_loss_changes_neither_the_variances_nor_their_scatter(loss, walk):
    rng = np.random.default_rng(6)
    values = SIGMA * (rng.standard_normal((200_000, 6)) + np.cumsum(walk * rng.standard_normal((200_000, 6)), axis=0))
    bands = []
    for kept in (values, lose(values, loss)):
        detector = NoiseAndBiasChangeDetector(100.0)
        detector.process_samples(kept)
        assert detector.take_changes() == []
        bands.append(detector._state.band[:, :11])
    whole, lossy = bands
    variance = [band[:, :, S].sum(axis=0) / band[:, :, N].sum(axis=0) for band in bands]
    assert (lossy[:, :, N] > 0.35 * whole[:, :, N]).all()
    error = np.sqrt(2.0 / lossy[:, :, N].sum(axis=0))
    assert (np.abs(variance[1] / variance[0] - 1.0) < 3.0 * error + 0.002).all()


@pytest.mark.parametrize(("loss", "seed"), [(0.0, 3), (0.0, 4), (0.2, 3), (0.2, 5)])
def test_small_change_is_found_on_every_axis(loss, seed):
    """Neither a suspicion during the learning time nor the change itself in the factor F delays the alarm."""
    noise = SIGMA * np.random.default_rng(seed).standard_normal((44_000, 6))
    noise[40_000:] *= 1.2
    detector = NoiseAndBiasChangeDetector(100.0)
    detector.process_samples(lose(noise, loss, seed))
    alarms = [(change.axis, change.found) for change in detector.take_changes()]
    alarms += [(axis, alarm[FOUND]) for axis, alarm in enumerate(detector._state.alarm) if alarm[KIND] > 0.0]
    assert sorted(axis for axis, _ in alarms) == [0, 1, 2, 3, 4, 5]
    assert max(found for _, found in alarms) < 40_000 + 2500


def test_random_loss_of_a_fifth_leaves_three_quarters_of_the_differences_of_white_noise():
    counts = []
    for kept in (simulate_white_noise(40_000), lose(simulate_white_noise(40_000), 0.2)):
        detector = NoiseAndBiasChangeDetector(100.0)
        detector.process_samples(kept)
        counts.append(detector._state.band[:, 0, N])
    assert (counts[1] > 0.74 * counts[0]).all()


def test_differences_across_a_missing_sample_are_not_used_beside_a_line():
    values = simulate_white_noise(40_000) + 5.0 * SIGMA * np.cos(0.9 * np.pi * np.arange(40_000))[:, None]
    detector = NoiseAndBiasChangeDetector(100.0)
    detector.process_samples(lose(values, 0.2))
    one = detector._state.band[:, 0]
    assert (one[:, GAP_S] / one[:, GAP_N] < 0.5 * one[:, S] / one[:, N]).all()
    assert (np.abs(one[:, S] / one[:, N] / (SIGMA**2 * (1.0 + 25.0 * np.sin(0.45 * np.pi) ** 2)) - 1.0) < 0.03).all()


@pytest.mark.parametrize("loss", [0.1, 0.2])
def test_change_of_slow_noise_is_found_despite_loss(loss):
    rng = np.random.default_rng(7)
    steps = 0.02 * rng.standard_normal((720_000, 6))
    steps[360_000:, GZ] *= 4.0
    values = SIGMA * (rng.standard_normal(steps.shape) + np.cumsum(steps, axis=0))
    change = find_single_change(lose(values, loss))
    assert change.kind == "noise_changed"
    assert 360_000 < change.found < 360_000 + 120 * 100


def test_loss_that_begins_and_ends_is_no_change():
    rng = np.random.default_rng(8)
    line = np.sin(0.47 * np.pi * np.arange(300_000))[:, None]
    quantization = np.diff(rng.standard_normal((300_001, 1)), axis=0)
    white = rng.standard_normal((300_000, 4))
    values = SIGMA * np.concatenate(
        [white[:, :2], white[:, 2:3] + 10.0 * line, white[:, 3:4], quantization, line], axis=1
    )
    values[:, 3] = np.round(values[:, 3] / SIGMA) * SIGMA
    values[100_000:200_000] = lose(values[100_000:200_000], 0.2)
    assert [change.text for change in find_changes(values)] == []


def test_fluctuations_of_the_noise_are_learned_despite_loss():
    """A slow modulation of the level raises the factor F."""
    level = 1.0 + 0.5 * np.sin(2.0 * np.pi * np.arange(200_000) / 3000.0)
    values = simulate_white_noise(200_000) * level[:, None]
    factors = []
    for kept in (values, lose(values, 0.2)):
        detector = NoiseAndBiasChangeDetector(100.0)
        detector.process_samples(kept)
        factors.append(detector._state.band[:, :4, F].mean(axis=0))
    assert (factors[1] - 1.0 > 0.3 * (factors[0] - 1.0)).all(), factors


def test_skipped_samples_equal_missing_samples():
    values = simulate_white_noise(12_000)
    skipping, missing = NoiseAndBiasChangeDetector(100.0), NoiseAndBiasChangeDetector(100.0)
    skipping.process_samples(values[:5000])
    skipping.skip_missing_samples(700)
    skipping.process_samples(values[5000:])
    missing.process_samples(np.concatenate([values[:5000], np.full((700, 6), np.nan), values[5000:]]))
    assert skipping.samples_since_start == missing.samples_since_start == 12_700
    assert np.array_equal(skipping._state.cum, missing._state.cum)


# --- no false alarms


def test_constant_noise_causes_no_alarm():
    assert find_changes(simulate_white_noise(300_000, seed=4)) == []


def test_single_outliers_cause_no_alarm():
    values = simulate_white_noise(60_000)
    values[7_000::5_000, GZ] += 1.0
    values[0, GZ] = 5.0
    assert find_changes(values) == []


def test_coarse_quantization_causes_no_alarm():
    values = np.round(simulate_white_noise(200_000) / (2.0 * SIGMA)) * 2.0 * SIGMA
    assert find_changes(values) == []


def test_constant_axis_causes_no_alarm():
    assert find_changes(np.full((20_000, 6), 9.81)) == []


def test_change_while_learning_becomes_part_of_the_reference():
    values = simulate_white_noise(60_000)
    values[:500, GZ] *= 3.0
    assert find_changes(values) == []


@pytest.mark.parametrize("factor", [2.0, 4.0, 10.0])
@pytest.mark.parametrize("since", [1000, 3000, 6000])
def test_noise_step_shortly_after_the_start_is_reported(since, factor):
    values = simulate_white_noise(since + 4000)
    values[since:, GZ] = 0.1 + factor * (values[since:, GZ] - 0.1)
    change = find_single_change(values)
    if since > 1000:
        before, after = change.what["N"]
        assert after / before == pytest.approx(factor, rel=0.2)
    assert change.kind == "noise_changed"
    assert change.since == pytest.approx(since, abs=150)
    assert change.found < since + 1500


def test_short_noise_step_is_reported_at_both_ends():
    values = simulate_white_noise(15_000)
    values[6_000:9_000, GZ] = 0.1 + 3.0 * (values[6_000:9_000, GZ] - 0.1)
    rise, fall = find_changes(values)
    assert rise.what["N"][1] / rise.what["N"][0] == pytest.approx(3.0, rel=0.2)
    assert fall.what["N"][1] / fall.what["N"][0] == pytest.approx(1 / 3.0, rel=0.3)


def test_constant_resonance_reduces_the_degrees_of_freedom():
    rng = np.random.default_rng(2)
    values = simulate_white_noise(200_000)
    values[:, GZ] += 3.0 * SIGMA * lfilter([0.2], [1.0, -1.2, 0.98], rng.standard_normal(200_000))
    detector = NoiseAndBiasChangeDetector(100.0)
    detector.process_samples(values)
    assert detector.take_changes() == []
    assert detector._state.band[GZ, 1, F] > 3.0


# --- changes


@pytest.mark.parametrize("factor", [1.5, 3.0, 0.6])
def test_changed_white_noise_is_reported_as_n(factor):
    values = simulate_white_noise(60_000)
    values[40_000:, GZ] = 0.1 + factor * (values[40_000:, GZ] - 0.1)
    change = find_single_change(values)
    assert change.kind == "noise_changed"
    assert list(change.what) == ["N"]
    before, after = change.what["N"]
    assert before == pytest.approx(SIGMA / 10.0, rel=0.1)
    assert after / before == pytest.approx(factor, rel=0.15)
    assert abs(change.since - 40_000) < 200
    assert 0 < change.found - 40_000 < 1_000
    assert change.sigma > 6.0
    assert change.text.startswith(f"gz angle random walk {'rose' if factor > 1 else 'fell'} by ")


def test_accelerometer_noise_has_its_own_name():
    values = simulate_white_noise(40_000)
    values[20_000:, 5] = 9.81 + 2.0 * (values[20_000:, 5] - 9.81)
    (change,) = find_changes(values)
    assert AXES[change.axis] == "az"
    assert change.text.startswith("az velocity random walk rose by ")


def test_new_resonance_is_reported_as_a_frequency_band():
    rng = np.random.default_rng(2)
    values = simulate_white_noise(80_000)
    r, angle = np.exp(-np.pi / 100.0), 2.0 * np.pi * 0.2
    resonance = lfilter([1.0], [1.0, -2.0 * r * np.cos(angle), r * r], rng.standard_normal(60_000))
    values[20_000:, GZ] += SIGMA * resonance / resonance.std()
    change = find_changes(values)[0]
    assert change.kind == "noise_changed"
    assert set(change.what) == {"band", "rms"}
    low, high = change.what["band"]
    assert low < 20.0 < high
    assert "Hz rose by" in change.text


def test_step_is_reported_once_with_its_height():
    values = simulate_white_noise(120_000)
    values[50_011:, GZ] += 4 * SIGMA
    change = find_single_change(values)
    assert change.kind == "bias_stepped"
    before, after = change.what["bias"]
    assert after - before == pytest.approx(4 * SIGMA, rel=0.25)
    assert abs(change.since - 50_011) <= 40
    assert change.text.startswith("gz bias stepped by +0.2")


def test_step_at_a_common_block_boundary_is_found():
    values = simulate_white_noise(1 << 17)
    values[1 << 16 :, GZ] += 3 * SIGMA
    change = find_single_change(values)
    assert change.kind == "bias_stepped"
    assert abs(change.since - (1 << 16)) <= 40


@pytest.mark.parametrize(("first", "last"), [(99_900, 100_200), (100_000, 101_000), (99_500, 100_100)])
def test_step_during_missing_samples_is_found(first, last):
    """The step is at the beginning, within or at the end of the missing samples."""
    values = simulate_white_noise(110_000)
    values[100_000:, GZ] += 3 * SIGMA
    values[first:last] = np.nan
    change = find_single_change(values)
    assert change.kind == "bias_stepped"
    before, after = change.what["bias"]
    assert after - before == pytest.approx(3 * SIGMA, rel=0.25)
    assert first - 100 <= change.since <= last + 100


@pytest.mark.parametrize("burst", [0, 100, 1000])
@pytest.mark.parametrize("slope", [50, 500])
def test_learned_ramp_is_not_a_step(burst, slope):
    values = simulate_white_noise(200_000)
    values[:, GZ] += np.linspace(0.0, slope * SIGMA, 200_000)
    for begin in np.random.default_rng(1).integers(0, 200_000, 20_000 // burst if burst else 0):
        values[begin : begin + burst] = np.nan
    assert [change.kind for change in find_changes(values) if change.kind == "bias_stepped"] == []


def test_outlier_burst_is_reported_once():
    values = simulate_white_noise(80_000)
    at = 20_000 + np.random.default_rng(1).choice(300, 20, replace=False)
    values[at, GZ] += 0.05 * np.random.default_rng(3).standard_normal(20)
    detector = NoiseAndBiasChangeDetector(100.0)
    detector.process_samples(values)
    (change,) = detector.take_changes()
    assert (change.kind, AXES[change.axis]) == ("outlier_burst", "gz")
    assert 8 <= change.what["count"][1] <= 20
    assert change.what["scale"][1] == pytest.approx(0.05, rel=0.5)
    assert detector._state.born[GZ] == 0


def test_new_noise_becomes_the_reference_after_a_change():
    values = simulate_white_noise(120_000)
    values[40_000:, GZ] = 0.1 + 1.5 * (values[40_000:, GZ] - 0.1)
    values[90_000:, GZ] = 0.1 + (values[90_000:, GZ] - 0.1) / 1.5
    first, second = find_changes(values)
    assert first.what["N"][1] > first.what["N"][0]
    assert second.what["N"][1] < second.what["N"][0]
    assert second.what["N"][0] == pytest.approx(1.5e-4, rel=0.05)


# --- the experiment of "Dynamic extraction of random drift error coefficients of MEMS gyroscopes"


def test_change_in_the_experiment_of_the_paper_is_found():
    """Simulate 600 s at 100 Hz; at 250 s N doubles, B trebles, K and R become relevant and Q is constant.

    Q is 2e-5 (5/6 of the variance of the first octave), N 1.5e-4 → 3e-4, B 4e-5 → 1.2e-4, K 1.5e-6 → 2e-5, R 0 → 2e-6.
    At 1 s the variance rises from 2.4e-8 to 9.7e-8, of which B makes 6e-9 and K 1e-10. Changes of B and K only show
    in clusters of at least 10 s, for which 250 s are too short to learn. N is found within ten seconds.
    """
    q = QuantizationNoise(Q=2e-5)
    before = (q, AngleRandomWalk(N=1.5e-4), BiasInstability(B=4e-5), RateRandomWalk(K=1.5e-6))
    after = (q, AngleRandomWalk(N=3e-4), BiasInstability(B=1.2e-4), RateRandomWalk(K=2e-5), RateRamp(R=2e-6))
    parts = [
        NoiseModel(dict.fromkeys(AXES, sources)).simulate(n, 100.0, seed)
        for sources, n, seed in ((before, 25_000, 1), (after, 35_000, 2))
    ]
    first = {}
    for change in find_changes(np.concatenate(parts)):
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


# --- identification of the changed coefficient


def make_variances(before, after, terms=10_000.0):
    tau = 0.01 * 2.0 ** np.arange(12)

    def compute_variance(letters):
        sources = {"Q": QuantizationNoise, "N": AngleRandomWalk, "B": BiasInstability, "K": RateRandomWalk}
        return sum(sources[c](**{c: value}).avar(tau, 0.01) for c, value in letters.items())

    n = terms / 2.0 ** np.arange(12)
    return HaarVariancesBeforeAfter(compute_variance(before), 10 * n, compute_variance(after), n)


MIX = {"Q": 2e-6, "N": 1.5e-4, "B": 4e-5, "K": 1.5e-6}


@pytest.mark.parametrize(("letter", "factor"), [("N", 1.5), ("N", 0.7), ("Q", 10.0), ("B", 10.0), ("K", 100.0)])
def test_exact_variances_identify_the_changed_coefficient(letter, factor):
    what = identify_changed_coefficients(make_variances(MIX, MIX | {letter: factor * MIX[letter]}), 100.0)
    assert list(what) == [letter]
    assert what[letter][1] == pytest.approx(factor * MIX[letter], rel=0.05)


def test_two_changed_coefficients_are_identified():
    what = identify_changed_coefficients(make_variances(MIX, MIX | {"Q": 2e-5, "N": 3e-4}, terms=100_000.0), 100.0)
    assert list(what) == ["Q", "N"]


def test_unknown_variances_identify_nothing():
    none = np.zeros(12)
    assert identify_changed_coefficients(HaarVariancesBeforeAfter(none, none, none, none), 100.0) == {}


# --- learning and invalid arguments


def test_octaves_are_ready_after_the_learning_time():
    detector = NoiseAndBiasChangeDetector(100.0)
    detector.process_samples(simulate_white_noise(int(LEARN_S * 100) - TICK_SAMPLES))
    assert not octaves_ready_for_alarm(detector)[0].any()
    detector.process_samples(simulate_white_noise(4 * TICK_SAMPLES))
    assert octaves_ready_for_alarm(detector)[0].all()
    assert octaves_ready_for_alarm(detector)[:, 0].sum() >= 6


@pytest.mark.parametrize(("rate", "alarms"), [(0.0, 1.0), (float("nan"), 1.0), (100.0, 0.0), (100.0, -1.0)])
def test_impossible_arguments_are_refused(rate, alarms):
    with pytest.raises(ConfigError):
        NoiseAndBiasChangeDetector(rate, alarms)


def test_samples_of_another_shape_are_refused():
    with pytest.raises(ValueError, match="expected is"):
        NoiseAndBiasChangeDetector(100.0).process_samples(np.zeros((3, 5)))


@pytest.mark.parametrize(("rate_hz", "alarms_per_day"), [(1e6, 1e-6), (1e-3, 1e4), (1e9, 1e-6)])
def test_thresholds_are_finite_at_the_limits_of_the_supported_range(rate_hz: float, alarms_per_day: float) -> None:
    """The false alarm probability of one test is far below the spacing of doubles next to 1."""
    levels = NoiseAndBiasChangeDetector(rate_hz, alarms_per_day)._state.levels
    assert np.isfinite(levels).all()
    assert levels[2] > 2.0  # standard deviations
