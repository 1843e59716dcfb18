"""Tests of the notes about a fit, its likely disturbances, motion and changes."""

import re
from types import SimpleNamespace

import numpy as np
import pytest

from drivers.data_types import AXES, make_block
from monitor.estimation import analysis_notes
from monitor.estimation.analysis import analyze
from monitor.estimation.detection.change_detection import Change
from monitor.estimation.detection.line_and_outlier_detection import SpectralLine, detect_spectral_lines_per_axis
from monitor.estimation.detection.motion_detection import MotionEpisode
from monitor.estimation.fit.coefficients_with_intervals import Status
from monitor.estimation.fit.low_pass_search import LowPass

RATE_HZ = 100.0


def analyze_values(values):
    t_ns = np.arange(len(values)) * 10_000_000
    return analyze([make_block(t_ns, values)], RATE_HZ)


def simulate_white_noise(n, seed=1):
    return 1e-3 * np.random.default_rng(seed).standard_normal((n, 6))


def test_equal_bandwidths_share_one_note():
    axes = [None if i == 2 else LowPass("digital", 1, 0.249 + 0.001 * i) for i in range(6)]
    curve, fit = make_curve_and_fit()
    [note] = analysis_notes.describe_unexplained_curve(curve, fit, axes, RATE_HZ)
    assert note == (
        "gx, gy, ax, ay, az: white noise ends below half the sample rate, as after a first-order low-pass at about "
        "25 Hz; N is the level below this frequency"
    )


@pytest.mark.long
def test_line_is_named_with_the_tau_it_affects():
    values = simulate_white_noise(400_000)
    values[:, 1] += 2e-3 * np.sin(2.0 * np.pi * 0.5 * np.arange(400_000) / RATE_HZ)
    found = analyze_values(values)
    [note] = [note for note in found.notes if "do not explain the curve" in note]
    times, where = re.findall(r"scatter (\S+) times wider\), most at τ = (\S+) s", note)[0]
    assert note.startswith("gy: ")
    assert float(times) == pytest.approx(found.fit.misfit[1] ** 0.5, rel=0.1)
    assert where == "0.64"  # sin⁴(πfτ)/(πfτ)² of a line has its maximum at 0.37 of the period of 2 s
    assert found.fit.misfit[0] == 1.0
    curve = found.estimate.curve
    lines = detect_spectral_lines_per_axis(values, np.zeros(len(values), bool), RATE_HZ, curve)
    notes = analysis_notes.replace_guessed_causes(["first", *found.notes], curve, found.fit, lines)
    assert notes[0] == "first"
    [note_with_cause] = [note for note in notes if "do not explain the curve" in note]
    assert note_with_cause == note.replace(
        "vibration, motion or temperature may be the cause", "the likely cause is the line at 0.4999 Hz"
    )
    assert analysis_notes.describe_lines_and_outliers(lines, np.zeros(6)) == ["a line at 0.4999 Hz: gy 0.11 °/s"]


def make_curve_and_fit(misfit=(1.0,) * 6, at=(2,) * 6, left_out=(0,) * 6, q=()):
    """Return a white curve of eight τ; axes with a misfit deviate at one τ, and axes in ``q`` have a Q."""
    factors = 2 ** np.arange(8)
    fitted = np.repeat(1.0 / factors[:, None], 6, axis=1)
    avar = fitted.copy()
    for axis in range(6):
        avar[at[axis], axis] *= 4.0 if misfit[axis] > 1.0 else 1.0
    status = np.full((5, 6), Status.UPPER_BOUND)
    status[0, list(q)] = Status.ESTIMATED
    curve = SimpleNamespace(factors=factors, tau_s=factors / RATE_HZ, avar=avar, excess=0.0)
    fit = SimpleNamespace(
        fitted=fitted, edf=np.full((8, 6), 1e3), misfit=np.array(misfit), left_out=np.array(left_out),
        theta=np.ones((5, 6)), k_or_r=np.zeros(6, bool), coefficients=SimpleNamespace(status=status),
    )  # fmt: skip
    return curve, fit


def make_line(axis, hz, amplitude=1.0, wide=False):
    return SpectralLine(axis, hz, amplitude, 0.5, wide)


def test_axes_with_equal_misfit_share_a_note():
    curve, fit = make_curve_and_fit((9.0, 36.0, 1.0, 16.0, 4.0, 1.0), at=(2, 2, 2, 2, 6, 2))
    text = "vibration, motion or temperature may be the cause; intervals are widened accordingly"
    assert analysis_notes.describe_misfit(curve, fit) == [
        f"gx, gy, ax: the five terms do not explain the curve (scatter 3 to 6 times wider), most at τ = 0.04 s: {text}",
        f"ay: the five terms do not explain the curve (scatter 2 times wider), most at τ = 0.64 s: {text}",
    ]


def test_motion_in_the_samples_gives_one_note():
    curve, fit = make_curve_and_fit((4.0, 4.0, 4.0, 9.0, 9.0, 9.0), at=(0, 1, 3, 5, 6, 7))
    notes = analysis_notes.replace_guessed_causes(
        analysis_notes.describe_misfit(curve, fit), curve, fit, [make_line(0, 9.0)], includes_motion=True
    )
    assert notes == [
        "gx, gy, gz, ax, ay, az: the five terms do not explain the curve (scatter 2 to 3 times wider): "
        "motion of the sensor may be the cause; --rest removes the samples in motion; intervals are widened accordingly"
    ]
    assert analysis_notes.replace_guessed_causes(["other"], *make_curve_and_fit(), [], includes_motion=True) == [
        "other"
    ]


