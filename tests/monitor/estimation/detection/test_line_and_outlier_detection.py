"""Lines, resonances and outliers are told with their size; noise of every colour is not told to have any."""

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from monitor.estimation.allan.batch import overlapping_avar
from monitor.estimation.allan.curve import AllanCurve
from monitor.estimation.detection import line_and_outlier_detection
from monitor.estimation.detection.line_and_outlier_detection import (
    BLOCK,
    MAX_MISSING_SHARE,
    MIN_LINE_SHARE,
    MIN_STRETCHES,
    ROWS,
    allan_variance_share_of_line,
    detect_spectral_lines_per_axis,
    outlier_share_of_axes,
)

RATE_HZ = 100.0
FEWEST = line_and_outlier_detection.MIN_ROWS * MIN_STRETCHES
"""Samples with which there is a spectrum."""


def white(n, seed=0):
    return 1e-3 * np.random.default_rng(seed).standard_normal((n, 6))


def curve_of(values):
    factors = 2 ** np.arange(max(int(np.log2(len(values))) - 1, 1))
    avar, terms = overlapping_avar(values, factors)
    unused = np.full_like(avar, np.nan)
    return AllanCurve(factors / RATE_HZ, factors, avar, terms, unused, unused, unused, len(values))


def found(values, moving=None):
    return detect_spectral_lines_per_axis(
        values, np.zeros(len(values), bool) if moving is None else moving, RATE_HZ, curve_of(values)
    )


def shares(values, moving=None):
    return outlier_share_of_axes(values, np.zeros(len(values), bool) if moving is None else moving)


def with_line(n, amplitude, hz, seed=0):
    """On gy."""
    values = white(n, seed)
    values[:, 1] += amplitude * np.sin(2.0 * np.pi * hz * np.arange(n) / RATE_HZ + 0.3)
    return values


def with_resonance(n, rms, hz, q, seed=0):
    """Of two poles, on gz."""
    values = white(n, seed)
    turn, radius = 2.0 * np.pi * hz / RATE_HZ, np.exp(-np.pi * hz / RATE_HZ / q)
    rung = lfilter(
        [1.0], [1.0, -2.0 * radius * np.cos(turn), radius**2], np.random.default_rng(seed + 9).normal(size=n)
    )
    values[:, 2] += rms * rung / rung.std()
    return values


