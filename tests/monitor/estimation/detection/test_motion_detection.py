"""Tests of motion detection: motion and knocks are found; noise, vibration, quantization and outliers are ignored."""

from itertools import pairwise

import numpy as np
import pytest

from drivers.data_types import AXES, make_block
from monitor.estimation.detection.motion_detection import BLOCK_S, MotionDetector, detect_motion, samples_per_block
from monitor.estimation.detection.motion_kernel import REFERENCE_BLOCKS, REMOVED_AFTER
from tests.support.recordings import recordings

RATE = 100.0
NOISE = np.array([1e-3, 1e-3, 1e-3, 1e-2, 1e-2, 1e-2])
MEAN_AT_REST = np.array([0.01, -0.02, 0.005, 0.1, -0.2, 9.81])


def simulate_rest(seconds, seed=0, rate=RATE):
    return MEAN_AT_REST + NOISE * np.random.default_rng(seed).standard_normal((round(seconds * rate), 6))


def add_hand_rotation(values, since_s, until_s, rate=RATE):
    """Add a rotation to and fro about x, which gx measures directly and ay and az measure through gravity."""
    t = np.arange(round((until_s - since_s) * rate)) / rate
    angle = 0.3 * np.sin(2 * np.pi * 0.7 * t) ** 2
    rows = slice(round(since_s * rate), round(since_s * rate) + t.size)
    values[rows, 0] += np.gradient(angle, 1 / rate)
    values[rows, 4] += 9.81 * np.sin(angle)
    values[rows, 5] += 9.81 * (np.cos(angle) - 1.0)
    return values


def detect_in_blocks(values, edges, lost_before=None, rate=RATE):
    """Return the joined output values and times, the detector and the largest delay in samples."""
    detector = MotionDetector(rate)
    out, max_delay = [], 0
    given = taken = 0
    for a, b in pairwise(edges):
        lost = lost_before if lost_before and a == lost_before else 0
        blocks = detector.advance_and_take_decided(make_block(np.arange(a, b), values[a:b].copy(), lost=lost))
        out += blocks
        given, taken = given + b - a, taken + sum(len(block) for block in blocks)
        max_delay = max(max_delay, given - taken)
    out += detector.flush_delayed_samples()
    return (
        np.concatenate([block.values for block in out]),
        np.concatenate([block.t_ns for block in out]),
        detector,
        max_delay,
    )


def test_motion_is_removed_from_its_start_to_its_end():
    values = add_hand_rotation(simulate_rest(60), 30.0, 34.3)
    mask, (motion,) = detect_motion(values, RATE)
    assert motion.kind == "motion"
    assert 29.0 <= motion.since / RATE <= 30.0
    assert 34.3 <= motion.until / RATE <= 35.5
    assert motion.seconds == pytest.approx(4.3, abs=2 * BLOCK_S + 0.25)
    expected = np.zeros(6000, bool)
    expected[motion.since : motion.until] = True
    assert np.array_equal(mask, expected)
    assert motion.axis in ("gx", "ay")
    assert motion.peak == pytest.approx(
        np.abs(values[:, AXES.index(motion.axis)] - MEAN_AT_REST[AXES.index(motion.axis)]).max(), rel=0.02
    )
    assert motion.text.startswith("moved for 4.")


@pytest.mark.parametrize("cut", ["rows", "blocks", "whole", "odd"])
def test_block_sizes_do_not_change_the_result(cut):
    values = add_hand_rotation(simulate_rest(40, seed=3), 10.0, 12.0)
    values[1703:1709, 3] += 3.0
    values[2500:2520] = np.nan
    edges = {
        "rows": range(4001),
        "blocks": range(0, 4001, 50),
        "whole": (0, 4000),
        "odd": sorted({0, 4000, *np.random.default_rng(1).integers(1, 4000, 60).tolist()}),
    }[cut]
    mask, motions = detect_motion(values, RATE)
    assert [motion.kind for motion in motions] == ["motion", "knock"]
    out, t, detector, _ = detect_in_blocks(values, list(edges))
    assert np.array_equal(out, np.where(mask[:, None], np.nan, values), equal_nan=True)
    assert np.array_equal(t, np.arange(4000))
    assert detector.take_motions() == motions
    assert detector.take_motions() == []
    assert detector.samples_in_motion == mask.sum()


