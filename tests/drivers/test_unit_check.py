"""Notes about obvious errors in the units: a note for each wrong unit, and none for the real recordings."""

from pathlib import Path

import numpy as np
import pytest

from drivers.data_types import AXES, Floats
from drivers.recordings import create_recording, load_samples
from drivers.recordings.reading_options import create_reading_options
from drivers.units import DEGREE, G0
from tests.support.recordings import recordings

STATIC = ("adis16405/run1", "mpu6050-arduino/static-7min", "vn100-serial/static-12min", "mpu9150-rotations/unit2")


def unit_notes(values: Floats, rate_hz: float = 100.0) -> list[str]:
    measured = ~np.isnan(values).all(axis=0)
    columns = {axis: values[:, i] for i, axis in enumerate(AXES) if measured[i]}
    return [note for note in create_recording(columns, rate_hz).notes if "unit" in note or "noise" in note]


def at_rest(n: int = 2000) -> Floats:
    values = np.random.default_rng(1).normal(size=(n, 6)) * np.repeat([0.1 * DEGREE, 0.02], 3)
    return values + np.array([0, 0, 0, 0.6 * G0, 0, 0.8 * G0])


def test_right_units_have_no_note() -> None:
    assert unit_notes(at_rest()) == []


@pytest.mark.parametrize(("unit", "factor"), [("g", 1 / G0), ("mg", 1e3 / G0), ("mm/s²", 1e3)])
def test_gravity_names_the_unit(unit: str, factor: float) -> None:
    notes = unit_notes(at_rest() * np.repeat([1.0, factor], 3))
    assert len(notes) == 1
    assert notes[0].endswith(f"would fit the unit {unit} (--accel-unit {unit}).")


def test_noise_names_the_unit_of_the_gyroscopes() -> None:
    notes = unit_notes(at_rest() * np.repeat([1 / DEGREE, 1.0], 3))
    assert len(notes) == 1
    assert notes[0].endswith("would fit the unit deg/s (--gyro-unit deg/s).")
    alone = at_rest() * 10.0 / DEGREE
    alone[:, 3:] = np.nan
    assert len(unit_notes(alone)) == 1


def test_raw_counts() -> None:
    counts = np.rint(at_rest() * np.repeat([131 / DEGREE, 16384 / G0], 3))
    accelerometers, gyroscopes = unit_notes(counts)
    assert "would fit the unit g/16384 (--accel-unit g/16384)" in accelerometers
    assert "are integers and may be raw counts (such as --gyro-unit deg/s/131" in gyroscopes


def test_a_wrong_option_is_noticed(tmp_path: Path) -> None:
    values = at_rest()
    np.savez(tmp_path / "x.npz", fs=100.0, **dict(zip(AXES, values.T, strict=True)))
    found = load_samples(tmp_path / "x.npz", options=create_reading_options({"accel_unit": "g"}))
    assert "Their numbers, read in g, would fit the unit m/s² (--accel-unit m/s²)." in found.notes[-1]


def test_motion_and_other_sensors_have_no_note() -> None:
    rng = np.random.default_rng(2)
    moving = at_rest() + rng.normal(size=(2000, 6)) * np.repeat([2.0, 3.0], 3)
    assert unit_notes(moving) == []
    without_gravity = at_rest() - np.array([0, 0, 0, 0.6 * G0, 0, 0.8 * G0])
    assert unit_notes(without_gravity) == []
    assert unit_notes(at_rest()[:50] / G0) == []  # too few samples


@pytest.mark.data
def test_real_recordings_have_no_note() -> None:
    paths = [path for path in sorted(recordings().glob("*/*.npz")) if path.parent.name != "xsens-multiposition"]
    for path in paths:
        assert not [note for note in load_samples(path).notes if "unit" in note], path
    assert len(paths) >= 20


@pytest.mark.data
@pytest.mark.parametrize("name", STATIC)
def test_real_recordings_in_other_units(name: str) -> None:
    found = load_samples(recordings() / f"{name}.npz")
    notes = unit_notes(found.values * np.repeat([1 / DEGREE, 1 / G0], 3), found.rate_hz or 100.0)
    assert [note.rpartition("--")[2] for note in notes] == ["accel-unit g).", "gyro-unit deg/s)."]
