"""Tests that docs/reference/effects.md agrees with the code: names, order, descriptions, parameters and units."""

import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from monitor.noise.effect import Transform, gyro_and_accel_units
from monitor.noise.effects import EFFECTS, TRANSFORM_ORDER
from monitor.noise.temperature import Temperature
from tests.contracts.effect_examples import AXIS, make_model

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "effects.md"
SECTIONS = dict(
    re.findall(r"^## `\[?(\w+)\]?`(?: →)?\n(.*?)(?=^## |\Z)", PAGE.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
)


def test_page_has_every_effect_and_the_order_of_the_transforms():
    assert sorted(SECTIONS) == sorted([*EFFECTS, "temperature"])
    marked = re.findall(r"^## `(\w+)` →$", PAGE.read_text("utf-8"), flags=re.MULTILINE)
    assert marked == [kind.name for kind in TRANSFORM_ORDER]
    assert {name for name, kind in EFFECTS.items() if issubclass(kind, Transform)} == set(marked)


@pytest.mark.parametrize("name", EFFECTS)
def test_section_agrees_with_the_code(name):
    section = SECTIONS[name]
    assert section.strip().startswith(EFFECTS[name].description)
    rows = dict(re.findall(r"^- `(\w+)` \[([^\]]+)\]: ", section, flags=re.MULTILINE))
    assert list(rows) == [f.name for f in fields(EFFECTS[name])]
    for f in fields(EFFECTS[name]):
        assert rows[f.name] == " / ".join(dict.fromkeys(f.metadata["units"]))
        assert ("may be absent" in section) == any(g.metadata.get("optional", False) for g in fields(EFFECTS[name]))
    properties = (r"σ²\(τ\)", r"S\(f\)", "source")
    assert all(re.search(rf"^- {what}: .*\w", section, flags=re.MULTILINE) for what in properties)


@pytest.mark.parametrize(
    "name", sorted(set(EFFECTS) - {"saturation", "resolution"})
)  # whether these are NaN depends on their parameters
def test_page_states_nan_where_the_code_returns_nan(name):
    value = make_model(name).avar(AXIS, np.array([1.0]), 0.02)[0]
    assert ("- σ²(τ): NaN\n" in SECTIONS[name]) == bool(np.isnan(value))


def test_page_describes_the_temperature():
    rows = dict(re.findall(r"^- `(\w+)` \[([^\]]+)\]: ", SECTIONS["temperature"], flags=re.MULTILINE))
    assert rows == {name: unit for name, (unit, _) in gyro_and_accel_units(Temperature).items()}