def test_samples_are_delayed_by_two_blocks():
    *_, max_delay = detect_in_blocks(simulate_rest(20), list(range(2001)))
    assert max_delay == 2 * samples_per_block(RATE)


def test_missing_samples_keep_their_positions():
    values = add_hand_rotation(simulate_rest(40), 30.0, 32.0)
    _, (motion,) = detect_motion(values, RATE)
    kept = np.delete(values, slice(1000, 1260), axis=0)
    edges = [*range(0, 1000, 100), *range(1000, len(kept), 100), len(kept)]
    detector = MotionDetector(RATE)
    for a, b in pairwise(edges):
        detector.advance_and_take_decided(make_block(np.arange(a, b), kept[a:b].copy(), lost=260 if a == 1000 else 0))
    detector.flush_delayed_samples()
    (found,) = detector.take_motions()
    assert (found.kind, found.since, found.until) == (motion.kind, motion.since, motion.until)


def detect_in_stream(values):
    """Return the episodes if the missing rows are not received."""
    detector, previous = MotionDetector(RATE), -1
    present = np.flatnonzero(np.isfinite(values[:, 0]))
    for rows in np.split(present, np.flatnonzero(np.diff(present) > 1) + 1):
        lost = int(rows[0]) - previous - 1
        detector.advance_and_take_decided(make_block(rows, values[rows], lost=lost))
        previous = int(rows[-1])
    detector.flush_delayed_samples()
    return detector.take_motions()


@pytest.mark.parametrize("lost", [100, 300])
def test_burst_of_loss_within_a_motion_is_not_rest(lost):
    values = add_hand_rotation(simulate_rest(60), 30.0, 45.0)
    values[3600 : 3600 + lost] = np.nan
    _, motions = detect_motion(values, RATE)
    assert [motion.kind for motion in motions] == ["motion"]
    assert motions[0].seconds == pytest.approx(15.0, abs=1.0)
    assert detect_in_stream(values) == motions


def test_motions_before_and_after_a_long_gap_are_two():
    values = add_hand_rotation(add_hand_rotation(simulate_rest(100), 27.0, 30.1), 60.0, 63.0)
    values[3000:6000] = np.nan
    _, motions = detect_motion(values, RATE)
    assert [motion.seconds < 4.0 for motion in motions] == [True, True]
    assert detect_in_stream(values) == motions


@pytest.mark.parametrize("loss", ["random", "burst"])
def test_step_of_the_noise_is_not_motion_despite_loss(loss):
    called_motion = 0
    for seed in range(16):
        rng = np.random.default_rng(seed)
        values = 1e-3 * rng.standard_normal((9000, 6))
        values[4000:] *= 4.0
        if loss == "random":
            values[rng.random(9000) < 0.2] = np.nan
        else:
            begin = 4000 + int(rng.integers(50, 500))
            values[begin : begin + 300] = np.nan
        called_motion += any(motion.kind != "noise" for motion in detect_in_stream(values))
        called_motion += bool(detect_motion(values, RATE)[1])
    assert called_motion <= 2


def test_very_long_gap_takes_no_time():
    detector = MotionDetector(RATE)
    detector.advance_and_take_decided(make_block(np.arange(2000), simulate_rest(20)))
    detector.advance_and_take_decided(make_block(np.arange(2000), simulate_rest(20, seed=1), lost=10**12))
    detector.flush_delayed_samples()
    assert detector.take_motions() == []


def test_is_moving_is_true_during_motion():
    values = add_hand_rotation(simulate_rest(30), 20.0, 23.0)
    detector = MotionDetector(RATE)
    moving = []
    for a in range(0, 3000, 10):
        detector.advance_and_take_decided(make_block(np.arange(a, a + 10), values[a : a + 10].copy()))
        moving.append(detector.is_moving)
    seconds = np.flatnonzero(moving) / 10.0
    assert 20.0 < seconds[0] < 20.6
    assert 23.0 < seconds[-1] < 25.0
    detector.flush_delayed_samples()
    assert not detector.is_moving


