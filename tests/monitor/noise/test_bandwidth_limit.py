"""Tests of low-pass filters against SciPy and their stated response, for blocks of any length."""

import numpy as np
import pytest
from scipy.signal import butter, freqz, lfilter, lfiltic, sosfilt, sosfilt_zi, sosfreqz

from monitor.noise.effects import BandwidthLimit
from monitor.noise.effects.signal_chain.bandwidth_limit import (
    FILTER_KINDS,
    butterworth_sections,
    moving_average_length,
    smoothing_factor,
)
from monitor.noise.model import NoiseModel
from monitor.noise.spectrum import white_noise_spectrum


@pytest.mark.parametrize("order", range(1, 9))
@pytest.mark.parametrize("cutoff_hz", [0.1, 5.0, 49.0])
def test_samples_are_filtered_as_by_scipy(order: int, cutoff_hz: float) -> None:
    sections = butter(order, cutoff_hz, fs=100.0, output="sos")
    values = 9.81 + np.random.default_rng(order).standard_normal(3000)
    expected, _ = sosfilt(sections, values, zi=sosfilt_zi(sections) * values[0])
    low_pass = BandwidthLimit(cutoff=cutoff_hz, order=order).start_transform(100.0, np.random.default_rng())
    for piece in np.split(values, [1, 8, 1000, 1000]):  # the parts are views of values
        if piece.size:
            low_pass.transform_in_place(piece)
    # Poles close to one increase the rounding errors of both filters.
    assert values == pytest.approx(expected, rel=1e-11 if cutoff_hz < 1.0 else 1e-12, abs=1e-12)


@pytest.mark.parametrize("order", range(1, 9))
def test_gain_is_that_of_a_butterworth_filter(order: int) -> None:
    b0, b1, b2, a1, a2 = butterworth_sections(order, 20.0, 100.0).T
    sections = np.stack([b0, b1, b2, np.ones(b0.size), a1, a2], axis=1)
    f_hz, gain = sosfreqz(sections, 64, fs=100.0)
    expected = 1.0 / (1.0 + (np.tan(np.pi * f_hz / 100.0) / np.tan(np.pi * 0.2)) ** (2 * order))
    assert np.abs(gain) ** 2 == pytest.approx(expected, rel=1e-9, abs=1e-15)


def test_columns_of_a_table_are_filtered_in_place() -> None:
    table = np.full((10, 6), 9.81)
    BandwidthLimit(cutoff=10.0, order=2).start_transform(100.0, np.random.default_rng()).transform_in_place(table[:, 2])
    assert table == pytest.approx(np.full((10, 6), 9.81), rel=1e-14)


def compute_stage_coefficients(kind: str, order: int, cutoff_cycles: float) -> tuple[np.ndarray, np.ndarray]:
    """Return numerator and denominator of one stage by its definition."""
    if kind == "iir":
        a = smoothing_factor(order, cutoff_cycles)
        return np.array([a]), np.array([1.0, a - 1.0])
    length = moving_average_length(order, cutoff_cycles)
    weights = [*np.ones(int(length)), length % 1.0]
    return np.array(weights) / length, np.array([1.0])


@pytest.mark.parametrize("kind", ["iir", "fir"])
@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("cutoff_hz", [0.1, 5.0, 30.0, 49.0])
def test_averaging_filters_agree_with_scipy_and_have_half_power_at_the_cutoff(
    kind: str, order: int, cutoff_hz: float
) -> None:
    b, a = compute_stage_coefficients(kind, order, cutoff_hz / 100.0)
    values = 9.81 + np.random.default_rng(order).standard_normal(3000)
    expected = values.copy()
    for _ in range(order):
        past = np.full(b.size, expected[0])
        expected, _ = lfilter(b, a, expected, zi=lfiltic(b, a, past, past))
    low_pass = BandwidthLimit(cutoff=cutoff_hz, order=order, kind=kind)
    running = low_pass.start_transform(100.0, np.random.default_rng())
    for piece in np.split(values, [1, 8, 1000, 1000]):
        if piece.size:
            running.transform_in_place(piece)
    assert values == pytest.approx(expected, rel=1e-12)
    f_hz, gain = freqz(b, a, np.append(np.linspace(0.3, 50.0, 40), cutoff_hz), fs=100.0)
    density = low_pass.transform_spectrum(white_noise_spectrum(1.0, 0.01)).density(f_hz)
    assert density == pytest.approx(0.01 * np.abs(gain) ** (2 * order), rel=1e-9, abs=1e-18)
    assert density[-1] == pytest.approx(0.005, rel=1e-9)


@pytest.mark.parametrize("kind", FILTER_KINDS)
def test_floor_is_white_noise_after_the_filter(kind: str) -> None:
    values = np.zeros(100_000)
    BandwidthLimit(cutoff=1.0, order=2, kind=kind, floor=0.3).start_transform(
        100.0, np.random.default_rng(1)
    ).transform_in_place(values)
    assert values.std() == pytest.approx(3.0, rel=0.01)
    assert abs(values[1:] @ values[:-1]) < 0.02 * values @ values


def test_default_filter_is_a_butterworth_filter_of_order_one() -> None:
    short = NoiseModel.from_toml("[gz.angle_random_walk]\nN = 1.0\n[gz.bandwidth_limit]\ncutoff = 5.0\n")
    long = NoiseModel({"gz": (*short.effects["gz"][:1], BandwidthLimit(cutoff=5.0, order=1, kind="butterworth"))})
    np.testing.assert_array_equal(short.simulate(100, 100.0, 1), long.simulate(100, 100.0, 1))
