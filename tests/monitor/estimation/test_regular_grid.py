"""Tests of the time grid of a recording, its rate, and the notes about irregular times."""

import numpy as np
import pytest

from drivers.errors import NotReady
from monitor.estimation.regular_grid import MAX_CLOCK_NOTES, MAX_GAP_SAMPLES, place_samples_on_grid
from tests.support.recordings import recorded_blocks, recordings, white


def place_on_grid(blocks, rate_hz):
    """Return the values on the grid, the rate and the notes."""
    grid = place_samples_on_grid(blocks, rate_hz)
    return grid.values, grid.rate_hz, grid.notes_with_missing()


@pytest.mark.parametrize("rate", [100.0, None])
@pytest.mark.parametrize("rows", [17, 1000, 10**6])
def test_missing_samples_keep_their_positions(rate, rows):
    index = np.arange(8000)
    kept = ~((index >= 3000) & (index < 3123) | (index == 5000))
    values = white(8000)
    grid, found, notes = place_on_grid(recorded_blocks(index[kept] / 100, values[kept], rows), rate)
    assert found == 100.0
    assert notes == ["1.6 % of the samples are missing"]
    assert np.array_equal(grid, np.where(kept[:, None], values, np.nan), equal_nan=True)


def test_very_long_gap_is_one_missing_sample():
    index = np.concatenate([np.arange(3000), 3000 + 2 * MAX_GAP_SAMPLES + np.arange(3000)])
    grid, _, notes = place_on_grid(recorded_blocks(index / 100), 100.0)
    assert len(grid) == 6001
    assert any("too long to be kept" in note for note in notes)


@pytest.mark.parametrize("rows", [17, 1000, 10**6])
def test_repeated_row_is_left_out(rows):
    values = white(6000)
    sent = np.insert(np.arange(6000), 4000, 3990 + np.arange(10))
    grid, rate, notes = place_on_grid(recorded_blocks(sent / 100, values[sent], rows), None)
    assert rate == 100.0
    assert np.array_equal(grid, values)
    assert notes == ["10 rows repeat an earlier row with the same time and values, and are left out"]


def test_rows_out_of_order_are_sorted():
    values = white(6000)
    sent = np.insert(np.delete(np.arange(6000), 2500), 2502, 2500)
    grid, _, notes = place_on_grid(recorded_blocks(sent / 100, values[sent]), None)
    assert np.array_equal(grid, values)
    assert notes == ["rows out of order: 1; sorted by time"]


@pytest.mark.long
def test_more_than_ten_notes_are_counted():
    t = np.arange(40000) / 100
    for i in range(44):
        t[800 * (i + 1) :] += (-1) ** i * 4000.0
    _, _, notes = place_on_grid(recorded_blocks(t), 100.0)
    of_clock = [note for note in notes if note.startswith(("time went", "time jumped"))]
    assert len(of_clock) == MAX_CLOCK_NOTES
    assert notes[MAX_CLOCK_NOTES] == "and 34 more notes on the times"


def test_regular_times_that_contradict_the_rate_give_a_note():
    _, rate, notes = place_on_grid(recorded_blocks(np.arange(6000) / 50), 100.0)
    assert rate == 100.0
    assert "the rate used is 100 Hz, but the times increase in steps of 0.02 s, 50 Hz" in notes


def test_irregular_times_that_contradict_the_rate_give_a_note():
    """The host assigns times in bursts, so only their mean shows the rate."""
    t = np.ceil(np.arange(20000) / 99.32 / 0.043) * 0.043 + np.tile([0.0, 0.001, 0.002, 0.003], 5000)
    _, _, notes = place_on_grid(recorded_blocks(np.sort(t)), 80.0)
    assert any(note.startswith("the rate used is 80 Hz, but the times give a mean of 99.3") for note in notes)
    assert not any("rate used" in note for note in place_on_grid(recorded_blocks(np.sort(t)), 99.4)[2])


@pytest.mark.parametrize(("relative_error", "is_noted"), [(0.001, False), (0.003, True), (0.006, True)])
@pytest.mark.parametrize("jitter_s", [0.0, 5e-4])
def test_rate_is_contradicted_from_a_fifth_of_a_percent(relative_error, is_noted, jitter_s):
    t = np.arange(17000) / (250.0 * (1.0 - relative_error)) + jitter_s * np.random.default_rng(2).random(17000)
    _, rate, notes = place_on_grid(recorded_blocks(t), 250.0)
    assert rate == 250.0
    [*rates_hz] = [float(note.split("give a mean of ")[1].split()[0]) for note in notes if "give a mean of" in note]
    steps = [note for note in notes if "increase in steps of" in note]
    assert bool(rates_hz or steps) == is_noted
    assert rates_hz == pytest.approx([250.0 * (1.0 - relative_error)] * len(rates_hz), rel=1e-4)


@pytest.mark.parametrize("seed", range(20))
def test_short_or_irregular_times_contradict_no_rate(seed):
    """The mean of these times is wrong by half a percent and not known more accurately."""
    rng = np.random.default_rng(seed)
    t = np.arange(600) / 100 + 0.04 * rng.random(600)
    t[-1] += 0.03
    _, _, notes = place_on_grid(recorded_blocks(np.sort(t)), 100.0)
    assert not any("rate used" in note for note in notes)