def test_knock_is_found_and_a_single_outlier_is_not():
    values = simulate_rest(60)
    values[2000, 5] += 5.0  # one sample is an outlier, not a knock
    t = np.arange(12) / RATE
    values[4000:4012, 5] += 4.0 * np.exp(-t / 0.03) * np.cos(2 * np.pi * 31 * t)
    mask, (knock,) = detect_motion(values, RATE)
    assert (knock.kind, knock.axis) == ("knock", "az")
    assert knock.since <= 4000 < knock.until
    assert knock.text == "knocked: az up to 410 mg"
    assert mask.sum() <= (2 + 1 + REMOVED_AFTER) * samples_per_block(RATE)


def test_new_orientation_is_reported_and_accepted_as_rest():
    values = add_hand_rotation(simulate_rest(60), 30.0, 32.0)
    values[3200:, 3:] += [9.81 * np.sin(0.5), 0.0, 9.81 * (np.cos(0.5) - 1.0)]
    values[3200:, 0] += 2e-3  # g-sensitivity
    mask, (motion,) = detect_motion(values, RATE)
    assert motion.kind == "handling/orientation"
    assert motion.until / RATE < 34.5
    assert not mask[3450:].any()


@pytest.mark.parametrize("moving_s", [3.0, 20.0])
def test_motion_at_the_start_is_found(moving_s):
    values = simulate_rest(90)
    add_hand_rotation(values, 0.0, moving_s)
    values[: round(moving_s * RATE), 0] += 0.4 * np.sin(np.arange(round(moving_s * RATE)) / 9.0)
    add_hand_rotation(values, 70.0, 72.0)
    mask, motions = detect_motion(values, RATE)
    assert mask[: round(moving_s * RATE)].mean() > 0.8
    assert not mask[round((moving_s + 5.0) * RATE) : 6900].any()
    assert 69.0 < motions[-1].since / RATE <= 70.0


def test_slight_motion_at_the_start_is_unlearned():
    """The motion is too slight to be recognized, so it is learned as rest until much less noise follows."""
    values = simulate_rest(120)
    t = np.arange(1500) / RATE
    values[:1500, :3] += 0.05 * np.sin(2 * np.pi * np.outer(t, [3.1, 4.3, 5.9]))
    values[:1500, 3:] += 0.4 * np.sin(2 * np.pi * np.outer(t, [3.7, 4.9, 6.1]))
    add_hand_rotation(values, 60.0, 62.0)
    _, motions = detect_motion(values, RATE)
    assert [round(motion.since / RATE) for motion in motions] == [59] or [
        round(motion.since / RATE) for motion in motions
    ] == [60]


def test_vibration_that_varies_is_accepted_as_rest_after_a_minute():
    values = simulate_rest(240)
    rows = np.arange(len(values) - 10000)
    strength = 0.2 * (1.0 + 0.5 * np.sin(2 * np.pi * 0.3 / RATE * rows))
    values[10000:, 3:] += (strength * np.sin(2 * np.pi * 17.3 / RATE * rows))[:, None]
    mask, (motion,) = detect_motion(values, RATE)
    assert motion.since / RATE == pytest.approx(100.0, abs=0.5)
    assert 60.0 <= motion.seconds <= 67.0
    assert not mask[motion.until :].any()
    assert REFERENCE_BLOCKS * BLOCK_S == 60.0


@pytest.mark.parametrize("axes", [[2], [3], [0, 1, 2, 3, 4, 5]])
@pytest.mark.parametrize("factor", [2.0, 4.0, 10.0])
@pytest.mark.parametrize("since_s", [30, 100])
def test_step_of_the_noise_level_is_not_motion(axes, factor, since_s):
    values = simulate_rest(since_s + 60, seed=since_s)
    rows = slice(100 * since_s, None)
    values[rows, axes] = MEAN_AT_REST[axes] + factor * (values[rows, axes] - MEAN_AT_REST[axes])
    mask, motions = detect_motion(values, RATE)
    assert motions == []
    assert not mask.any()


@pytest.mark.parametrize("frequency_hz", [3.0, 23.4, 48.0])
def test_constant_sinusoid_is_not_motion(frequency_hz):
    values = simulate_rest(160)
    values[10000:, 0] += 0.02 * np.sin(2 * np.pi * frequency_hz / RATE * np.arange(6000))
    mask, motions = detect_motion(values, RATE)
    assert motions == []
    assert not mask.any()


