"""The watch: motion and changes become events with the times of the samples, and say which axis begins anew."""

import numpy as np
import pytest

from drivers.data_types import make_block
from monitor.estimation.detection.signal_monitor import SignalMonitor

RATE_HZ = 100.0
STEP_NS = 10_000_000
FIRST_NS = 1_700_000_000 * 10**9


def noise(n, seed=0):
    return 1e-3 * np.random.default_rng(seed).standard_normal((n, 6))


def feed(watch, values, size=250, lost=0):
    """Blocks in, those for the estimate out."""
    out = []
    for at in range(0, len(values), size):
        part = values[at : at + size]
        t_ns = FIRST_NS + STEP_NS * (np.arange(at, at + len(part)) + lost)
        out += watch.process_samples(make_block(t_ns, part, lost=lost if at == 0 else 0))
    return out


def seconds(t_ns):
    return (t_ns - FIRST_NS) / 1e9


@pytest.mark.parametrize("lost", [0, 300])
def test_louder_noise_is_an_event_with_its_time_and_a_restart_with_its_samples(lost):
    values = noise(40_000)
    values[30_000:, 1] *= 2.0
    watch = SignalMonitor(RATE_HZ)
    feed(watch, values, lost=lost)
    (event,) = watch.take_events()
    assert (event.kind, event.axis) == ("noise_changed", "gy")
    assert event.values["N"]["after"] / event.values["N"]["before"] == pytest.approx(2.0, rel=0.15)
    assert seconds(event.since_ns) == pytest.approx(300.0 + lost / RATE_HZ, abs=1.0)
    assert seconds(event.since_ns) < seconds(event.t_ns) < 310.0 + lost / RATE_HZ
    (restart,) = watch.take_restart_requests()
    assert restart.axis == 1
    assert 100 < restart.samples < 1500  # as many as had come since when it was found
    assert not watch.take_events()
    assert not watch.take_restart_requests()


@pytest.mark.parametrize("remove_motion", [False, True])
def test_motion_is_told_and_left_out_only_where_that_is_wanted(remove_motion):
    values = noise(12_000)
    values[8_000:8_300, 0] += 0.5 * np.sin(np.arange(300) / 15.0)
    watch = SignalMonitor(RATE_HZ, remove_motion)
    passed = feed(watch, values)
    assert not watch.is_moving
    passed += watch.flush_delayed_samples()
    out = np.concatenate([one.values for one in passed])
    assert len(out) == len(values)
    struck = np.isnan(out[:, 0])
    assert struck[8_000:8_300].all() if remove_motion else not struck.any()
    assert struck.sum() < 500
    assert np.array_equal(out[~struck], values[~struck])
    assert watch.samples_in_motion == (struck.sum() if remove_motion else watch.samples_in_motion) > 300
    (event,) = watch.take_events()
    assert (event.kind, event.axis) == ("moved", "gx")
    assert seconds(event.since_ns) == pytest.approx(80.0, abs=0.6)
    assert event.values["moved"]["peak"] == pytest.approx(0.5, rel=0.1)


@pytest.mark.parametrize("remove_motion", [False, True])
def test_what_is_at_rest_can_be_had_whatever_is_handed_on(remove_motion):
    values = noise(12_000)
    values[8_000:8_300, 0] += 0.5 * np.sin(np.arange(300) / 15.0)
    watch = SignalMonitor(RATE_HZ, remove_motion, keep_samples_at_rest=True)
    feed(watch, values)
    still = np.concatenate([one.values for one in watch.take_samples_with_motion_masked()])
    assert len(still) < len(values)  # the last are not judged yet
    watch.flush_delayed_samples()
    still = np.concatenate([still, *(one.values for one in watch.take_samples_with_motion_masked())])
    struck = np.isnan(still[:, 0])
    assert struck.sum() == watch.samples_in_motion > 300
    assert np.array_equal(still[~struck], values[~struck])
    assert watch.take_samples_with_motion_masked() == []
    assert watch.orientation_changes == 0


def test_still_samples_are_kept_only_for_who_wants_them():
    watch = SignalMonitor(RATE_HZ)
    feed(watch, noise(1000))
    assert watch.take_samples_with_motion_masked() == []