@pytest.mark.parametrize(("unit_s", "resolution"), [(1.0, "1"), (0.5, "0.5"), (1.0 / 3.0, "0.333"), (10.0, "10")])
def test_coarse_resolution_of_times_gives_a_note(unit_s, resolution):
    t = np.floor(np.arange(8000) / 5.0 / unit_s + 1e-9) * unit_s
    _, _, notes = place_on_grid(recorded_blocks(t), None)
    assert notes == [f"times have a resolution of {resolution} s; equal time steps are assumed between pauses"]


def test_irregular_time_steps_give_a_note():
    t = np.cumsum(np.random.default_rng(3).exponential(0.01, 8000))
    _, _, notes = place_on_grid(recorded_blocks(t), None)
    assert any(note.startswith("time steps are uneven: median 0.0") for note in notes)


def test_missing_and_late_samples_are_noted_separately():
    """A bus adapter sends ten samples per second late by 0.9 periods and loses three samples in all."""
    index = np.delete(np.arange(30_000), [8089, 9780, 29_187])
    t = index / 100
    for since in range(85, len(t) - 20, 100):
        t[since : since + 10] += 0.009
    values = white(len(t))
    grid, rate, notes = place_on_grid(recorded_blocks(t, values), None)
    assert rate == 100.0
    assert np.flatnonzero(np.isnan(grid[:, 0])) == pytest.approx([8089, 9780, 29_187], abs=10)
    late, missing = notes
    assert missing == "0.01 % of the samples are missing"
    assert late.startswith("a sample was late by a period or more 29")
    assert late.endswith("later times show that no sample is missing there")


def test_coarse_values_are_noted_by_kind_and_size():
    values = white(20_000) - 9.81
    values[:, :3] = np.round(values[:, :3] / 1e-3) * 1e-3
    values[:, 4] = np.round(values[:, 4] / 4e-4) * 4e-4
    values[:, 5] = np.round(values[:, 5] / 2e-3) * 2e-3
    gyros, az = place_on_grid(recorded_blocks(np.arange(20_000) / 100, values), None)[2]
    size, times = gyros.removesuffix(" the noise from sample to sample; quantization affects the shortest τ").split(
        "), "
    )
    assert size == "values have steps of 0.057 °/s (gx, gy, gz"
    assert all(float(number) == pytest.approx(0.97, abs=0.05) for number in times.removesuffix(" times").split(" to "))
    assert az.startswith("values have steps of 0.2 mg (az), ")
    assert float(az.split("(az), ")[1].split()[0]) == pytest.approx(1.9, abs=0.3)


@pytest.mark.parametrize("fraction", [0.12, 0.5])
@pytest.mark.parametrize("step", [1e-9, 2e-3])
def test_repeated_rows_are_noted_and_kept(fraction, step):
    """This also holds if neighboring values are often equal because of coarse quantization."""
    values = np.round(white(20000) / step) * step
    repeated = np.flatnonzero(np.random.default_rng(1).random(20000) < fraction)
    for row in repeated[repeated > 0]:
        values[row] = values[row - 1]
    grid, _, notes = place_on_grid(recorded_blocks(np.arange(20000) / 100, values), None)
    assert np.array_equal(grid, values)
    (note,) = [note for note in notes if "have steps of" not in note]
    assert note.endswith("the sensor updates more slowly than it is read; these rows are kept")
    assert float(note.split()[0]) == pytest.approx(100 * fraction, rel=0.1)


def test_constant_times_ask_for_the_rate():
    with pytest.raises(NotReady, match="--rate"):
        place_on_grid(recorded_blocks(np.zeros(500)), None)


@pytest.mark.data
def test_late_bus_adapter_of_a_boat_loses_five_samples():
    from drivers.recordings import iter_blocks, load_samples

    blocks = list(iter_blocks(load_samples(recordings() / "can-boat/moored-5min.npz")))
    grid, _, notes = place_on_grid(blocks, None)
    assert "0.017 % of the samples are missing" in notes
    at_s = np.flatnonzero(np.isnan(grid[:, 0])) / 100
    assert at_s == pytest.approx([80.9, 97.8, 98.8, 101.8, 291.9], abs=0.4)  # the clock is slow by 0.08 %


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "rate"),
    [
        ("mpu6050-hosttime/static-11min", 99.32),
        ("px4-bench/bench-69s", 250.0),
        ("phone/gyro-a", 5.0),
        ("can-boat/moored-5min", 100.0),
        ("can-car/drive-a", 101.3),
        ("autopilot-3imu/imu1", 50.0),
        ("robot-arm/mpu9150", 103.6),
        ("robot-arm/mpu6500", 92.4),
    ],
)
def test_real_recordings_have_the_known_rate(name, rate):
    from drivers.recordings import iter_blocks, load_samples

    blocks = list(iter_blocks(load_samples(recordings() / f"{name}.npz")))
    received = sum(len(block) for block in blocks)
    grid, found, notes = place_on_grid(blocks, None)
    assert found == pytest.approx(rate, rel=0.01)
    assert received <= len(grid) <= 1.02 * received
    assert not any("repeat" in note or "out of order" in note for note in notes), notes
    _, _, notes = place_on_grid(blocks, 1.3 * rate)
    assert any("rate used" in note for note in notes)
