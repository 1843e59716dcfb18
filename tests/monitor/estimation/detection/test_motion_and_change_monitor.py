"""Tests of the monitor that turns motion and changes into events and restarts the estimate of an axis."""

import numpy as np
import pytest

from drivers.data_types import make_block
from monitor.estimation.detection.motion_and_change_monitor import MotionAndChangeMonitor

RATE_HZ = 100.0
STEP_NS = 10_000_000
FIRST_NS = 1_700_000_000 * 10**9


def simulate_noise(n, seed=0):
    return 1e-3 * np.random.default_rng(seed).standard_normal((n, 6))


def process_in_blocks(monitor, values, size=250, lost=0):
    """Return the blocks that the monitor passes to the estimate."""
    out = []
    for at in range(0, len(values), size):
        part = values[at : at + size]
        t_ns = FIRST_NS + STEP_NS * (np.arange(at, at + len(part)) + lost)
        out += monitor.process_samples(make_block(t_ns, part, lost=lost if at == 0 else 0))
    return out


def convert_to_seconds(t_ns):
    return (t_ns - FIRST_NS) / 1e9


@pytest.mark.parametrize("lost", [0, 300])
def test_increased_noise_gives_an_event_and_a_restart_request(lost):
    values = simulate_noise(40_000)
    values[30_000:, 1] *= 2.0
    monitor = MotionAndChangeMonitor(RATE_HZ)
    process_in_blocks(monitor, values, lost=lost)
    (event,) = monitor.take_events()
    assert (event.kind, event.axis) == ("noise_changed", "gy")
    assert event.values["N"]["after"] / event.values["N"]["before"] == pytest.approx(2.0, rel=0.15)
    assert convert_to_seconds(event.since_ns) == pytest.approx(300.0 + lost / RATE_HZ, abs=1.0)
    assert convert_to_seconds(event.since_ns) < convert_to_seconds(event.t_ns) < 310.0 + lost / RATE_HZ
    (restart,) = monitor.take_restart_requests()
    assert restart.axis == 1
    assert 100 < restart.samples < 1500  # the samples since the change when it was found
    assert not monitor.take_events()
    assert not monitor.take_restart_requests()


@pytest.mark.parametrize("remove_motion", [False, True])
def test_motion_is_reported_and_removed_only_on_request(remove_motion):
    values = simulate_noise(12_000)
    values[8_000:8_300, 0] += 0.5 * np.sin(np.arange(300) / 15.0)
    monitor = MotionAndChangeMonitor(RATE_HZ, remove_motion)
    passed = process_in_blocks(monitor, values)
    assert not monitor.is_moving
    passed += monitor.flush_delayed_samples()
    out = np.concatenate([block.values for block in passed])
    assert len(out) == len(values)
    removed = np.isnan(out[:, 0])
    assert removed[8_000:8_300].all() if remove_motion else not removed.any()
    assert removed.sum() < 500
    assert np.array_equal(out[~removed], values[~removed])
    assert monitor.samples_in_motion == (removed.sum() if remove_motion else monitor.samples_in_motion) > 300
    (event,) = monitor.take_events()
    assert (event.kind, event.axis) == ("moved", "gx")
    assert convert_to_seconds(event.since_ns) == pytest.approx(80.0, abs=0.6)
    assert event.values["moved"]["peak"] == pytest.approx(0.5, rel=0.1)


@pytest.mark.parametrize("remove_motion", [False, True])
def test_samples_at_rest_are_available_with_and_without_removal(remove_motion):
    values = simulate_noise(12_000)
    values[8_000:8_300, 0] += 0.5 * np.sin(np.arange(300) / 15.0)
    monitor = MotionAndChangeMonitor(RATE_HZ, remove_motion, keep_samples_at_rest=True)
    process_in_blocks(monitor, values)
    at_rest = np.concatenate([block.values for block in monitor.take_samples_with_motion_masked()])
    assert len(at_rest) < len(values)  # the last samples are not classified yet
    monitor.flush_delayed_samples()
    at_rest = np.concatenate([at_rest, *(block.values for block in monitor.take_samples_with_motion_masked())])
    removed = np.isnan(at_rest[:, 0])
    assert removed.sum() == monitor.samples_in_motion > 300
    assert np.array_equal(at_rest[~removed], values[~removed])
    assert monitor.take_samples_with_motion_masked() == []
    assert monitor.orientation_changes == 0


