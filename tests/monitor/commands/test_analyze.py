"""Tests of the analysis behind ``analyze``: which results are computed by default and which on request."""

import json
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import ConfigError, RecordingError
from drivers.recordings import save_samples
from monitor.commands import analyze, thermal
from monitor.commands.analyze import TooFewSamples, analyze_recording
from monitor.commands.recording_loading import load_recording
from monitor.common.unit_formatting import MILLI_G
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Status
from monitor.publishing import exporters
from monitor.publishing.messages.analysis_json import AnalysisMessage
from monitor.publishing.terminal.thermal_output import notes_on_lags_and_hysteresis
from tests.monitor.drift.temperature_cycles import (
    compute_hysteresis_bias,
    compute_hysteresis_width,
    make_temperature_cycle,
)

RATE_HZ = 100.0


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Write two minutes of white noise in which gx becomes noisier in the middle."""
    path = tmp_path / "x.npz"
    values = 1e-3 * np.random.default_rng(2).standard_normal((24_000, 6))
    values[15_000:, 0] *= 2.0
    save_samples(path, np.arange(len(values)) / RATE_HZ, values)
    return path


def test_optional_results_are_computed_only_on_request(recording: Path) -> None:
    results = analyze_recording(load_recording(recording))
    assert results.total is results.hadamard is results.dynamic is results.without_temperature is None
    assert results.lacking == ""
    [change] = results.analysis.changes  # always detected because the notes mention it
    assert (change.axis, change.since) == (0, pytest.approx(15_000, abs=50))


@pytest.mark.long
def test_requested_results_are_all_computed(recording: Path) -> None:
    progress: list[tuple[str, float | None]] = []

    def report_progress(what: str, share: float | None) -> None:
        progress.append((what, share))

    results = analyze_recording(
        load_recording(recording, report_progress=report_progress),
        window_s=30.0,
        total_and_hadamard=True,
        report_progress=report_progress,
    )
    assert results.total is not None
    assert results.hadamard is not None
    assert results.dynamic is not None
    assert results.total.tau_s[-1] == 163.84
    assert results.hadamard.tau_s[-1] == 40.96
    n = results.dynamic.value[:, 1, 0]
    assert n[-1] / n[0] == pytest.approx(2.0, rel=0.05)
    assert [what for what, share in progress if share is None] == [
        "reading", "curve and fit", "motion and changes, total and Hadamard deviations"
    ]  # fmt: skip
    shares = [share for what, share in progress if what == "dynamic curves"]
    assert shares == sorted(shares)  # type: ignore[type-var]
    assert shares[-1] == 1.0


@pytest.mark.long
def test_temperature_dependent_drift_is_reported(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    t = np.arange(43_200) / 2.0
    temperature_c = 25.0 + 2.0 * np.sin(2.0 * np.pi * t / 7200.0) + 1.5 * np.sin(2.0 * np.pi * t / 3100.0)
    values = 1e-4 * rng.standard_normal((t.size, 6))
    values[:, 2] += 3e-5 * (temperature_c - 25.0)
    save_samples(tmp_path / "warm.npz", t, values, temperature_c)
    results = analyze_recording(load_recording(tmp_path / "warm.npz"))
    (note,) = (note for note in results.analysis.notes if "follows its temperature" in note)
    assert note.startswith("gz follows its temperature")
    written = json.loads(
        AnalysisMessage.from_analysis(results.analysis, temperature=results.without_temperature).encode()
    )
    gz = written["axes"]["gz"]["without_temperature"]
    assert set(gz) == {"model", "coefficients", "share"}
    assert written["axes"]["gz"]["temperature"]["share"] > 0.9
    assert "temperature" not in written["axes"]["gx"]
    assert gz["share"]["K"] > 0.9
    assert gz["coefficients"]["K"]["hi"] < written["axes"]["gz"]["coefficients"]["K"]["lo"]
    assert "without_temperature" not in written["axes"]["gx"]


@pytest.mark.parametrize("shape", ["ramp", "sine", "steps", "heating"])
def test_temperature_dependent_axes_are_named_whatever_the_status_of_k(tmp_path: Path, shape: str) -> None:
    """gy is cubic and gz linear in temperature, gx and ax have a random walk, and az has hysteresis."""
    rate_hz, seconds = 5.0, 9000.0
    n = round(rate_hz * seconds)
    rng = np.random.default_rng(6)
    temperature_c = make_temperature_cycle(shape, n)
    x = (temperature_c + 18.0) / 92.0
    values = np.array([2e-4, 2e-4, 2e-4, 2e-3, 2e-3, 2e-3]) * rng.standard_normal((n, 6))
    values[:, 0] += 3e-6 / rate_hz**0.5 * rng.standard_normal(n).cumsum()
    values[:, 3] += 3e-5 / rate_hz**0.5 * rng.standard_normal(n).cumsum()
    cubic = 4.0 * (x - 0.5) ** 3 + 0.5 * x + 0.4 * (x - 0.5) ** 2
    values[:, 1] += np.radians(3.0) * cubic / np.ptp(cubic)
    values[:, 2] += np.radians(0.5) * x
    values[:, 5] += 9.8 + 0.05 * x
    if shape != "heating":
        values[:, 5] += (
            12.0
            * MILLI_G
            * compute_hysteresis_bias("loop", x)
            / compute_hysteresis_width(compute_hysteresis_bias("loop", x), x)
        )
    path = tmp_path / "chamber.npz"
    save_samples(path, np.arange(n) / rate_hz, values, temperature_c)
    results = analyze_recording(load_recording(path))
    assert results.analysis.axes_of_temperature == ("gy", "gz", "az")
    named = [note.split()[0] for note in results.analysis.notes if "follows its temperature" in note]
    assert named == ["gy", "gz", "az"]
    if shape == "ramp":  # K of gy is not estimated, but the note is still needed
        assert results.analysis.estimate.coefficients.status[SYMBOLS.index("K"), 1] != Status.ESTIMATED
    written = AnalysisMessage.from_analysis(results.analysis, temperature=results.without_temperature).encode()
    marks = {axis: entry.get("temperature") for axis, entry in json.loads(written)["axes"].items()}
    assert [axis for axis, entry in marks.items() if entry] == ["gy", "gz", "az"]
    assert set(marks["gy"]) == {"share", "p_value", "form", "one_way", "interval"}
    assert marks["gy"]["share"] > 0.95
    assert marks["gy"]["one_way"] == (shape == "heating")
    remarks = exporters.from_analysis_json(written).remarks
    assert {remark.removeprefix("WARNING: ").split()[0] for remark in remarks} == {"gy", "gz", "az"}
    study = thermal.fit_thermal_models(path)
    if shape != "heating":
        assert study.fits["az"].hysteresis.size == pytest.approx(12.0 * MILLI_G, rel=0.15)
        assert not any(study.fits[axis].hysteresis.is_significant for axis in ("gx", "gy", "gz", "ax", "ay"))
        (note,) = [one for one in notes_on_lags_and_hysteresis(study) if "lag of" not in one]
        assert note.startswith("az: at one temperature the bias differs between heating and cooling by up to 1")
        assert " mg (hysteresis or a lag, p = " in note
    else:
        assert notes_on_lags_and_hysteresis(study) == []
    if shape == "ramp":
        pytest.importorskip("matplotlib")
        pytest.importorskip("jinja2")
        analyze.save_plot_or_report(results, tmp_path / "x.html", "chamber")
        page = (tmp_path / "x.html").read_text("utf-8")
        assert "gy †" in page
        assert "gx †" not in page
        assert "† slow variance due to temperature" in page


@pytest.mark.long
def test_listed_tau_are_used_for_every_curve_that_supports_them(recording: Path) -> None:
    listed = (0.1, 0.2, 0.5, 1.0, 2.0, 100.0)
    results = analyze_recording(load_recording(recording), tau=listed, total_and_hadamard=True)
    assert results.total is not None
    assert results.hadamard is not None
    assert results.total.tau_s.tolist() == list(listed)
    assert results.hadamard.tau_s.tolist() == list(listed[:-1])
    assert analyze_recording(load_recording(recording), tau=(100.0,), total_and_hadamard=True).hadamard is None


def test_window_longer_than_the_recording_omits_only_dynamic_curves(recording: Path) -> None:
    results = analyze_recording(load_recording(recording), window_s=1000.0)
    assert results.dynamic is None
    assert results.lacking == "no dynamic curves: 240 s are recorded, less than the window of 1000 s"
    assert results.analysis.notes[-1] == results.lacking


def test_too_short_recording_reports_its_number_of_samples(tmp_path: Path) -> None:
    save_samples(tmp_path / "x.npz", np.arange(20) / RATE_HZ, np.zeros((20, 6)))
    with pytest.raises(TooFewSamples, match="20 samples; at least 50") as raised:
        analyze_recording(load_recording(tmp_path / "x.npz"))
    assert raised.value.samples == 20


def test_invalid_requests_raise_an_error(tmp_path: Path, recording: Path) -> None:
    with pytest.raises(RecordingError):
        analyze_recording(load_recording(tmp_path / "nowhere.csv"))
    with pytest.raises(ConfigError, match="window of 0"):
        analyze_recording(load_recording(recording), window_s=0.1)


@pytest.mark.long
@pytest.mark.parametrize(("name", "start"), [("x.png", b"\x89PNG"), ("x.html", b"<!DOCTYPE html>")])
def test_plot_marks_the_changes(recording: Path, name: str, start: bytes) -> None:
    pytest.importorskip("matplotlib")
    pytest.importorskip("jinja2")
    results = analyze_recording(load_recording(recording), window_s=30.0, total_and_hadamard=True)
    path = recording.with_name(name)
    analyze.save_plot_or_report(results, path, "bench")
    assert path.read_bytes().startswith(start)
    if name == "x.html":
        page = path.read_text("utf-8")
        assert "gx angle random walk rose by" in page
        assert ">change</text>" in page  # the mark in the drawing
