"""The Butterworth low-pass against SciPy, in pieces of any length."""

import numpy as np
import pytest
from scipy.signal import butter, sosfilt, sosfilt_zi, sosfreqz

from monitor.noise.effects import BandwidthLimit
from monitor.noise.effects.signal_chain.bandwidth_limit import butterworth_sections


@pytest.mark.parametrize("order", range(1, 9))
@pytest.mark.parametrize("cutoff_hz", [0.1, 5.0, 49.0])
def test_samples_are_filtered_as_by_scipy(order: int, cutoff_hz: float) -> None:
    sections = butter(order, cutoff_hz, fs=100.0, output="sos")
    values = 9.81 + np.random.default_rng(order).standard_normal(3000)
    expected, _ = sosfilt(sections, values, zi=sosfilt_zi(sections) * values[0])
    low_pass = BandwidthLimit(cutoff=cutoff_hz, order=order).start_transform(100.0, np.random.default_rng())
    for piece in np.split(values, [1, 8, 1000, 1000]):  # views of values
        if piece.size:
            low_pass.transform_in_place(piece)
    # the nearer the poles are to one, the more both lose to rounding
    assert values == pytest.approx(expected, rel=1e-11 if cutoff_hz < 1.0 else 1e-12, abs=1e-12)


@pytest.mark.parametrize("order", range(1, 9))
def test_the_gain_is_that_of_butterworth(order: int) -> None:
    b0, b1, b2, a1, a2 = butterworth_sections(order, 20.0, 100.0).T
    sections = np.stack([b0, b1, b2, np.ones(b0.size), a1, a2], axis=1)
    f_hz, gain = sosfreqz(sections, 64, fs=100.0)
    expected = 1.0 / (1.0 + (np.tan(np.pi * f_hz / 100.0) / np.tan(np.pi * 0.2)) ** (2 * order))
    assert np.abs(gain) ** 2 == pytest.approx(expected, rel=1e-9, abs=1e-15)


def test_columns_of_a_table_are_filtered_in_place() -> None:
    table = np.full((10, 6), 9.81)
    BandwidthLimit(cutoff=10.0, order=2).start_transform(100.0, np.random.default_rng()).transform_in_place(table[:, 2])
    assert table == pytest.approx(np.full((10, 6), 9.81), rel=1e-14)
