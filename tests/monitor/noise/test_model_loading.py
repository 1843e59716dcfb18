"""Tests of the shipped sensor models: values agree with the data sheets, and each model can be simulated."""

import re
from pathlib import Path

import numpy as np
import pytest

import config
from drivers.data_types import AXES
from monitor.noise.effects import EFFECTS
from monitor.noise.model import NoiseModel

SENSORS = sorted(
    {  # a namespace package may contain one folder several times
        path.resolve()
        for root in config.__path__
        for path in Path(root).glob("models/*.toml")
        if path.stem != "consumer-mems"  # this model describes a class of sensors
    }
)
DEGREE, HOUR_S, G = np.pi / 180.0, 3600.0, 9.80665
ONE_SIDED = 1.0 / np.sqrt(2.0)  # converts the root of a one-sided density to two-sided
FLOOR = 1.0 / np.sqrt(2.0 * np.log(2.0) / np.pi)  # converts the minimum of the Allan deviation to B
SHEET_UNITS = {
    "°/s/√Hz": DEGREE * ONE_SIDED,
    "mdps/√Hz": 1e-3 * DEGREE * ONE_SIDED,
    "°/h/√Hz": DEGREE / HOUR_S * ONE_SIDED,
    "µg/√Hz": 1e-6 * G * ONE_SIDED,
    "mg/√Hz": 1e-3 * G * ONE_SIDED,
    "°/√h": DEGREE / HOUR_S**0.5,
    "m/s/√h": 1.0 / HOUR_S**0.5,
    "°/h floor": DEGREE / HOUR_S * FLOOR,
    "°/s floor": DEGREE * FLOOR,
    "µg floor": 1e-6 * G * FLOOR,
    "mg floor": 1e-3 * G * FLOOR,
    "°/s": DEGREE,
    "g": G,
    "°/s/LSB": DEGREE,
    "°/h/LSB": DEGREE / HOUR_S,
    "mg/LSB": 1e-3 * G,
}
PER_COUNT = {"LSB/(°/s)": DEGREE, "LSB/g": G}
VALUE = re.compile(r"^\w+ = (?P<value>\S+) +# (?P<si>[^;]+); (?P<number>\S+) (?P<unit>.+)$")


def convert_sheet_value(number: float, unit: str) -> float:
    return PER_COUNT[unit] / number if unit in PER_COUNT else number * SHEET_UNITS[unit]


def test_there_are_at_least_ten_models_of_three_grades():
    heads = " ".join(path.read_text("utf-8").splitlines()[0] for path in SENSORS)
    assert len(SENSORS) >= 10
    assert all(grade in heads for grade in ("consumer", "industrial", "tactical"))


@pytest.mark.parametrize("path", SENSORS, ids=lambda path: path.stem)
def test_values_agree_with_the_data_sheet(path):
    section, checked = "", 0
    for line in path.read_text("utf-8").splitlines():
        if line.startswith("["):
            section = line
        elif line and not line.startswith(("#", "sample_rate")):
            match = VALUE.match(line)
            assert match, f"no sheet value beside: {line}"
            expected = convert_sheet_value(float(match["number"]), match["unit"])
            assert float(match["value"]) == pytest.approx(expected, rel=1e-6)
            kind, effect = re.match(r'\["?([ga]).*?\.(\w+)\]', section).groups()
            units = next(iter(EFFECTS[effect].__dataclass_fields__.values())).metadata["units"]
            assert match["si"] == units["ga".index(kind)]
            checked += 1
    assert checked >= 5


@pytest.mark.parametrize("path", SENSORS, ids=lambda path: path.stem)
def test_model_names_its_document(path):
    head = " ".join(line.lstrip("# ") for line in path.read_text("utf-8").splitlines() if line.startswith("#"))
    assert re.search(r"[Dd]ata ?[Ss]heet|Product Specification|user manual", head)
    assert re.search(r"revision (\w|\.)+", head), "which revision, or that it is not known"
    assert "noise density (per √Hz) is one-sided, so N is that over √2" in head
    assert ("floor of the Allan curve" in head) == ("bias_instability" in path.read_text("utf-8"))


@pytest.mark.parametrize("path", SENSORS, ids=lambda path: path.stem)
def test_model_simulates_the_stated_allan_variance(path):
    model = NoiseModel.from_toml(path.read_text("utf-8"))
    rate_hz = model.sample_rate_hz
    values = model.simulate(20_000, rate_hz, 1)
    for column, axis in enumerate(AXES):
        # The variance σ²(τ0) from 20 000 first differences is accurate to 1.3 %.
        stated = model.avar(axis, np.array([1.0 / rate_hz]), 1.0 / rate_hz)[0]
        assert 0.5 * np.mean(np.diff(values[:, column]) ** 2) == pytest.approx(stated, rel=0.06)