def test_being_left_in_another_orientation_is_counted():
    values = noise(12_000)
    values[:, 5] += 9.81
    values[6_000:6_200, 1] += 1.0
    values[6_100:, 3:6] = noise(12_000, 1)[6_100:, 3:6] + [9.81, 0.0, 0.0]
    watch = SignalMonitor(RATE_HZ)
    feed(watch, values)
    watch.flush_delayed_samples()
    assert watch.orientation_changes == 1


def test_motion_is_no_change_of_noise():
    values = noise(30_000)
    values[20_000:21_000, 3:] += 2.0 * np.random.default_rng(1).standard_normal((1000, 3))
    watch = SignalMonitor(RATE_HZ)
    feed(watch, values)
    assert {event.kind for event in watch.take_events()} == {"moved"}
    assert not watch.take_restart_requests()


def test_who_wants_no_changes_looks_for_none():
    values = noise(20_000)
    values[10_000:] *= 3.0
    watch = SignalMonitor(RATE_HZ, alarms_per_day=0.0)
    feed(watch, values)
    assert "noise_changed" not in {event.kind for event in watch.take_events()}


def test_a_rate_that_is_another_begins_to_learn_anew_and_keeps_its_counts():
    values = noise(12_000)
    values[8_000:8_300, 0] += 0.5 * np.sin(np.arange(300) / 15.0)
    watch = SignalMonitor(RATE_HZ)
    feed(watch, values)
    moved = watch.samples_in_motion
    watch.set_rate(RATE_HZ * 1.001)
    assert watch.samples_in_motion == moved > 0
    watch.set_rate(RATE_HZ * 2.0)
    assert watch.samples_in_motion == moved
    feed(watch, noise(1000, 5))
    assert watch.samples_in_motion == moved


@pytest.mark.parametrize("at", [2_600, 7_900, 9_050])
def test_at_another_rate_nothing_that_was_held_back_is_lost(at):
    """Also in the middle of a motion, which is told."""
    values = noise(12_000)
    values[7_700:8_000, 0] += 0.5 * np.sin(np.arange(300) / 15.0)
    watch, passed = SignalMonitor(RATE_HZ, remove_motion=True), []
    for first in range(0, len(values), 130):
        part = values[first : first + 130]
        passed += watch.process_samples(make_block(STEP_NS * np.arange(first, first + len(part)), part))
        if first <= at < first + 130:
            watch.set_rate(1.05 * RATE_HZ)
    passed += watch.flush_delayed_samples()
    assert np.array_equal(np.concatenate([one.t_ns for one in passed]), STEP_NS * np.arange(12_000))
    assert {event.kind for event in watch.take_events()} == {"moved"}
    assert watch.samples_in_motion == np.isnan(np.concatenate([one.values for one in passed])[:, 0]).sum() > 150


@pytest.mark.parametrize("remove_motion", [False, True])
def test_after_an_outage_of_years_changes_are_learned_anew_with_their_times(remove_motion):
    lost = 10**10
    values = noise(30_000)
    values[20_000:, 3] *= 2.0
    watch = SignalMonitor(RATE_HZ, remove_motion)
    feed(watch, noise(5_000, 9))
    t_ns = FIRST_NS + STEP_NS * (5_000 + lost + np.arange(len(values)))
    handed_on = watch.process_samples(make_block(t_ns[:250], values[:250], lost=lost))
    for at in range(250, len(values), 250):
        handed_on += watch.process_samples(make_block(t_ns[at : at + 250], values[at : at + 250]))
        if restarts := watch.take_restart_requests():
            break
    (event,) = watch.take_events()
    assert (event.kind, event.axis, restarts[0].axis) == ("noise_changed", "ax", 3)
    assert (event.since_ns - t_ns[20_000]) / 1e9 == pytest.approx(0.0, abs=1.0)
    newest_ns = handed_on[-1].t_ns[-1]
    assert newest_ns - restarts[0].samples * STEP_NS == pytest.approx(event.since_ns, abs=2 * STEP_NS)
