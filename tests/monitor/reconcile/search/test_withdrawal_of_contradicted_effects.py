"""Tests of the withdrawal of effects that other effects or diagnostics contradict."""

import pytest

from monitor.noise.effects import (
    BandwidthLimit,
    BiasStep,
    CrossAxis,
    ExponentiallyCorrelated,
    Narrowband,
    PulseTrain,
    Sinusoidal,
)
from monitor.reconcile.diagnostics.null_distribution import NullDistribution
from monitor.reconcile.diagnostics.whiteness_tests import WhitenessDeparture
from monitor.reconcile.result import Location
from monitor.reconcile.search.withdrawal_of_contradicted_effects import keep_uncontradicted_effects

QUIET = {
    diagnostic: WhitenessDeparture(1.0, Location(frequency=(1.0, 2.0)))
    for diagnostic in ("psd", "lines", "spectrogram")
}
QUIET |= {
    diagnostic: WhitenessDeparture(1.0, Location()) for diagnostic in ("level", "other_axes", "tails", "variance")
}
NULL = dict.fromkeys(QUIET, NullDistribution(6.0, 12.0))


def make_lines(*f_hz):
    return tuple(Sinusoidal(amplitude=1e-4, frequency=f, phase=0.0) for f in f_hz)


def list_kept(found, seen=QUIET, closing=None):
    return [type(effect) for effect in keep_uncontradicted_effects(found, closing or {}, seen, NULL, 100.0)]


def test_distant_lines_are_kept():
    assert list_kept(make_lines(7.0, 17.3, 31.0)) == [Sinusoidal] * 3


def test_lines_at_one_frequency_are_withdrawn_as_an_unstable_line():
    assert list_kept((*make_lines(17.28, 17.3, 17.32), BiasStep(time=60.0, height=1.0))) == [BiasStep]


def test_line_on_a_resonance_is_withdrawn_with_it():
    assert list_kept((*make_lines(17.3), Narrowband(sigma=1e-4, frequency=17.0, bandwidth=1.0))) == []


def test_comb_of_lines_is_withdrawn_as_a_pulse():
    assert list_kept(make_lines(3.0, 5.0, 9.0, 14.0)) == []
    assert list_kept((*make_lines(3.0, 5.0, 9.0, 14.0), Narrowband(sigma=1e-4, frequency=33.3, bandwidth=1.0))) == [
        Narrowband
    ]


def test_three_harmonics_are_kept():
    assert list_kept(make_lines(10.0, 20.0, 30.0)) == [Sinusoidal] * 3


@pytest.mark.parametrize(("left", "stands"), [(50.0, False), (15.0, True)])
def test_resonance_is_kept_if_it_closed_most_of_its_gap(left, stands):
    seen = {**QUIET, "psd": WhitenessDeparture(left, Location(frequency=(16.0, 18.0)))}
    found = (Narrowband(sigma=1e-4, frequency=17.0, bandwidth=1.0),)
    assert bool(list_kept(found, seen, {Narrowband: 200.0})) == stands


@pytest.mark.parametrize(("highest_hz", "stands"), [(18.0, False), (25.0, True)])
def test_change_in_time_over_a_wide_band_does_not_contradict_a_resonance(highest_hz, stands):
    seen = {**QUIET, "spectrogram": WhitenessDeparture(150.0, Location(frequency=(0.0, highest_hz)))}
    found = (Narrowband(sigma=1e-4, frequency=17.0, bandwidth=1.0),)
    assert bool(list_kept(found, seen, {Narrowband: 200.0})) == stands


@pytest.mark.parametrize(("left", "stands"), [(5.0, True), (30.0, True), (60.0, False)])
def test_pulses_are_kept_if_they_closed_most_of_the_harmonics(left, stands):
    pulses = (PulseTrain(height=1.0, period=1.0, width=0.1, delay=0.0),)
    seen = {**QUIET, "lines": WhitenessDeparture(left, Location(frequency=(1.0, 1.1)))}
    assert bool(list_kept(pulses, seen, {PulseTrain: 400.0})) == stands


def test_pulses_with_lines_on_their_harmonics_have_another_shape():
    pulses = PulseTrain(height=1.0, period=0.5, width=0.1, delay=0.0)
    assert list_kept((*make_lines(1.0, 3.0), pulses)) == []
    assert list_kept((*make_lines(1.0, 2.777), pulses)) == [Sinusoidal, Sinusoidal, PulseTrain]


def test_low_pass_is_kept_in_spite_of_other_gaps():
    seen = {**QUIET, "psd": WhitenessDeparture(150.0, Location(frequency=(0.1, 0.2)))}
    assert list_kept((BandwidthLimit(cutoff=20.0, order=2),), seen, {BandwidthLimit: 200.0}) == [BandwidthLimit]
    above = {**QUIET, "psd": WhitenessDeparture(150.0, Location(frequency=(30.0, 40.0)))}
    assert list_kept((BandwidthLimit(cutoff=20.0, order=2),), above, {BandwidthLimit: 200.0}) == []


@pytest.mark.parametrize("left", [150.0, 50.0])
def test_small_difference_at_a_strong_line_does_not_contradict_a_low_pass(left):
    found = (BandwidthLimit(cutoff=20.0, order=2), Narrowband(sigma=1e-4, frequency=33.0, bandwidth=0.1))
    seen = {**QUIET, "spectrogram": WhitenessDeparture(left, Location(frequency=(32.0, 34.0)))}
    stands = list_kept(found, seen, {BandwidthLimit: 200.0, Narrowband: 1000.0})
    assert stands == ([BandwidthLimit, Narrowband] if left < 100.0 else [])


@pytest.mark.parametrize(("left", "stands"), [(150.0, False), (50.0, True)])
def test_leak_is_kept_if_it_closed_most_of_the_gap_of_other_axes(left, stands):
    seen = {**QUIET, "other_axes": WhitenessDeparture(left, Location(source="ay"))}
    assert bool(list_kept((CrossAxis(source="gx", coefficient=0.01),), seen, {CrossAxis: 200.0})) == stands


@pytest.mark.parametrize(("left", "stands"), [(50.0, False), (15.0, True)])
def test_steps_are_kept_if_the_level_stays_constant_afterwards(left, stands):
    seen = {**QUIET, "level": WhitenessDeparture(left, Location(time=(100.0, 100.0)))}
    assert bool(list_kept((BiasStep(time=60.0, height=1.0),), seen, {BiasStep: 200.0})) == stands


@pytest.mark.parametrize(("left", "stands"), [(2500.0, False), (1500.0, True)])
def test_smooth_spectrum_is_kept_unless_the_variance_changes_far_more(left, stands):
    seen = {**QUIET, "variance": WhitenessDeparture(left, Location(time=(100.0, 200.0)))}
    found = (ExponentiallyCorrelated(sigma=1e-4, correlation_time=0.5), *make_lines(17.3))
    assert len(list_kept(found, seen, {ExponentiallyCorrelated: 20.0})) == 1 + stands
