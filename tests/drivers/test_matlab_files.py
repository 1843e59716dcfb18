"""MATLAB files, written by SciPy."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from drivers.data_types import AXES
from drivers.errors import ImuError
from drivers.recordings import Recording, load_samples, memory_check
from drivers.recordings.reading_options import create_reading_options
from drivers.units import DEGREE
from monitor.commands.analyze import analyze_recording
from tests.drivers.test_csv_tables import N, noise

T_S = np.arange(N) / 100.0


def read(path: Path, variables: dict[str, Any], compress: bool = True, **options: Any) -> Recording:
    savemat(path, variables, do_compression=compress)
    return load_samples(path, options=create_reading_options(options))


def refusal(path: Path, **options: Any) -> str:
    with pytest.raises(ImuError) as error:
        load_samples(path, options=create_reading_options(options))
    assert "\n" not in str(error.value)
    return str(error.value)


VARIABLES = [
    {"t": T_S, **dict(zip(AXES, noise().T, strict=True))},
    {"time": T_S[:, None], "gyro": noise()[:, :3], "acc": noise()[:, 3:].T, "fs": 100.0},
    {
        "imu": {"timestamp": T_S, "angular_velocity": noise()[:, :3], "linear_acceleration": noise()[:, 3:]},
        "note": "x",
        "empty": {},
        "cells": np.array(["a", 1.0], object),
        "complex": T_S * 1j,
        "flag": True,
    },
]


@pytest.mark.parametrize("compress", [True, False])
@pytest.mark.parametrize("variables", VARIABLES, ids=["vectors", "matrices", "structure"])
def test_the_recording_is_that_of_an_npz_file(tmp_path: Path, variables: dict[str, Any], compress: bool) -> None:
    found = read(tmp_path / "x.mat", variables, compress)
    np.savez(tmp_path / "same.npz", t=T_S, **dict(zip(AXES, noise().T, strict=True)))
    same = load_samples(tmp_path / "same.npz")
    assert found.t_s is not None
    assert found.t_s.tobytes() == T_S.tobytes()
    assert found.values.tobytes() == same.values.tobytes()
    assert found.rate_hz == variables.get("fs")
    first, second = (analyze_recording(one, "octave").analysis.estimate for one in (found, same))
    assert np.array_equal(first.coefficients.value, second.coefficients.value, equal_nan=True)


def test_columns_and_units_by_option(tmp_path: Path) -> None:
    table = np.array([[0, 1, 180, 0.5], [10, 2, 90, 0.5]] * 3)
    found = read(tmp_path / "x.mat", {"log": table}, columns={"t": 1, "gz": "log_3"}, gyro_unit="deg/s", time_unit="ms")
    assert found.values[:2, 2].tolist() == [180 * DEGREE, 90 * DEGREE]
    assert found.t_s is not None
    assert found.t_s[:2].tolist() == [0.0, 0.01]


def test_mistakes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "x.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512) + b"\x89HDF\r\n")
    assert refusal(path).endswith(
        "MATLAB file of version 7.3 (HDF5), which is not read; save it with save(FILE, …, '-v7')"
    )
    path.write_bytes(b"t,gx\n0,1\n" * 40)
    assert "is no MATLAB file of version 5 to 7" in refusal(path)
    savemat(path, {"name": "x"})
    assert "contains no vector and no matrix of numbers" in refusal(path)
    savemat(path, {"tt": T_S, "omga": T_S})
    assert "no axis among its columns (tt, omga)" in refusal(path)
    assert 'there is no column "omega"; did you mean "omga"?' in refusal(path, columns={"gx": "omega"})
    savemat(path, {"t": T_S, "gx": T_S[1:]})
    assert "gx has 3999 values but t has 4000" in refusal(path)
    savemat(path, VARIABLES[0], do_compression=True)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    found = load_samples(path)
    assert found.axes == ("gx", "gy")
    assert "The file is cut off; the variables after the cut are missing." in found.notes
    path.write_bytes(whole[:200])
    assert "contains no vector and no matrix of numbers (The file is cut off" in refusal(path)
    path.write_bytes(whole)
    monkeypatch.setattr(memory_check, "MIN_HELD_LIMIT_BYTES", 10_000)
    monkeypatch.setattr(memory_check, "MAX_HELD_RATIO", 1)
    assert refusal(path).startswith(f"{path}: unpacks to more than")


def test_flipped_bytes_never_end_in_a_traceback(tmp_path: Path) -> None:
    path = tmp_path / "x.mat"
    savemat(path, {"imu": {name: value[:50] for name, value in VARIABLES[0].items()}}, do_compression=False)
    whole = path.read_bytes()
    rng = np.random.default_rng(11)
    refused = 0
    for _ in range(200):
        damaged = bytearray(whole)
        for at in rng.integers(0, len(whole), 3):
            damaged[at] = int(rng.integers(256))
        path.write_bytes(damaged)
        try:
            load_samples(path, 100.0)
        except ImuError:
            refused += 1
    assert 0 < refused < 200
