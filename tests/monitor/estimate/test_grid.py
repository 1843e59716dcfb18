"""A recording's grid in time, its rate, and what is said about times that are not what they should be."""

import os
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import NotReady
from drivers.sample import block
from monitor.estimate.grid import LONGEST_HOLE, NOTES, on_grid


def white(n, seed=0):
    return 1e-3 * np.random.default_rng(seed).standard_normal((n, 6)) + 9.81


def recording(t_s, values=None, rows=1000):
    t_ns = np.rint(np.asarray(t_s) * 1e9).astype(np.int64)
    values = white(len(t_ns)) if values is None else values
    edges = range(0, len(t_ns), rows)
    return [block(t_ns[a : a + rows].copy(), values[a : a + rows].copy()) for a in edges]


@pytest.mark.parametrize("rate", [100.0, None])
@pytest.mark.parametrize("rows", [17, 1000, 10**6])
def test_holes_stay_in_their_places(rate, rows):
    index = np.arange(8000)
    kept = ~((index >= 3000) & (index < 3123) | (index == 5000))
    values = white(8000)
    grid, found, notes = on_grid(recording(index[kept] / 100, values[kept], rows), rate)
    assert found == 100.0
    assert notes == ["124 samples are missing in 2 places; terms that touch them are left out"]
    assert np.array_equal(grid, np.where(kept[:, None], values, np.nan), equal_nan=True)


def test_a_very_long_pause_is_one_missing_sample():
    index = np.concatenate([np.arange(3000), 3000 + 2 * LONGEST_HOLE + np.arange(3000)])
    grid, _, notes = on_grid(recording(index / 100), 100.0)
    assert len(grid) == 6001
    assert any("too long to keep in place" in note for note in notes)


@pytest.mark.parametrize("rows", [17, 1000, 10**6])
def test_a_repeated_row_does_not_enter(rows):
    values = white(6000)
    sent = np.insert(np.arange(6000), 4000, 3990 + np.arange(10))
    grid, rate, notes = on_grid(recording(sent / 100, values[sent], rows), None)
    assert rate == 100.0
    assert np.array_equal(grid, values)
    assert notes == ["10 rows repeat others, time and values; left out"]


def test_rows_out_of_order_are_put_in_order():
    values = white(6000)
    sent = np.insert(np.delete(np.arange(6000), 2500), 2502, 2500)
    grid, _, notes = on_grid(recording(sent / 100, values[sent]), None)
    assert np.array_equal(grid, values)
    assert notes == ["rows that came out of order: 1; put in order"]


def test_more_than_ten_notes_are_counted():
    t = np.arange(40000) / 100
    for i in range(44):
        t[800 * (i + 1) :] += (-1) ** i * 4000.0
    _, _, notes = on_grid(recording(t), 100.0)
    of_clock = [note for note in notes if note.startswith("time went")]
    assert len(of_clock) == NOTES
    assert notes[NOTES] == "and 34 more notes on the times"


def test_steady_times_that_contradict_the_stated_rate():
    _, rate, notes = on_grid(recording(np.arange(6000) / 50), 100.0)
    assert rate == 100.0
    assert "the rate used is 100 Hz, but the times step by 0.02 s, 50 Hz" in notes


def test_unsteady_times_that_contradict_the_stated_rate():
    """A host that stamps in bursts: only the mean tells."""
    t = np.ceil(np.arange(20000) / 99.32 / 0.043) * 0.043 + np.tile([0.0, 0.001, 0.002, 0.003], 5000)
    _, _, notes = on_grid(recording(np.sort(t)), 80.0)
    assert any(note.startswith("the rate used is 80 Hz, but by the times 99.3") for note in notes)
    assert not any("rate used" in note for note in on_grid(recording(np.sort(t)), 100.0)[2])


@pytest.mark.parametrize("fraction", [0.12, 0.5])
@pytest.mark.parametrize("step", [1e-9, 2e-3])
def test_stale_rows_are_told_and_kept(fraction, step):
    """Also where neighbours are often equal by coarse resolution alone."""
    values = np.round(white(20000) / step) * step
    held = np.flatnonzero(np.random.default_rng(1).random(20000) < fraction)
    for row in held[held > 0]:
        values[row] = values[row - 1]
    grid, _, notes = on_grid(recording(np.arange(20000) / 100, values), None)
    assert np.array_equal(grid, values)
    (note,) = notes
    assert note.endswith("the sensor updates slower than it is read; they are kept")
    assert float(note.split()[0]) == pytest.approx(100 * fraction, rel=0.1)


def test_times_that_stand_still_ask_for_the_rate():
    with pytest.raises(NotReady, match="--rate"):
        on_grid(recording(np.zeros(500)), None)


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
def test_recordings_of_real_sensors(name, rate):
    if "IMU_MONITOR_DATA" not in os.environ:
        pytest.skip("IMU_MONITOR_DATA does not point to the recordings")
    from drivers.recording import iter_blocks, load_samples

    blocks = list(iter_blocks(load_samples(Path(os.environ["IMU_MONITOR_DATA"]) / f"{name}.npz")))
    received = sum(len(one) for one in blocks)
    grid, found, notes = on_grid(blocks, None)
    assert found == pytest.approx(rate, rel=0.01)
    assert received <= len(grid) <= 1.02 * received
    assert not any("repeat" in note or "out of order" in note for note in notes), notes
    _, _, notes = on_grid(blocks, 1.3 * rate)
    assert any("rate used" in note for note in notes)