@pytest.mark.parametrize(("frequency_hz", "size"), [(0.13, 20.0), (0.3, 10.0), (0.7, 10.0), (0.7, 50.0)])
def test_slow_sinusoid_that_stays_is_accepted_as_rest_after_a_minute(frequency_hz, size):
    values = simulate_rest(240)
    values[6000:, [2, 4]] += size * NOISE[[2, 4]] * np.sin(2 * np.pi * frequency_hz / RATE * np.arange(18000))[:, None]
    mask, motions = detect_motion(values, RATE)
    assert mask[6000:12000].any()
    assert not mask[14000:].any(), [motion.text for motion in motions]


@pytest.mark.parametrize("seconds", [0.5, 1.0, 3.0])
def test_short_vibration_is_motion(seconds):
    rng = np.random.default_rng(7)
    n = round(seconds * RATE)
    for vibration in (rng.standard_normal((n, 3)), np.sin(2 * np.pi * 0.3 * np.arange(n))[:, None]):
        values = simulate_rest(130)
        values[10000 : 10000 + n, 3:] += 0.2 * vibration
        mask, (motion,) = detect_motion(values, RATE)
        assert motion.since / RATE == pytest.approx(100.0, abs=0.5)
        assert mask[10000 : 10000 + n].all()


def test_continuous_motion_is_never_accepted_as_rest():
    values = simulate_rest(300)
    rng = np.random.default_rng(5)
    wander = np.convolve(rng.standard_normal(len(values) + 199), np.ones(200) / 200, "valid")
    values[6000:, :3] += 3.0 * wander[6000:, None]
    mask, _ = detect_motion(values, RATE)
    assert mask[6100:].mean() > 0.9


@pytest.mark.parametrize(("varies", "deviation"), [("frequency", 0.035), ("amplitude", 0.2)])
def test_irregular_oscillation_is_never_accepted_as_rest(varies, deviation):
    values = simulate_rest(300)
    rng = np.random.default_rng(5)
    n = len(values) - 3000
    factor = 1.0 + deviation * np.convolve(rng.standard_normal(n + 199), np.full(200, 200**-0.5), "valid")
    rows = np.cumsum(factor) if varies == "frequency" else np.arange(n)
    oscillation = 0.05 * np.sin(2 * np.pi * 0.7 / RATE * rows)
    values[3000:, 2] += oscillation if varies == "frequency" else oscillation * factor
    mask, _ = detect_motion(values, RATE)
    assert mask[3100:].mean() > 0.9


def test_constant_rate_is_accepted_as_rest_after_ten_seconds():
    values = simulate_rest(60)
    values[2000:, 2] += 0.5
    mask, (motion,) = detect_motion(values, RATE)
    assert motion.seconds == pytest.approx(10.0, abs=1.0)
    assert not mask[motion.until :].any()


@pytest.mark.parametrize(
    "disturbance",
    [
        "white",
        "line",
        "slow line",
        "modulated",
        "coarse",
        "three levels",
        "outliers",
        "random walk",
        "correlated",
        "ramp",
    ],
)
def test_noise_and_disturbances_are_no_motion(disturbance):
    rng = np.random.default_rng(7)
    values = simulate_rest(1200, seed=8)
    n = len(values)
    t = np.arange(n)[:, None] / RATE
    if disturbance == "line":
        values += 3 * NOISE * np.sin(2 * np.pi * 13.36 * t)
    elif disturbance == "slow line":
        values += 3 * NOISE * np.sin(2 * np.pi * 0.565 * t)
    elif disturbance == "modulated":
        values += 3 * NOISE * np.sin(2 * np.pi * 13.36 * t) * (1.0 + 0.9 * np.sin(2 * np.pi * 0.002 * t))
    elif disturbance == "coarse":
        values = np.round(values / (4 * NOISE)) * 4 * NOISE
    elif disturbance == "three levels":
        values = np.round((values - MEAN_AT_REST) / (1.5 * NOISE)).clip(-1, 1) * 1.5 * NOISE
    elif disturbance == "outliers":
        values += (rng.random((n, 6)) < 0.09) * 7 * NOISE * rng.standard_normal((n, 6))
    elif disturbance == "random walk":
        values += np.cumsum(0.02 * NOISE * rng.standard_normal((n, 6)), axis=0)
    elif disturbance == "correlated":
        for k in range(1, n):
            values[k] += 0.95 * (values[k - 1] - MEAN_AT_REST)
    elif disturbance == "ramp":
        values += 10 * NOISE * t / 60.0
    mask, motions = detect_motion(values, RATE)
    assert not mask.any(), [motion.text for motion in motions]


