"""Sentences about a fit and about events; and the bandwidth of sensors whose filter is known."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from drivers.sample import AXES, block
from monitor.estimate import findings
from monitor.estimate.analysis import analyze
from monitor.estimate.change import Change
from monitor.estimate.rest import Motion

RATE_HZ = 100.0


def analyzed(values):
    t_ns = np.arange(len(values)) * 10_000_000
    return analyze([block(t_ns, values)], RATE_HZ)


def white(n, seed=1):
    return 1e-3 * np.random.default_rng(seed).standard_normal((n, 6))


def test_the_sensor_s_own_bandwidth_is_told():
    found = analyzed(lfilter(*butter(2, 30.0, fs=RATE_HZ), white(400_000), axis=0))
    said = [note for note in found.notes if "the sensor's own bandwidth" in note]
    assert said
    assert "as of a low-pass of order 2 at " in said[0]


def test_a_line_is_told_with_the_averaging_times_that_it_spoils():
    values = white(400_000)
    values[:, 1] += 2e-3 * np.sin(2.0 * np.pi * 0.5 * np.arange(400_000) / RATE_HZ)
    found = analyzed(values)
    [note] = [one for one in found.notes if "departs" in one]
    times, where = re.findall(r"scatter (\S+) times wider\), most at τ = (\S+) s", note)[0]
    assert note.startswith("gy: ")
    assert float(times) == pytest.approx(found.fit.misfit[1] ** 0.5, rel=0.1)
    assert where == "0.64"  # a line's deviation peaks at 0.37 of its period, 2 s: sin⁴(πfτ)/(πfτ)²
    assert found.fit.misfit[0] == 1.0


def test_a_drift_in_a_short_record_is_k_or_r():
    values = white(30_000)
    values[:, 2] += 1e-4 * np.arange(30_000) / 30_000
    found = analyzed(values)
    assert found.fit.k_or_r.tolist() == [False, False, True, False, False, False]
    assert [one for one in found.notes if "K or R" in one] == [
        "gz: K or R: the record drifts by more than Q, N and B make, and is too short to tell a ramp from "
        "rate random walk"
    ]


def test_with_samples_missing_no_slope_tells_them_apart():
    rng = np.random.default_rng(4)
    values = white(100_000) + np.cumsum(3e-5 * rng.standard_normal((100_000, 6)), axis=0)
    values[500:4000] = np.nan
    found = analyzed(values)
    [note] = [one for one in found.notes if "K or R" in one]  # one for all axes that have it
    axes = ", ".join(np.array(AXES)[found.fit.k_or_r])
    assert "gx, gy" in axes
    assert note == f"{axes}: K or R: samples are missing, so that no slope tells a ramp from rate random walk"


def motion(since):
    return Motion("motion", since, since + 100, 0.5, "gx", 0.1, "moved for 0.5 s: gx up to 5.7 °/s")


def change(kind="noise_changed"):
    return Change(kind, 0, 100, 120, 8.04, {}, "gx noise changed")


def test_many_events_are_counted_rather_than_listed():
    notes = findings.of_motions([motion(100 * i) for i in range(14)], RATE_HZ, struck=True)
    assert notes[0] == "the sensor moved 14 times, 7 s in all: struck out"
    assert notes[1] == "at 0.0 s: moved for 0.5 s: gx up to 5.7 °/s"
    assert notes[-1] == "and 4 more motions"
    assert len(notes) == 1 + findings.MOST + 1
    notes = findings.of_changes([change()] * 11, RATE_HZ)
    assert notes[0] == "at 1.0 s: gx noise changed (8.0 σ)"
    assert notes[-2] == "and 1 more changes"


def test_outliers_alone_mix_no_before_and_after():
    assert findings.of_changes([change("outlier_burst")], RATE_HZ) == ["at 1.0 s: gx noise changed (8.0 σ)"]


def test_nothing_found_is_nothing_said():
    quiet = analyzed(white(30_000))
    assert quiet.notes == ()
    assert findings.of_motions([], RATE_HZ, struck=False) == findings.of_changes([], RATE_HZ) == []


def test_a_departure_ends_where_the_curve_comes_back():
    measured = np.array([1.1, 2.0, 3.0, 1.1, 6.0, 1.0])[:, None]
    curve = SimpleNamespace(avar=measured)
    fit = SimpleNamespace(fitted=np.ones((6, 1)), edf=np.array([9e4, 100.0, 100.0, 100.0, 1.0, 10.0])[:, None])
    assert findings._departure(curve, fit, 0) == (1, 2)  # the first is only many σ off, the fifth by chance
