"""Tests that each cause is one finding and that findings are sorted by their share of the gap."""

from dataclasses import replace

import pytest

from monitor.noise.effects import AngleRandomWalk, BandwidthLimit, Narrowband
from monitor.noise.model import NoiseModel
from monitor.reconcile.result import (
    AllanInfluence,
    AxisModelDiagnostics,
    AxisResult,
    DiagnosticGap,
    Location,
    ParameterInterval,
    Reconciliation,
    RemainingGap,
)
from monitor.reconcile.summary.ranked_findings import rank_findings
from monitor.reconcile.summary.summary_sentences import describe_finding
from tests.monitor.reconcile.runs_made import around, step

EMPTY = AxisModelDiagnostics((), ())
N = 1e-4


def make_step(effect, gain, kind="added", ratio=1.0, **parameters):
    return replace(step(effect, kind=kind, **parameters), gain_nats=gain, allan=AllanInfluence(ratio, 0.1))


def make_remaining(group, gain, source=None):
    return RemainingGap(group, DiagnosticGap("psd", Location(source=source), (2.0 * gain) ** 0.5, 1.0, 2.0), gain)


def make_result(steps, remaining=None, effects=None, fitted_first=False) -> Reconciliation:
    remaining = remaining or {}
    axes = {
        axis: AxisResult(axis, "explained", EMPTY, tuple(found), (), EMPTY, tuple(remaining.get(axis, ())))
        for axis, found in steps.items()
    }
    given = NoiseModel({axis: (AngleRandomWalk(N=N), *(effects or ())) for axis in steps})
    return Reconciliation("explained", axes, given, given, fitted_first, 100.0, 1000, 10.0, 1)


def test_line_on_three_axes_is_one_finding():
    r = make_result({
        "gx": [make_step("sinusoidal", 100.0, frequency=around(17.3, 1e-3), ratio=1.1)],
        "gy": [make_step("narrowband", 300.0, frequency=around(17.31, 1e-2), bandwidth=0.1, ratio=0.5)],
        "gz": [
            make_step("sinusoidal", 50.0, frequency=around(25.0, 1e-3)),
            make_step("sinusoidal", 10.0, frequency=17.3),
        ],
    })  # fmt: skip
    first, second = rank_findings(r).findings
    assert (first.effect, first.axes, first.gain_nats) == ("narrowband", ("gx", "gy", "gz"), 410.0)
    assert first.parameters["frequency"].value == 17.31
    assert first.most_influenced_axis == "gy"
    assert (second.effect, second.axes, second.share) == ("sinusoidal", ("gz",), 50.0 / 460.0)


def test_steps_at_different_times_and_kinds_are_apart():
    r = make_result({
        "gx": [make_step("bias_step", 9.0, time=around(100.0, 0.1), height=1.0)],
        "gy": [make_step("bias_step", 8.0, time=around(100.1, 0.1), height=2.0)],
        "gz": [make_step("bias_step", 7.0, time=around(500.0, 0.1), height=2.0)],
    })  # fmt: skip
    assert [one.axes for one in rank_findings(r).findings] == [("gx", "gy"), ("gz",)]


def test_changed_sizes_with_equal_factors_are_one_finding():
    r = make_result({
        axis: [make_step("angle_random_walk", 10.0, kind="retuned", N=factor * N)]
        for axis, factor in (("gx", 1.2), ("gy", 1.21), ("gz", 1.5), ("ax", 1.2))
    })  # fmt: skip
    both, other, accelerometer = rank_findings(r).findings
    assert (both.axes, both.size_ratio) == (("gx", "gy"), pytest.approx(1.2))
    assert (other.axes, other.size_ratio) == (("gz",), pytest.approx(1.5))
    assert accelerometer.axes == ("ax",)
    assert rank_findings(replace(r, fitted_first=True)).findings == ()


def test_absent_resonance_is_named_with_its_frequency():
    effects = (Narrowband(1e-3, 8.0, 0.5), Narrowband(2e-3, 20.0, 0.5))
    r = make_result(
        {"gx": [make_step("narrowband", 10.0, kind="absent", sigma=ParameterInterval(0.0))]}, effects=effects
    )
    gone = replace(r, model=NoiseModel({"gx": (effects[0], replace(effects[1], sigma=0.0))}))
    (one,) = rank_findings(gone).findings
    assert (one.kind, one.parameters["frequency"].value, one.size_ratio) == ("absent", 20.0, None)


def test_retuned_resonance_is_compared_with_the_same_resonance():
    effects = (Narrowband(1e-3, 8.0, 0.5), Narrowband(2e-3, 20.0, 0.5))
    r = make_result({"gx": [make_step("narrowband", 10.0, kind="retuned", sigma=around(1e-3, 1e-5))]}, effects=effects)
    changed = replace(r, model=NoiseModel({"gx": (replace(effects[0], sigma=3e-3), replace(effects[1], sigma=1e-3))}))
    (one,) = rank_findings(changed).findings
    assert (one.parameters["frequency"].value, one.size_ratio) == (20.0, pytest.approx(0.5))
    assert one.old_frequency is None