@pytest.mark.parametrize("rate", [4.16, 20.0, 262.0, 2000.0])
def test_motion_is_found_at_any_rate(rate):
    length_s = max(60.0, 300 / rate)
    values = add_hand_rotation(
        simulate_rest(length_s, rate=rate), length_s / 2, length_s / 2 + max(3.0, 20 / rate), rate
    )
    _, motions = detect_motion(values, rate)
    assert len(motions) == 1
    assert motions[0].since / rate <= length_s / 2 < motions[0].until / rate


def test_missing_and_constant_axes_are_accepted():
    values = add_hand_rotation(simulate_rest(60), 30.0, 33.0)
    values[:, 1:] = np.nan
    _, (motion,) = detect_motion(values, RATE)
    assert motion.axis == "gx"
    assert detect_motion(np.full((3000, 6), np.nan), RATE)[1] == []
    assert detect_motion(np.full((3000, 6), 1.5), RATE)[1] == []
    assert detect_motion(np.empty((0, 6)), RATE)[0].shape == (0,)


def test_constant_that_starts_to_toggle_is_no_motion():
    values = np.zeros((12000, 6))
    values[6000:] = 0.01 * (np.random.default_rng(0).random((6000, 6)) < 0.2)
    assert detect_motion(values, RATE)[1] == []


def load_recording(name):
    data = np.load(recordings() / f"{name}.npz")
    absent = np.full(len(data["gx"]), np.nan)
    values = np.stack([data[axis] if axis in data.files else absent for axis in AXES], axis=1)
    return values.astype(np.float64), float(data["fs"])


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "max_share"),
    [
        ("adis16405/run1", 0.0),
        ("adis16405/run2", 0.0),
        ("adis16405/run6", 0.0),
        ("ig500n/static-2h", 0.002),
        ("phone/gyro-a", 0.0),
        ("mpu6050-hosttime/static-11min", 0.0),
        ("mpu6050-arduino/static-7min", 0.0),
        ("xsens-mtig/contaminated-gx", 0.002),
        ("vn100-serial/static-12min", 0.01),  # touched at the very end
    ],
)
def test_static_recordings_are_at_rest(name, max_share):
    values, rate = load_recording(name)
    assert detect_motion(values, rate)[0].mean() <= max_share


@pytest.mark.data
def test_motion_by_hand_on_the_bench_is_found():
    values, rate = load_recording("px4-bench/bench-69s")
    _, (motion,) = detect_motion(values, rate)
    assert motion.since / rate == pytest.approx(1.9, abs=0.4)
    assert motion.until / rate == pytest.approx(6.9, abs=0.5)


@pytest.mark.data
@pytest.mark.parametrize("unit", ["imu1", "imu2", "imu3"])
def test_flight_is_motion_and_waiting_on_the_ground_is_rest(unit):
    values, rate = load_recording(f"autopilot-3imu/{unit}")
    mask, _ = detect_motion(values, rate)
    assert not mask[round(20 * rate) : round(55 * rate)].any()
    assert mask[round(72 * rate) :].mean() > 0.99


@pytest.mark.data
@pytest.mark.parametrize("unit", range(5))
def test_hand_rotations_and_rests_are_separated(unit):
    values, rate = load_recording(f"mpu9150-rotations/unit{unit}")
    mask, motions = detect_motion(values, rate)
    turning = np.abs(values[:, :3] - np.median(values[:, :3], axis=0)).max(axis=1) > 0.3
    assert mask[turning].mean() > 0.95
    assert 0.4 < mask.mean() < 0.65
    assert sum(motion.kind == "handling/orientation" for motion in motions) >= 18


@pytest.mark.data
def test_parking_and_driving_of_a_car_are_separated():
    values, rate = load_recording("can-car/drive-a")
    mask, _ = detect_motion(values, rate)
    for parked in ((54, 80), (178, 204), (286, 320)):
        assert not mask[round(parked[0] * rate) : round(parked[1] * rate)].any()
    for driving in ((212, 222), (330, 344)):
        assert mask[round(driving[0] * rate) : round(driving[1] * rate)].mean() > 0.95
