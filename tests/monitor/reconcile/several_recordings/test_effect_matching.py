"""Tests that effects in several recordings are matched by location."""

from dataclasses import fields

import pytest

from monitor.noise.effects import EFFECTS, AngleRandomWalk, Sinusoidal
from monitor.noise.model import NoiseModel
from monitor.reconcile.effect_properties import EFFECT_PROPERTIES
from monitor.reconcile.result import ParameterInterval
from monitor.reconcile.several_recordings.effect_matching import (
    distance_if_parameters_match,
    find_effect_of_step,
    find_identifying_parameter,
    identifying_parameter_name,
)
from tests.monitor.reconcile.runs_made import around, line, step

LINES = NoiseModel(
    {
        "gz": (
            AngleRandomWalk(N=1e-4),
            Sinusoidal(amplitude=2.0, frequency=17.0),
            Sinusoidal(amplitude=1.0, frequency=30.0),
        )
    }
)


@pytest.mark.parametrize("effect", [name for name, row in EFFECT_PROPERTIES.items() if row.identity])
def test_place_is_a_parameter_of_its_effect(effect: str) -> None:
    assert identifying_parameter_name(effect) in {f.name for f in fields(EFFECTS[effect])}  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("effect", "a", "b", "same"),
    [
        ("sinusoidal", around(17.3, 1e-4), around(17.31, 1e-4), True),  # a motor is not steadier
        ("sinusoidal", around(17.3, 1e-4), around(18.0, 1e-4), False),
        ("sinusoidal", around(17.3, 0.3), around(18.0, 0.1), True),  # not known any better
        ("exponentially_correlated", around(10.0, 0.1), around(19.0, 0.1), True),
        ("exponentially_correlated", around(10.0, 0.1), around(40.0, 0.1), False),
        ("bias_step", around(100.0, 0.1), around(300.0, 0.1), False),
        ("g_sensitivity", ParameterInterval("ax"), ParameterInterval("ax"), True),
        ("g_sensitivity", ParameterInterval("ax"), ParameterInterval("ay"), False),
        ("outliers", None, None, True),
    ],
)  # fmt: skip
def test_places_may_differ_between_recordings(
    effect: str, a: ParameterInterval | None, b: ParameterInterval | None, same: bool
) -> None:
    assert (distance_if_parameters_match(effect, a, b) is not None) is same
    assert (distance_if_parameters_match(effect, b, a) is not None) is same


def test_distance_of_places_increases_with_their_difference() -> None:
    near, far = (
        distance_if_parameters_match("sinusoidal", around(17.3, 1e-3), around(f, 1e-3)) for f in (17.31, 17.35)
    )
    assert near is not None
    assert far is not None
    assert 0.0 < near < far


def test_step_is_found_in_the_model_by_its_parameters() -> None:
    assert find_effect_of_step(LINES, "gz", line(1.01, 30.1)) is LINES.effects["gz"][2]
    assert find_effect_of_step(LINES, "gz", line(1.9, 16.9)) is LINES.effects["gz"][1]


def test_place_of_a_retuned_line_is_that_in_the_model() -> None:
    retuned = step("sinusoidal", kind="retuned", amplitude=1.01)
    assert find_identifying_parameter(retuned, "gz", LINES) == ParameterInterval(30.0)
    assert find_identifying_parameter(step("angle_random_walk", kind="retuned", N=1e-4), "gz", LINES) is None