def test_line_is_named_as_cause_only_where_it_has_an_effect():
    """At τ = 0.04 s a line of 9 Hz is strongest; a line of 0.05 Hz or of another axis has no effect there."""
    curve, fit = make_curve_and_fit((4.0,) * 3 + (1.0,) * 3)
    found = [make_line(0, 9.0), make_line(1, 9.03), make_line(2, 0.05, 0.1), make_line(3, 9.0)]
    notes = analysis_notes.describe_misfit(curve, fit, found)
    assert [note.split(":")[0] for note in notes] == ["gx, gy", "gz"]
    assert "the likely cause is the line at 9 Hz" in notes[0]
    assert "may be the cause" in notes[1]


def test_omitted_tau_are_noted_with_the_line_as_cause():
    curve, fit = make_curve_and_fit(left_out=(4, 3, 0, 0, 0, 1))
    assert analysis_notes.describe_misfit(curve, fit, [make_line(0, 9.0, wide=True), make_line(1, 9.0)]) == [
        "gx, gy: the fit leaves out τ up to 0.08, 0.04 s, which the five terms do not explain: the likely cause is "
        "the resonance about 9 Hz",
        "az: the fit leaves out τ up to 0.01 s, which the five terms do not explain: the likely cause is the "
        "bandwidth of the sensor or a vibration",
    ]


@pytest.mark.parametrize(("amplitude", "hz", "is_noted"), [(1.0, 30.0, True), (0.2, 30.0, False), (1.0, 0.5, False)])
def test_quantization_noise_is_noted_if_it_may_be_a_line(amplitude, hz, is_noted):
    curve, fit = make_curve_and_fit(q=(0, 2, 4))
    found = [make_line(axis, hz, amplitude) for axis in (0, 1, 2)]
    expected = [f"gx, gz: quantization noise may be the line at {hz:g} Hz"] if is_noted else []
    assert analysis_notes.replace_guessed_causes([], curve, fit, found) == expected


def test_drift_in_a_short_recording_is_noted_as_k_or_r():
    values = simulate_white_noise(30_000)
    values[:, 2] += 1e-4 * np.arange(30_000) / 30_000
    found = analyze_values(values)
    assert found.fit.k_or_r.tolist() == [False, False, True, False, False, False]
    assert [note for note in found.notes if "K or R" in note] == [
        "gz: K or R: the recording drifts by more than Q, N and B explain, and is too short to distinguish a ramp from "
        "rate random walk"
    ]


def test_missing_samples_prevent_separating_k_and_r():
    rng = np.random.default_rng(4)
    values = simulate_white_noise(100_000) + np.cumsum(3e-5 * rng.standard_normal((100_000, 6)), axis=0)
    values[500:15_000] = np.nan
    found = analyze_values(values)
    [note] = [note for note in found.notes if "K or R" in note]  # one note for all affected axes
    axes = ", ".join(np.array(AXES)[found.fit.k_or_r])
    assert "gx, gy" in axes
    assert note == f"{axes}: K or R: too many samples are missing to distinguish a ramp from rate random walk"


def make_motion(since):
    return MotionEpisode("motion", since, since + 100, 0.5, "gx", 0.1, "moved for 0.5 s: gx up to 5.7 °/s")


def make_change(kind="noise_changed"):
    return Change(kind, 0, 100, 120, 8.04, {}, "gx noise changed")


def test_many_events_are_counted_instead_of_listed():
    notes = analysis_notes.describe_motions([make_motion(100 * i) for i in range(14)], RATE_HZ, removed=True)
    assert notes[0] == "the sensor moved 14 times, 7 s in all: removed"
    assert notes[1] == "at 0.0 s: moved for 0.5 s: gx up to 5.7 °/s"
    assert notes[-1] == "and 4 more motions"
    assert len(notes) == 1 + analysis_notes.MAX_NOTES + 1
    notes = analysis_notes.describe_changes([make_change()] * 11, RATE_HZ)
    assert notes[0] == "at 1.0 s: gx noise changed (8.0 σ)"
    assert notes[-2] == "and 1 more changes"


def test_outliers_give_no_note_on_mixed_noise():
    assert analysis_notes.describe_changes([make_change("outlier_burst")], RATE_HZ) == [
        "at 1.0 s: gx noise changed (8.0 σ)"
    ]


def test_undisturbed_noise_gives_no_notes():
    analysis = analyze_values(simulate_white_noise(30_000))
    assert analysis.notes == ()
    assert (
        analysis_notes.describe_motions([], RATE_HZ, removed=False)
        == analysis_notes.describe_changes([], RATE_HZ)
        == []
    )


def test_misfit_range_ends_where_the_curve_agrees_again():
    measured = np.array([1.1, 2.0, 3.0, 1.1, 6.0, 1.0])[:, None]
    curve = SimpleNamespace(avar=measured, excess=0.0)
    fit = SimpleNamespace(fitted=np.ones((6, 1)), edf=np.array([9e4, 100.0, 100.0, 100.0, 1.0, 10.0])[:, None])
    assert analysis_notes._departure(curve, fit, 0) == (1, 2)  # the first deviates by little, the fifth by chance


@pytest.mark.long
def test_unknown_filter_gives_a_note():
    # A moving average over two samples is no Butterworth filter.
    white = 1e-3 * np.random.default_rng(8).standard_normal((200_001, 6))
    values = 0.85 * white[1:] + 0.15 * white[:-1]
    found = analyze([make_block(np.arange(len(values)) * 10_000_000, values)], RATE_HZ)
    assert (found.fit.theta[0] < 0.0).any()
    assert np.isnan(found.bandwidth_hz[found.fit.theta[0] < 0.0]).all()
    assert any("is below white noise" in note for note in found.notes)
