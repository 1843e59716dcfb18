import numpy as np
import pytest
from scipy import signal

from monitor.noise.effects import Narrowband, WanderingLine
from monitor.noise.model import NoiseModel
from monitor.reconcile.recording_checks.checks import check_recording
from monitor.reconcile.recording_checks.recording_under_test import RecordingUnderTest
from monitor.reconcile.recording_checks.temporary_vibration import check_temporary_vibration
from tests.monitor.reconcile.recording_checks.recordings import RATE_HZ, SAMPLES, draw, make_model

MODEL = make_model()
TIME_S = np.arange(SAMPLES) / RATE_HZ
FREQUENCY_HZ = 31.7


def noise_levels(values):
    return {axis: float(np.std(np.diff(y))) for axis, y in values.items()}


def with_vibration(start_s, end_s, gains, frequency_hz=FREQUENCY_HZ, seed=4):
    recorded = dict(draw(MODEL, seed).values)
    levels = noise_levels(recorded)
    during = (start_s <= TIME_S) & (end_s > TIME_S)
    for axis, gain in gains.items():
        recorded[axis] = recorded[axis] + gain * levels[axis] * during * np.sin(2.0 * np.pi * frequency_hz * TIME_S)
    return recorded


def check(recorded):
    return check_temporary_vibration(RecordingUnderTest(recorded, RATE_HZ, simulated=draw(MODEL, 99).values, seed=1))


def test_vibration_is_found_on_all_its_axes_and_removed():
    recorded = with_vibration(40.0, 80.0, {"gx": 1.0, "gz": 0.5, "ay": 0.25})
    corrected, (finding,) = check(recorded)
    assert (finding.kind, finding.axes, finding.corrected) == ("temporary_vibration", ("gx", "gz", "ay"), True)
    assert finding.parameters["frequency"].value == pytest.approx(FREQUENCY_HZ, abs=0.5)
    assert finding.parameters["time"].value == pytest.approx(40.0, abs=2.6)
    assert finding.evidence["end_s"] == pytest.approx(80.0, abs=2.6)
    assert finding.evidence["amplitude"] == pytest.approx(noise_levels(draw(MODEL, 4).values)["gx"], rel=0.15)
    during = slice(4200, 7800)
    phasor = np.exp(2j * np.pi * FREQUENCY_HZ * TIME_S[during])
    for axis in finding.axes:
        before, after = (abs(np.mean(values[axis][during] * phasor)) for values in (recorded, corrected))
        assert after < 0.1 * before
    assert not check(corrected)[1]


def test_noise_that_replaces_the_vibration_is_independent_on_each_axis():
    recorded = with_vibration(40.0, 80.0, {"gx": 1.0, "gz": 0.5})
    corrected, _ = check(recorded)
    during = slice(4200, 7800)
    f_hz, coherence = signal.coherence(corrected["gx"][during], corrected["gz"][during], RATE_HZ, nperseg=256)
    assert coherence[np.abs(f_hz - FREQUENCY_HZ) < 1.0].max() < 0.5


def test_samples_outside_the_vibration_are_not_changed():
    recorded = with_vibration(40.0, 80.0, {"gx": 1.0})
    corrected, _ = check(recorded)
    apart = (TIME_S < 30.0) | (TIME_S > 90.0)
    change = np.abs(corrected["gx"] - recorded["gx"])
    assert change[apart].max() < 0.05 * np.std(recorded["gx"])
    assert np.array_equal(corrected["gy"], recorded["gy"])


def test_missing_samples_stay_missing():
    recorded = with_vibration(40.0, 80.0, {"gx": 1.0})
    recorded["gx"][5000:5100] = np.nan
    corrected, findings = check(recorded)
    assert len(findings) == 1
    assert np.array_equal(np.isnan(corrected["gx"]), np.isnan(recorded["gx"]))


@pytest.mark.parametrize(
    "change",
    [
        lambda y, level: y + level * np.sin(2.0 * np.pi * FREQUENCY_HZ * TIME_S),
        lambda y, level: y + level * np.sin(2.0 * np.pi * TIME_S * (20.0 + 0.1 * TIME_S)),
        lambda y, level: y * np.where((TIME_S > 40.0) & (TIME_S < 80.0), 3.0, 1.0),
        lambda y, level: y + level * (1.0 + np.sin(TIME_S)) * np.sin(2.0 * np.pi * FREQUENCY_HZ * TIME_S),
        lambda y, level: y + 20.0 * level * (np.arange(SAMPLES) == 7000),
        lambda y, level: y + 30.0 * level * (TIME_S > 80.0),
    ],
    ids=["constant line", "sweep", "louder noise", "modulated line", "spike", "step"],
)
def test_other_changes_are_no_temporary_vibration(change):
    recorded = dict(draw(MODEL, 4).values)
    recorded["gx"] = change(recorded["gx"], noise_levels(recorded)["gx"])
    assert check(recorded)[1] == []


@pytest.mark.parametrize(
    "effect",
    [
        WanderingLine(amplitude=5e-4, frequency=31.0, frequency_deviation=1.0, correlation_time=60.0),
        WanderingLine(amplitude=5e-4, frequency=31.0, frequency_deviation=0.2, correlation_time=5.0),
        Narrowband(sigma=1e-3, frequency=31.0, bandwidth=0.005),
    ],
    ids=["slowly wandering line", "wandering line", "narrow resonance"],
)
def test_oscillation_of_varying_frequency_or_strength_is_rarely_temporary(effect):
    model = NoiseModel({**MODEL.effects, "gx": (*MODEL.effects["gx"], effect)}, RATE_HZ)
    found = sum(
        bool(check_temporary_vibration(RecordingUnderTest(draw(model, seed).values, RATE_HZ, seed=1))[1])
        for seed in range(10)
    )
    assert found <= 1


def test_true_model_has_no_temporary_vibration():
    assert all(check(draw(MODEL, seed).values)[1] == [] for seed in range(20))


def test_check_of_a_recording_includes_temporary_vibration():
    recording = draw(MODEL, 4)
    recording = type(recording)(with_vibration(40.0, 80.0, {"gx": 1.0}), RATE_HZ)
    assert [one.kind for one in check_recording(recording, MODEL, 1).findings] == ["temporary_vibration"]
