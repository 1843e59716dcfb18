"""Tests of the analysis of a whole recording: time grid, rate, notes, motion and changes."""

import re
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from drivers.errors import ConfigError, NotReady
from drivers.recordings import iter_blocks, load_samples
from monitor.estimation.allan.batch import overlapping_avar
from monitor.estimation.analysis import MIN_SAMPLES, analyze, detect_disturbances
from monitor.estimation.detection.motion_detection import detect_motion
from monitor.estimation.fit.coefficients_with_intervals import Status
from monitor.estimation.regular_grid import MAX_GAP_SAMPLES, place_samples_on_grid
from tests.support.recordings import recorded_blocks, recordings, white


@pytest.mark.parametrize("rate", [100.0, None])
@pytest.mark.parametrize("rows", [17, 1000, 10**6])
def test_analysis_of_a_regular_recording_gives_rate_and_coefficients(rate, rows):
    values = white(6000)
    found = analyze(recorded_blocks(np.arange(6000) / 100, values, rows), rate)
    assert found.notes == ()
    assert found.seconds == 60.0
    estimate = found.estimate
    assert (estimate.rate_hz, estimate.samples, estimate.window_s) == (100.0, 6000, 60.0)
    assert estimate.curve.avar == pytest.approx(overlapping_avar(values, estimate.curve.factors)[0])
    assert (estimate.coefficients.status[1] == Status.ESTIMATED).all()
    assert estimate.coefficients.value[1] == pytest.approx(1e-4, rel=0.1)


@pytest.mark.parametrize(
    ("lost", "expected"),
    [
        (slice(7, None, 50), r"2 % of the samples are missing: intervals of (Q \d %, )?N \d %, .* wider"),
        ([4000], "0.0083 % of the samples are missing: intervals hardly wider"),
    ],
)
def test_note_says_which_share_is_missing_and_what_it_costs(lost, expected):
    kept = np.ones(12_000, bool)
    kept[lost] = False
    found = analyze(recorded_blocks(np.flatnonzero(kept) / 100, white(12_000)[kept]), 100.0)
    (note,) = found.notes
    assert re.fullmatch(expected, note)


def assert_same_coefficients(found, expected, axes=slice(None)):
    for name in ("status", "value", "lo", "hi"):
        values = (getattr(one.estimate.coefficients, name)[:, axes] for one in (found, expected))
        assert np.array_equal(*values, equal_nan=True), name