# --- lines -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("n", "hz"), [(60_000, 0.31), (60_000, 17.3), (60_000, 48.7), (10_000, 5.0), (10_000, 17.3)])
def test_a_line_is_told_with_frequency_amplitude_and_share(n, hz):
    rows = min(ROWS, 1 << int(np.log2(n // MIN_STRETCHES)))
    values = with_line(n, 2e-3, hz)
    [line] = found(values)
    assert (line.axis, line.wide) == (1, False)
    assert line.frequency_hz == pytest.approx(hz, abs=RATE_HZ / rows)
    assert line.amplitude == pytest.approx(2e-3, rel=0.05)
    m = 2.0 ** np.arange(int(np.log2(n)) - 1)
    # a mean over m samples of a sine, and the difference of two that are m apart
    made = (2e-3 * np.sin(np.pi * hz / RATE_HZ * m) ** 2 / (m * np.sin(np.pi * hz / RATE_HZ))) ** 2
    assert line.share == pytest.approx((made / (made + 1e-6 / m)).max(), abs=0.05)


def test_its_share_is_what_the_curve_has_more():
    """Also near half the rate, where means of few samples are far from an integral."""
    without, values = white(60_000), with_line(60_000, 5e-4, 44.0)
    [line] = found(values)
    more = 1.0 - curve_of(without).avar[:, 1] / curve_of(values).avar[:, 1]
    assert line.share == pytest.approx(more[:8].max(), abs=0.02)


@pytest.mark.long
def test_what_adds_less_than_matters_is_not_told():
    strong, weak = with_line(600_000, 2.5e-4, 21.0), with_line(600_000, 2.5e-5, 21.0)
    [line] = found(strong)
    assert line.share > MIN_LINE_SHARE
    assert found(weak) == []
    # clear enough to be found, and left out for its share alone
    parts = [
        line_and_outlier_detection._filled(part)
        for part in line_and_outlier_detection._stretches(strong[:, 1], np.zeros(600_000, bool), ROWS, 128)
    ]
    assert (
        len(line_and_outlier_detection._peaks(line_and_outlier_detection._spectrum(np.stack(parts)), len(parts))) == 1
    )
    quiet = curve_of(strong)
    quiet.avar[:] *= 2.0 * line.share / MIN_LINE_SHARE
    assert detect_spectral_lines_per_axis(strong, np.zeros(600_000, bool), RATE_HZ, quiet) == []


def test_the_strongest_of_an_axis_come_first_and_no_more_than_three():
    values = white(60_000)
    for hz, amplitude in ((7.0, 1e-3), (11.0, 3e-3), (23.0, 2e-3), (37.0, 1.5e-3)):
        values[:, 4] += amplitude * np.sin(2.0 * np.pi * hz * np.arange(60_000) / RATE_HZ)
    told = found(values)
    assert [line.axis for line in told] == [4] * line_and_outlier_detection.MAX_LINES
    assert sorted(told, key=lambda line: -line.share) == told
    assert told[0].frequency_hz == pytest.approx(11.0, abs=0.02)


def test_a_line_beyond_all_noise_is_one_line_and_no_resonance():
    [line] = found(with_line(60_000, 30.0, 17.3))
    assert not line.wide
    assert line.amplitude == pytest.approx(30.0, rel=1e-3)
    assert line.share == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize(("hz", "q"), [(20.0, 20.0), (20.0, 8.0), (10.0, 50.0), (35.0, 15.0)])
def test_a_resonance_is_wide_and_has_its_power(hz, q):
    [line] = found(with_resonance(200_000, 2e-3, hz, q))
    assert (line.axis, line.wide) == (2, True)
    assert line.frequency_hz == pytest.approx(hz, rel=0.02)
    assert line.amplitude == pytest.approx(2e-3 * 2**0.5, rel=0.12)


def test_missing_and_moving_samples_keep_a_line():
    values = with_line(60_000, 2e-3, 17.3)
    values[np.random.default_rng(1).random(60_000) < 0.02] = np.nan
    values[20_000:23_000] = np.nan
    moving = np.zeros(60_000, bool)
    moving[40_000:42_000] = True
    values[moving] += 50.0
    [line] = found(values, moving)
    assert line.frequency_hz == pytest.approx(17.3, abs=0.03)
    assert line.amplitude == pytest.approx(2e-3, rel=0.05)
    assert shares(values, moving).max() < 1e-4


def test_with_more_missing_than_may_be_there_is_no_answer():
    values = with_line(60_000, 2e-3, 17.3)
    values[np.random.default_rng(1).random(60_000) < 1.5 * MAX_MISSING_SHARE] = np.nan
    assert found(values) == []
    assert np.isnan(shares(values)).all()


def test_the_shortest_recording_with_a_spectrum():
    assert [line.axis for line in found(with_line(FEWEST, 3e-3, 17.3))] == [1]
    assert found(with_line(FEWEST - 1, 3e-3, 17.3)) == []


def flicker(rng, n):
    hz = np.fft.rfftfreq(n)
    hz[0] = np.inf
    turned = rng.standard_normal((hz.size, 6)) + 1j * rng.standard_normal((hz.size, 6))
    return np.fft.irfft(turned / np.sqrt(hz)[:, None], n, axis=0)


def low_passed(rng, n):
    return lfilter(*butter(2, 0.3), rng.standard_normal((n + 100, 6)), axis=0)[100:]


@pytest.mark.long
@pytest.mark.parametrize(
    "noise",
    [
        lambda rng, n: rng.standard_normal((n, 6)),
        flicker,
        lambda rng, n: np.diff(rng.standard_normal((n + 1, 6)), axis=0),
        lambda rng, n: np.cumsum(rng.standard_normal((n, 6)), axis=0),
        low_passed,
        lambda rng, n: np.round(2.0 * low_passed(rng, n)),
        lambda rng, n: np.round(0.4 * rng.standard_normal((n, 6))),
        lambda rng, n: rng.standard_normal((n // 2, 6)).repeat(2, axis=0),
    ],
    ids=["white", "flicker", "quantization", "random walk", "low-passed", "its steps", "coarse", "held"],
)
def test_noise_has_no_lines(noise):
    """In one of a hundred at most; none was seen in a thousand of each."""
    records = [noise(np.random.default_rng(seed), FEWEST) for seed in range(200)]
    assert sum(bool(found(record)) for record in records) <= 2


# --- outliers --------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.001, 0.01, 0.1])
def test_the_share_of_outliers_is_told(share):
    rng = np.random.default_rng(3)
    values = white(100_000) + np.cumsum(1e-5 * rng.standard_normal((100_000, 6)), axis=0)
    far = rng.random(100_000) < share
    values[far, 5] += 0.05 * rng.choice([-1.0, 1.0], far.sum())
    told = shares(values)
    assert told[5] == pytest.approx(far.mean(), rel=0.1 if share > 0.005 else 0.25)
    assert told[:5].max() < 1e-5


@pytest.mark.parametrize("missing", [0.0, 0.02])
@pytest.mark.parametrize("step", [0.0, 1e-4, 0.44e-3, 0.46e-3, 1e-3, 2e-3, 5e-3])
def test_gaussian_noise_has_none_however_coarse(step, missing):
    values = white(60_000) + 9.81
    values = np.round(values / step) * step if step else values
    values[np.random.default_rng(1).random(60_000) < missing] = np.nan
    assert shares(values).max() < 3e-5


@pytest.mark.parametrize("rows", [40, 400])
@pytest.mark.parametrize("height", [0.05, 1.0])
def test_a_warm_up_has_no_outliers(rows, height):
    """Samples a few times a minute: the curve falls within one block."""
    values = np.concatenate([white(179, seed) for seed in range(20)])
    values += height * np.exp(-(np.arange(len(values)) % 179) / rows)[:, None]
    parts = values.reshape(20, 179, 6)
    assert max(shares(part).max() for part in parts) == 0.0


@pytest.mark.parametrize("row", [1, 2, 3])
def test_outliers_in_a_row_are_told_up_to_three(row):
    values = white(63_000)
    for begin in range(50, 63_000, 630):
        values[begin : begin + row, 2] += 0.05
    assert shares(values)[2] == pytest.approx(row / 630, rel=0.1)


@pytest.mark.parametrize("hz", [0.31, 5.0, 17.3])
def test_what_a_line_adds_at_each_averaging_time(hz):
    without, values = curve_of(white(60_000)), with_line(60_000, 5e-4, hz)
    [line] = found(values)
    more = 1.0 - without.avar[:, 1] / curve_of(values).avar[:, 1]
    told = allan_variance_share_of_line(line, curve_of(values))
    assert told[:9] == pytest.approx(more[:9], abs=0.03)
    assert told.max() == pytest.approx(line.share)


def test_too_short_for_a_block_is_no_answer():
    assert np.isnan(shares(white(BLOCK - 1))).all()
    assert shares(white(BLOCK)).tolist() == [0.0] * 6


# --- what no sensor should send --------------------------------------------------------------------


@pytest.mark.parametrize("level", [0.0, 9.81, 1.0 / 3.0, np.nan])
def test_an_axis_that_never_moves_has_nothing(level):
    values = with_line(30_000, 2e-3, 17.3)
    values[:, 3] = level
    assert [line.axis for line in found(values)] == [1]
    assert shares(values)[3] == 0.0 or np.isnan(level)


@pytest.mark.parametrize("n", [0, 1, 2, BLOCK + 1])
def test_next_to_no_samples_are_no_error(n):
    values = np.ones((n, 6))
    nothing = np.full((1, 6), np.nan)
    curve = AllanCurve(np.ones(1), np.ones(1, np.int64), nothing, nothing, nothing, nothing, nothing, n)
    assert detect_spectral_lines_per_axis(values, np.zeros(n, bool), RATE_HZ, curve) == []
    assert shares(values).shape == (6,)


@pytest.mark.parametrize("scale", [1e-200, 1e12, 1e200])
def test_any_scale_is_borne(scale):
    assert found(scale * white(30_000)) == []
    assert shares(scale * white(30_000)).max() == 0.0


def test_nothing_is_scale_s_own():
    """A line and outliers are the same in any unit."""
    values = with_line(30_000, 2e-3, 17.3)
    values[np.random.default_rng(1).random(30_000) < 0.01, 0] += 1.0  # at random: a comb has lines
    [one] = found(values)
    [other] = found(2.0**20 * values)
    assert (other.frequency_hz, other.share) == (one.frequency_hz, one.share)
    assert other.amplitude == 2.0**20 * one.amplitude
    assert shares(2.0**20 * values).tolist() == shares(values).tolist()
    assert shares(values)[0] == pytest.approx(0.01, abs=2e-3)