def test_size_that_the_model_lacks_has_no_ratio():
    effects = (BandwidthLimit(cutoff=20.0),)
    r = make_result(
        {"gx": [make_step("bandwidth_limit", 10.0, kind="retuned", floor=around(1e-4, 1e-6))]}, effects=effects
    )
    (one,) = rank_findings(r).findings
    assert one.size_ratio is None


def test_moved_resonance_states_the_old_frequency():
    effects = (Narrowband(1e-3, 8.0, 0.5), Narrowband(2e-3, 20.0, 0.5))
    moved = make_step("narrowband", 10.0, kind="retuned", sigma=around(2e-3, 1e-5), frequency=around(19.5, 0.01))
    model = NoiseModel({"gx": (effects[0], replace(effects[1], frequency=19.5))})
    moved = replace(moved, moved_from=effects[1])
    (one,) = rank_findings(replace(make_result({"gx": [moved]}, effects=effects), model=model)).findings
    assert (one.old_frequency, one.size_ratio) == (20.0, pytest.approx(1.0))


def test_changed_cutoff_of_both_triads_is_one_finding():
    known, changed = BandwidthLimit(cutoff=40.0, floor=1e-5), BandwidthLimit(cutoff=20.0, floor=1e-5)
    steps = {
        axis: [make_step("bandwidth_limit", 10.0, kind="retuned", floor=around(1e-5, 0.0), cutoff=around(20.0, 0.1))]
        for axis in ("gx", "ax")
    }
    steps = {axis: [replace(step, moved_from=known) for step in found] for axis, found in steps.items()}
    r = make_result(steps, effects=(known,))
    r = replace(r, model=NoiseModel(dict.fromkeys(steps, (changed,))))
    (one,) = rank_findings(r).findings
    assert (one.axes, one.old_frequency) == (("gx", "ax"), 40.0)
    assert describe_finding(one) == "low-pass filter with a cutoff that moved from 40 to 20 Hz on gx and ax"


@pytest.mark.parametrize(("gyro", "accel"), [(1.05, 0.97), (1.08, 1.08)])
def test_changed_sizes_of_two_triads_are_two_findings(gyro, accel):
    steps = {
        axis: [make_step("angle_random_walk", 10.0, kind="retuned", N=around(N * ratio, N * 0.01))]
        for axis, ratio in (("gx", gyro), ("ax", accel))
    }
    assert [one.axes for one in rank_findings(make_result(steps)).findings] == [("gx",), ("ax",)]


def test_filter_of_another_order_states_the_order():
    known = BandwidthLimit(cutoff=28.0, order=1)
    step = make_step("bandwidth_limit", 10.0, kind="retuned", cutoff=around(28.0, 0.2), order=2.0)
    r = make_result({"gx": [replace(step, moved_from=known)]}, effects=(known,))
    r = replace(r, model=NoiseModel({"gx": (replace(known, order=2),)}))
    (one,) = rank_findings(r).findings
    assert one.old_frequency is None
    assert describe_finding(one) == "low-pass filter with a cutoff of 28 Hz of order 2 on gx"


def test_shares_of_findings_and_remaining_gaps_sum_to_one():
    line = make_step("sinusoidal", 60.0, frequency=17.3)
    r = make_result(
        {"gx": [line], "gy": []},
        {"gx": [make_remaining("spectrum", 30.0)], "gy": [make_remaining("distribution", 10.0)]},
    )
    ranking = rank_findings(r)
    assert ranking.whole_nats == 100.0
    assert [one.share for one in ranking.findings] == [0.6]
    assert [(one.axis, one.share) for one in ranking.remainders] == [("gx", 0.3), ("gy", 0.1)]
    assert ranking.explained_share == pytest.approx(0.6)


def test_dependence_of_two_axes_on_each_other_counts_once():
    leaks = {"gx": [make_remaining("other_axes", 30.0, "gy")], "gy": [make_remaining("other_axes", 40.0, "gx")]}
    ranking = rank_findings(make_result({"gx": [], "gy": []}, leaks))
    assert [(one.axis, one.gap.gain_nats) for one in ranking.remainders] == [("gy", 40.0)]
    same = {axis: [make_remaining("other_axes", 30.0, source)] for axis, source in (("gx", "gy"), ("gy", "gx"))}
    assert len(rank_findings(make_result({"gx": [], "gy": []}, same)).remainders) == 1


def test_recording_without_a_gap_is_explained():
    ranking = rank_findings(make_result({"gx": []}))
    assert (ranking.whole_nats, ranking.findings, ranking.explained_share) == (0.0, (), 1.0)