def test_samples_at_rest_are_kept_only_on_request():
    monitor = MotionAndChangeMonitor(RATE_HZ)
    process_in_blocks(monitor, simulate_noise(1000))
    assert monitor.take_samples_with_motion_masked() == []


def test_change_of_orientation_is_counted():
    values = simulate_noise(12_000)
    values[:, 5] += 9.81
    values[6_000:6_200, 1] += 1.0
    values[6_100:, 3:6] = simulate_noise(12_000, 1)[6_100:, 3:6] + [9.81, 0.0, 0.0]
    monitor = MotionAndChangeMonitor(RATE_HZ)
    process_in_blocks(monitor, values)
    monitor.flush_delayed_samples()
    assert monitor.orientation_changes == 1


def test_motion_is_not_reported_as_changed_noise():
    values = simulate_noise(30_000)
    values[20_000:21_000, 3:] += 2.0 * np.random.default_rng(1).standard_normal((1000, 3))
    monitor = MotionAndChangeMonitor(RATE_HZ)
    process_in_blocks(monitor, values)
    assert {event.kind for event in monitor.take_events()} == {"moved"}
    assert not monitor.take_restart_requests()


def test_zero_alarms_per_day_disables_change_detection():
    values = simulate_noise(20_000)
    values[10_000:] *= 3.0
    monitor = MotionAndChangeMonitor(RATE_HZ, alarms_per_day=0.0)
    process_in_blocks(monitor, values)
    assert "noise_changed" not in {event.kind for event in monitor.take_events()}


def test_different_rate_restarts_learning_and_keeps_the_counts():
    values = simulate_noise(12_000)
    values[8_000:8_300, 0] += 0.5 * np.sin(np.arange(300) / 15.0)
    monitor = MotionAndChangeMonitor(RATE_HZ)
    process_in_blocks(monitor, values)
    moved = monitor.samples_in_motion
    monitor.set_rate(RATE_HZ * 1.001)
    assert monitor.samples_in_motion == moved > 0
    monitor.set_rate(RATE_HZ * 2.0)
    assert monitor.samples_in_motion == moved
    process_in_blocks(monitor, simulate_noise(1000, 5))
    assert monitor.samples_in_motion == moved


@pytest.mark.parametrize("at", [2_600, 7_900, 9_050])
def test_change_of_rate_loses_no_delayed_samples(at):
    """This also holds during a motion, which is still reported."""
    values = simulate_noise(12_000)
    values[7_700:8_000, 0] += 0.5 * np.sin(np.arange(300) / 15.0)
    monitor, passed = MotionAndChangeMonitor(RATE_HZ, remove_motion=True), []
    for first in range(0, len(values), 130):
        part = values[first : first + 130]
        passed += monitor.process_samples(make_block(STEP_NS * np.arange(first, first + len(part)), part))
        if first <= at < first + 130:
            monitor.set_rate(1.05 * RATE_HZ)
    passed += monitor.flush_delayed_samples()
    assert np.array_equal(np.concatenate([block.t_ns for block in passed]), STEP_NS * np.arange(12_000))
    assert {event.kind for event in monitor.take_events()} == {"moved"}
    assert monitor.samples_in_motion == np.isnan(np.concatenate([block.values for block in passed])[:, 0]).sum() > 150


@pytest.mark.parametrize("remove_motion", [False, True])
def test_changes_after_a_very_long_gap_have_correct_times(remove_motion):
    lost = 10**10
    values = simulate_noise(30_000)
    values[20_000:, 3] *= 2.0
    monitor = MotionAndChangeMonitor(RATE_HZ, remove_motion)
    process_in_blocks(monitor, simulate_noise(5_000, 9))
    t_ns = FIRST_NS + STEP_NS * (5_000 + lost + np.arange(len(values)))
    passed = monitor.process_samples(make_block(t_ns[:250], values[:250], lost=lost))
    for at in range(250, len(values), 250):
        passed += monitor.process_samples(make_block(t_ns[at : at + 250], values[at : at + 250]))
        if restarts := monitor.take_restart_requests():
            break
    (event,) = monitor.take_events()
    assert (event.kind, event.axis, restarts[0].axis) == ("noise_changed", "ax", 3)
    assert (event.since_ns - t_ns[20_000]) / 1e9 == pytest.approx(0.0, abs=1.0)
    newest_ns = passed[-1].t_ns[-1]
    assert newest_ns - restarts[0].samples * STEP_NS == pytest.approx(event.since_ns, abs=2 * STEP_NS)
