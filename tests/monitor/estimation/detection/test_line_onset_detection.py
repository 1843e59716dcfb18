"""Tests of spectral lines that begin and end: they are reported with frequency and amplitude, and noise is no line."""

import numpy as np
import pytest
from scipy.signal import lfilter

from monitor.estimation.detection import line_onset_detection
from monitor.estimation.detection.change_detection import NoiseAndBiasChangeDetector

RATE_HZ = 100.0
SIGMA = 1e-3


def simulate_noise(seconds, seed=0):
    return SIGMA * np.random.default_rng(seed).standard_normal((round(seconds * RATE_HZ), 6))


def find_changes(values, chunk=500):
    detector = NoiseAndBiasChangeDetector(RATE_HZ)
    for at in range(0, len(values), chunk):
        detector.process_samples(values[at : at + chunk])
    return detector.take_changes()


def sinusoid(n, frequency_hz, drift_hz_s=0.0):
    t = np.arange(n) / RATE_HZ
    return np.sin(2 * np.pi * (frequency_hz * t + drift_hz_s * t**2 / 2))


@pytest.mark.parametrize("frequency_hz", [3.0, 23.4, 48.0])
@pytest.mark.parametrize(("amplitude", "delay_s"), [(0.5, 20.0), (1.0, 10.0), (5.0, 10.0), (50.0, 10.0)])
@pytest.mark.parametrize("drift_hz_s", [0.0, 0.02])
def test_line_that_begins_is_named_within_seconds(frequency_hz, amplitude, delay_s, drift_hz_s):
    values = simulate_noise(140)
    values[10_000:, 1] += amplitude * SIGMA * sinusoid(4_000, frequency_hz, drift_hz_s)
    change = find_changes(values)[0]
    assert (change.kind, change.axis) == ("noise_changed", 1)
    assert change.what["frequency"][0] == pytest.approx(frequency_hz, abs=0.15 + 10 * drift_hz_s)
    before, after = change.what["amplitude"]
    assert before == 0.0
    assert after == pytest.approx(amplitude * SIGMA, rel=0.5 if amplitude <= 1.0 else 0.25)
    assert change.since == pytest.approx(10_000, abs=1000)
    assert 10_000 < change.found < 10_000 + delay_s * RATE_HZ
    assert f"gy line at {change.what['frequency'][0]:.3g} Hz began, amplitude" in change.text


@pytest.mark.parametrize("loss", [0.1, 0.2])
def test_line_is_named_despite_loss(loss):
    values = simulate_noise(160)
    values[10_000:] += 2.0 * SIGMA * sinusoid(6_000, 23.4)[:, None]
    values[np.random.default_rng(1).random(len(values)) < loss] = np.nan
    changes = find_changes(values)
    assert sorted(change.axis for change in changes) == list(range(6))
    for change in changes:
        assert change.what["frequency"][0] == pytest.approx(23.4, abs=0.15)
    # without loss, the mean is 0.93 of the true amplitude, because the line is identified soon after its onset
    amplitudes = [change.what["amplitude"][1] for change in changes]
    assert np.mean(amplitudes) == pytest.approx(2.0 * SIGMA, rel=0.15)


def test_line_on_several_axes_that_ends_is_reported_on_each():
    values = simulate_noise(160)
    values[5_000:10_000, 3:] += 3.0 * SIGMA * sinusoid(5_000, 23.4)[:, None]
    found = [(change.axis, change.text) for change in find_changes(values)]
    assert [axis for axis, text in found if " line at 23.4 Hz began" in text] == [3, 4, 5]
    assert sorted(axis for axis, text in found if " line at 23.4 Hz ended" in text) == [3, 4, 5]
    assert len(found) == 6


def test_division_into_blocks_does_not_matter():
    values = simulate_noise(100)
    values[5_000:, 0] += 0.6 * SIGMA * sinusoid(5_000, 12.0)
    assert find_changes(values, 10_000) == find_changes(values, 37) != []


def test_burst_of_oscillation_is_not_a_line_that_begins():
    values = simulate_noise(100)
    values[5_000:5_100, 0] += 3.0 * SIGMA * sinusoid(100, 23.4)
    assert not [change for change in find_changes(values) if "line" in change.text]


def test_missing_samples_change_no_amplitude():
    values = sinusoid(200, 23.4)
    values[20:80] = np.nan
    assert line_onset_detection._lasts(values, 23.4 / RATE_HZ, 1.0)
    values[:100] = np.nan
    assert not line_onset_detection._lasts(values, 23.4 / RATE_HZ, 1.0)


@pytest.mark.parametrize("factor", [1.5, 10.0])
def test_step_of_the_noise_level_is_not_a_line(factor):
    values = simulate_noise(200)
    values[10_000:, 2] *= factor
    (change,) = find_changes(values)
    assert "N" in change.what


def test_random_walk_and_resonances_are_not_lines():
    rng = np.random.default_rng(4)
    values = simulate_noise(2000)
    values[100_000:, 0] += np.cumsum(0.1 * SIGMA * rng.standard_normal(100_000))
    values[:, 1] += lfilter([0.6], [1.0, -1.2, 0.98], SIGMA * rng.standard_normal(200_000))
    values[:, 2] += 2.0 * SIGMA * sinusoid(200_000, 23.4)  # present from the beginning
    assert not [change.text for change in find_changes(values, 20_000) if "line" in change.text]


def test_line_whose_frequency_wanders_does_not_begin_again():
    values = simulate_noise(1200)
    seconds = np.arange(len(values)) / RATE_HZ
    frequency_hz = 21.3 + 0.3 * np.sin(2 * np.pi * seconds / 7.0) - np.clip((seconds - 600.0) / 60.0, 0.0, 2.0)
    values[:, 2] += 2.0 * SIGMA * np.sin(2 * np.pi * np.cumsum(frequency_hz) / RATE_HZ)
    assert not [change.text for change in find_changes(values, 20_000) if "began" in change.text]


@pytest.mark.long
def test_constant_noise_gives_no_line():
    """Six hours of noise with Q, N, B and K; the accepted rate of 0.0033 lines a day gives 8e-4 lines."""
    from tests.experiments.benchmarks.changes import make_mems_mix

    stream = make_mems_mix().start_stream(RATE_HZ, 17)
    detector = NoiseAndBiasChangeDetector(RATE_HZ)
    for _ in range(216):
        detector.process_samples(stream.draw_next_samples(10_000))
    assert detector.take_changes() == []
