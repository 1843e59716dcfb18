"""A recording through all that ``analyze`` can make of it, and what is made only on demand."""

import json
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import ConfigError, RecordingError
from drivers.recording import save_samples
from monitor import offline
from monitor.offline import Request, TooShort, make
from monitor.publish import message

RATE_HZ = 100.0


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Two minutes of white noise; gx becomes noisier in the middle."""
    path = tmp_path / "x.npz"
    values = 1e-3 * np.random.default_rng(2).standard_normal((24_000, 6))
    values[15_000:, 0] *= 2.0
    save_samples(path, np.arange(len(values)) / RATE_HZ, values)
    return path


def test_only_what_is_wanted_is_made(recording: Path) -> None:
    results = make(Request(recording))
    assert results.total is results.hadamard is results.dynamic is results.warmth is None
    assert results.lacking == ""
    [change] = results.analysis.changes  # told in the notes, so always looked for
    assert (change.axis, change.since) == (0, pytest.approx(15_000, abs=50))


def test_all_of_it(recording: Path) -> None:
    told: list[tuple[str, float | None]] = []
    results = make(Request(recording, window_s=30.0, others=True), lambda what, share: told.append((what, share)))
    assert results.total is not None
    assert results.hadamard is not None
    assert results.dynamic is not None
    assert results.total.tau_s[-1] == 163.84
    assert results.hadamard.tau_s[-1] == 40.96
    n = results.dynamic.value[:, 1, 0]
    assert n[-1] / n[0] == pytest.approx(2.0, rel=0.05)
    assert [what for what, share in told if share is None] == [
        "reading", "curve and fit", "motion and changes, total and Hadamard deviations"
    ]  # fmt: skip
    shares = [share for what, share in told if what == "dynamic curves"]
    assert shares == sorted(shares)  # type: ignore[type-var]
    assert shares[-1] == 1.0


def test_drift_that_was_temperature_is_told(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    t = np.arange(43_200) / 2.0
    warmth = 25.0 + 2.0 * np.sin(2.0 * np.pi * t / 7200.0) + 1.5 * np.sin(2.0 * np.pi * t / 3100.0)
    values = 1e-4 * rng.standard_normal((t.size, 6))
    values[:, 2] += 3e-5 * (warmth - 25.0)
    save_samples(tmp_path / "warm.npz", t, values, warmth)
    results = make(Request(tmp_path / "warm.npz"))
    (note,) = (one for one in results.analysis.notes if "follows its temperature" in one)
    assert note.startswith("gz follows its temperature")
    written = json.loads(message.analysis(results.analysis, warmth=results.warmth))
    gz = written["axes"]["gz"]["without_temperature"]
    assert set(gz) == {"model", "coefficients", "share"}
    assert gz["share"]["K"] > 0.9
    assert gz["coefficients"]["K"]["hi"] < written["axes"]["gz"]["coefficients"]["K"]["lo"]
    assert "without_temperature" not in written["axes"]["gx"]


def test_listed_tau_are_those_of_every_curve_as_far_as_they_are_possible(recording: Path) -> None:
    listed = (0.1, 0.2, 0.5, 1.0, 2.0, 100.0)
    results = make(Request(recording, tau=listed, others=True))
    assert results.total is not None
    assert results.hadamard is not None
    assert results.total.tau_s.tolist() == list(listed)
    assert results.hadamard.tau_s.tolist() == list(listed[:-1])
    assert make(Request(recording, tau=(100.0,), others=True)).hadamard is None


def test_a_window_longer_than_the_recording_leaves_the_rest(recording: Path) -> None:
    results = make(Request(recording, window_s=1000.0))
    assert results.dynamic is None
    assert results.lacking == "no dynamic curves: 240 s are recorded, less than the window of 1000 s"
    assert results.analysis.notes[-1] == results.lacking


def test_too_short_says_how_short(tmp_path: Path) -> None:
    save_samples(tmp_path / "x.npz", np.arange(20) / RATE_HZ, np.zeros((20, 6)))
    with pytest.raises(TooShort, match="20 samples; at least 50") as raised:
        make(Request(tmp_path / "x.npz"))
    assert raised.value.samples == 20


def test_what_is_wrong_is_said(tmp_path: Path, recording: Path) -> None:
    with pytest.raises(RecordingError):
        make(Request(tmp_path / "nowhere.csv"))
    with pytest.raises(ConfigError, match="window of 0"):
        make(Request(recording, window_s=0.1))


@pytest.mark.parametrize(("name", "start"), [("x.png", b"\x89PNG"), ("x.html", b"<!DOCTYPE html>")])
def test_a_drawing_has_the_changes_marked(recording: Path, name: str, start: bytes) -> None:
    pytest.importorskip("matplotlib")
    pytest.importorskip("jinja2")
    results = make(Request(recording, window_s=30.0, others=True))
    path = recording.with_name(name)
    offline.draw(results, path, "bench")
    assert path.read_bytes().startswith(start)
    if name == "x.html":
        page = path.read_text("utf-8")
        assert "gx angle random walk rose by" in page
        assert "<!-- change -->" in page  # the mark in the drawing


def test_an_analysis_beyond_the_memory_is_one_line(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_args: object) -> None:
        raise MemoryError

    monkeypatch.setattr(offline, "analyze", fail)
    with pytest.raises(ConfigError, match=r"x\.npz: the analysis needs more memory than is free; take the end alone"):
        make(Request(recording))