def simulate_loss(n):
    rng = np.random.default_rng(3)
    lost = rng.random(n) < 0.03
    lost[n // 2 : n // 2 + 150] = True
    lost[[0, -1]] = False
    return lost


@pytest.mark.parametrize("kind", ["nan", "###", "inf", "1e200", ""])
def test_corrupt_rows_give_the_coefficients_of_a_recording_without_them(tmp_path, kind):
    values, lost = white(12_000), simulate_loss(12_000)
    head = "t,gx,gy,gz,ax,ay,az"
    rows = [f"{i / 100:.2f},{','.join(repr(x) for x in row)}" for i, row in enumerate(values.tolist())]
    kept = [row for row, is_lost in zip(rows, lost, strict=True) if not is_lost]
    rows = [f"{i / 100:.2f}{f',{kind}' * 6}" if lost[i] else row for i, row in enumerate(rows)]
    found = []
    for name, lines in (("corrupt.csv", rows), ("deleted.csv", kept)):
        path = tmp_path / name
        path.write_text("\n".join([head, *lines]))
        found.append(analyze(list(iter_blocks(load_samples(path))), 100.0))
    assert_same_coefficients(*found)


def test_missing_samples_of_one_axis_are_missing_samples_of_this_axis_only():
    values, lost = white(12_000), simulate_loss(12_000)
    t, partly = np.arange(12_000) / 100, values.copy()
    partly[lost, 2] = np.nan
    found = analyze(recorded_blocks(t, partly), 100.0)
    assert_same_coefficients(found, analyze(recorded_blocks(t[~lost], values[~lost]), 100.0), 2)
    assert_same_coefficients(found, analyze(recorded_blocks(t, values), 100.0), [0, 1, 3, 4, 5])


def test_excluded_motion_gives_the_coefficients_of_a_recording_without_these_rows():
    values, t = white(12_000), np.arange(12_000) / 100
    values[5000:5400, 0] += 0.05 * np.sin(np.arange(400) / 20)
    moving, _ = detect_motion(values, 100.0)
    assert 400 <= moving.sum() < 600
    found = analyze(recorded_blocks(t, values), 100.0, remove_motion=True)
    assert_same_coefficients(found, analyze(recorded_blocks(t[~moving], values[~moving]), 100.0))


@pytest.mark.parametrize(("every", "line_hz"), [(50, 1.5725), (50, 20.0), (64, 3.1)])
def test_periodic_loss_beside_a_line_lowers_no_limit_below_the_noise(every, line_hz):
    """The missing samples have nearly the same phase, so the correction for missing samples is too large."""
    index = np.arange(60_000)
    values = white(60_000) + 1e-2 * np.sin(2.0 * np.pi * line_hz * index / 100.0)[:, None]
    kept = index % every > 0
    c = analyze(recorded_blocks(index[kept] / 100, values[kept], 10**6), 100.0).estimate.coefficients
    assert (c.status[1] == Status.UPPER_BOUND).all()
    assert (c.hi[1] > 1e-4).all()


def test_very_long_gap_is_not_counted_among_the_short_gaps():
    index = np.concatenate([np.arange(3000), 3000 + 2 * MAX_GAP_SAMPLES + np.arange(3000)])
    index = np.delete(index, [1000, 1001, 1002])
    grid = place_samples_on_grid(recorded_blocks(index / 100, white(5997)), 100.0)
    assert "0.067 % of the samples are missing" in grid.notes_with_missing()


def test_very_long_gap_takes_no_memory_and_no_term_crosses_it():
    t = np.concatenate([np.arange(3000) / 100, 30.0 + 2 * MAX_GAP_SAMPLES / 100 + np.arange(3000) / 100])
    values = white(6000)
    values[3000:] += 1.0  # a step that would affect every term across the gap
    found = analyze(recorded_blocks(t, values), 100.0)
    assert any("too long to be kept" in note for note in found.notes)
    assert found.estimate.curve.n == 6001
    assert np.nanmax(found.estimate.curve.avar) < 2e-6


@pytest.mark.parametrize("jump_s", [-40.0, 5 * 3600.0])
def test_jump_of_the_times_does_not_affect_the_rate(jump_s):
    t = np.concatenate([np.arange(5000) / 100, 50.0 + jump_s + np.arange(5000) / 100])
    found = analyze(recorded_blocks(t), None)
    assert found.estimate.rate_hz == 100.0
    assert any(note.startswith(("time went", "time jumped")) for note in found.notes)


def test_jitter_of_the_times_causes_no_gaps():
    t = np.arange(8000) / 100 + 0.001 * np.random.default_rng(1).standard_normal(8000)
    found = analyze(recorded_blocks(t), None)
    assert (found.estimate.rate_hz, found.estimate.curve.n) == (100.0, 8000)


@pytest.mark.parametrize("n", [1, 2, MIN_SAMPLES - 1])
def test_too_short_recording_is_refused(n):
    with pytest.raises(NotReady):
        analyze(recorded_blocks(np.arange(n) / 100), None)
    with pytest.raises(NotReady, match="at least 50"):
        analyze(recorded_blocks(np.arange(n) / 100), 100.0)


def test_constant_times_ask_for_the_rate():
    with pytest.raises(NotReady, match="--rate"):
        analyze(recorded_blocks(np.zeros(500)), None)


def test_listed_tau_are_used():
    blocks = recorded_blocks(np.arange(6000) / 100)
    assert analyze(blocks, 100.0, (0.1, 1.0)).estimate.curve.tau_s.tolist() == [0.1, 1.0]
    with pytest.raises(ConfigError):
        analyze(blocks, 100.0, (100.0,))


def test_absent_axis_is_unestimated_without_a_note():
    values = white(6000)
    values[:, 3:] = np.nan
    found = analyze(recorded_blocks(np.arange(6000) / 100, values), None, reading_notes=["of the file"])
    assert found.notes == ("of the file",)
    assert (found.estimate.coefficients.status[:, 3:] == Status.UNESTIMATED).all()
    assert (found.estimate.coefficients.status[1, :3] == Status.ESTIMATED).all()


@pytest.mark.long
@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "rate"),
    [
        ("mpu6050-hosttime/static-11min.npz", 99.32),
        ("mpu6050-arduino/static-7min.npz", 100.0),
        ("px4-bench/bench-69s.npz", 250.0),
        ("vn100-serial/static-12min.npz", 40.0),
        ("phone/gyro-a.npz", 5.0),
        ("autopilot-3imu/imu1.npz", 50.0),
    ],
)
def test_real_recordings_have_the_known_rate(name, rate):
    loaded = load_samples(recordings() / name)
    blocks = list(iter_blocks(loaded))
    found = analyze(blocks, None, reading_notes=loaded.notes)
    assert found.estimate.rate_hz == pytest.approx(rate, rel=0.01)
    received = sum(len(block) for block in blocks)
    assert received <= found.estimate.curve.n <= 1.02 * received
    assert (found.estimate.coefficients.status[1, :3] != Status.UNESTIMATED).all()


def test_too_few_tau_for_a_fit_give_a_note():
    found = analyze(recorded_blocks(np.arange(6000) / 100), 100.0, (0.1, 1.0, 10.0))
    assert found.notes == ("3 averaging times are too few to fit five terms; at least 5 are needed",)
    assert (found.estimate.coefficients.status == Status.UNESTIMATED).all()


def test_times_that_contradict_the_stated_rate_give_a_note():
    found = analyze(recorded_blocks(np.arange(6000) / 50), 100.0)
    assert "the rate used is 100 Hz, but the times increase in steps of 0.02 s, 50 Hz" in found.notes


# --- motion and changes


def simulate_motion(n=12_000):
    """Return two minutes at 100 Hz with three seconds of rotation in the middle."""
    values = white(n)
    values[6000:6300, 0] += np.sin(np.arange(300) / 20)
    return values


def test_motion_is_reported_and_removed_only_on_request():
    blocks = recorded_blocks(np.arange(12_000) / 100, simulate_motion())
    left = analyze(blocks, 100.0)
    assert left.motions == ()
    assert not any("moved" in note for note in left.notes)  # only detect_disturbances looks for motion
    with_motion = detect_disturbances(left)
    [motion] = with_motion.motions
    assert 5900 <= motion.since < 6000
    assert "the sensor moved once, 3 s in all: not removed; --rest removes the samples in motion" in with_motion.notes
    assert any(note.startswith(f"at {motion.since / 100:.1f} s: moved for 3.0 s: gx") for note in with_motion.notes)
    removed = detect_disturbances(analyze(blocks, 100.0, remove_motion=True))
    assert removed.motions == with_motion.motions
    assert sum("s in all: removed" in note for note in removed.notes) == 1
    assert np.isnan(removed.values[motion.since : motion.until]).all()
    assert not np.isnan(removed.values[: motion.since]).any()
    assert left.estimate.curve.avar[0, 0] > 1.5 * removed.estimate.curve.avar[0, 0]
    assert removed.estimate.curve.avar[0] == pytest.approx(np.full(6, 1e-6), rel=0.1)
    assert (removed.seconds, removed.estimate.curve.n) == (120.0, 12_000)


@pytest.mark.long
def test_motion_is_not_reported_as_changed_noise():
    values = simulate_motion(30_000)
    assert detect_disturbances(analyze(recorded_blocks(np.arange(30_000) / 100, values), 100.0)).changes == ()


def test_change_of_noise_is_reported_with_time_and_size():
    values = white(60_000)
    values[40_000:, 2] += 1.5e-3 * np.random.default_rng(9).standard_normal(20_000)
    found = detect_disturbances(
        analyze(recorded_blocks(np.arange(60_000) / 100, values), 100.0, reading_notes=["of the file"])
    )
    [change] = found.changes
    assert (change.kind, change.axis) == ("noise_changed", 2)
    assert change.since == pytest.approx(40_000, abs=50)
    assert found.notes[0] == "of the file"
    [note] = [note for note in found.notes if "angle random walk" in note]
    assert re.fullmatch(r"at (399|400)\.\d s: gz angle random walk rose by [78]\d % \(\d+\.\d σ\)", note)
    assert (
        "the curve of the whole recording mixes both noise levels; curves over time (--window S) separate them"
        in found.notes
    )


def test_recording_without_rest_is_refused():
    rng = np.random.default_rng(0)
    values = np.cumsum(rng.standard_normal((120, 6)), axis=0)
    with pytest.raises(NotReady, match=r"\d+ samples at rest; at least 50 are needed"):
        analyze(recorded_blocks(np.arange(120) / 100, values), 100.0, remove_motion=True)


def test_parallel_axes_give_the_same_result():
    blocks = recorded_blocks(np.arange(6000) / 100)
    with ThreadPoolExecutor(2) as pool:
        side_by_side = analyze(blocks, 100.0, map_axes=pool.map)
    assert np.array_equal(side_by_side.estimate.curve.avar, analyze(blocks, 100.0).estimate.curve.avar)
