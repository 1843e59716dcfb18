"""Tests of the sentences and numbers that describe a reconciliation."""

from dataclasses import replace

import numpy as np
import pytest

from monitor.common.unit_formatting import UNIT_SYSTEMS
from monitor.noise.effect import gyro_and_accel_units
from monitor.noise.effects import EFFECTS, AngleRandomWalk
from monitor.noise.model import NoiseModel
from monitor.publishing.reports import reconcile_sentences as words
from monitor.reconcile.result import AddedOrResizedEffect, AlternativeEffect, Location, ParameterInterval
from monitor.reconcile.summary.ranked_findings import rank_findings
from tests.monitor.reconcile import samples

EMPTY_MODEL = NoiseModel({})


def make_step(
    effect: str, axis: str = "gz", kind: str = "added", **parameters: ParameterInterval
) -> AddedOrResizedEffect:
    step = samples.explained().axes["gz"].steps[0]
    return replace(step, effect=effect, parameters=parameters, kind=kind)


def format_parameters_briefly(effect: str, axis: str = "gz", **parameters: ParameterInterval) -> list[str]:
    return [found.short for found in words.format_parameters(make_step(effect, **parameters), axis, EMPTY_MODEL)]


@pytest.mark.parametrize("axis", ["gz", "az"])
@pytest.mark.parametrize("effect", list(EFFECTS))
def test_each_parameter_has_a_conventional_unit(effect: str, axis: str) -> None:
    units = {name: pair[axis == "az"] for name, pair in gyro_and_accel_units(EFFECTS[effect]).items()}
    given = {
        name: ParameterInterval("ax") if si == "axis" else ParameterInterval(2.0, 1.9, 2.1)
        for name, si in units.items()
    }
    for found in words.format_parameters(make_step(effect, **given), axis, EMPTY_MODEL):
        assert "rad" not in found.unit.replace("µrad", "")
        assert found.value
        assert found.short.endswith(found.unit)
        if units[found.name] not in ("1", "axis"):
            assert found.unit


@pytest.mark.parametrize("axis", ["gz", "az"])
@pytest.mark.parametrize("effect", list(EFFECTS))
def test_si_units_are_those_of_the_parameters(effect: str, axis: str) -> None:
    units = {name: pair[axis == "az"] for name, pair in gyro_and_accel_units(EFFECTS[effect]).items()}
    given = {name: ParameterInterval(2.0, 1.9, 2.1) for name, si in units.items() if si != "axis"}
    for found in words.format_parameters(make_step(effect, **given), axis, EMPTY_MODEL, UNIT_SYSTEMS["si"]):
        own = units[found.name].replace("1", "") if units[found.name] == "1" else units[found.name]
        densities = {"rad/√s": "rad/s/√Hz", "m/s/√s": "m/s²/√Hz", "rad/s/√s": "rad/s²/√Hz", "m/s²/√s": "m/s³/√Hz"}
        assert found.unit == densities.get(own, own)
        assert float(found.value) == 2.0


def test_datasheet_units_add_the_one_sided_noise_density() -> None:
    step = make_step("angle_random_walk", N=ParameterInterval(1e-4, 0.9e-4, 1.1e-4))
    walk, density = words.format_parameters(step, "gz", EMPTY_MODEL, UNIT_SYSTEMS["datasheet"])
    assert walk.short == "0.344 ± 0.034 °/√h"
    assert (density.name, density.short) == ("noise density, one-sided", "8.10 ± 0.81 m°/s/√Hz")


def test_value_has_the_digits_that_its_interval_allows() -> None:
    assert format_parameters_briefly("sinusoidal", frequency=ParameterInterval(17.300012, 17.299912, 17.300112)) == [
        "17.300012 ± 0.000100 Hz"
    ]
    assert format_parameters_briefly("bias_step", time=ParameterInterval(1800.0, 1799.0, 1801.0)) == ["1800.0 ± 1.0 s"]
    assert format_parameters_briefly("poisson_steps", rate=ParameterInterval(0.01, 0.002, 0.03)) == [
        "0.010 (0.002 … 0.030) 1/s"
    ]
    assert format_parameters_briefly("bias_step", height=ParameterInterval(-1e-4, -1.1e-4, -0.9e-4)) == [
        "−20.6 ± 2.1 °/h"
    ]


def test_small_and_large_values_have_suitable_units() -> None:
    assert format_parameters_briefly("saturation", limit=ParameterInterval(5.0)) == ["286 °/s"]
    assert format_parameters_briefly("resolution", step=ParameterInterval(1e-5)) == ["2.06 °/h"]
    assert format_parameters_briefly("resolution", "az", step=ParameterInterval(0.00980665)) == ["1000 µg"]
    assert format_parameters_briefly("saturation", "az", limit=ParameterInterval(19.6)) == ["19.6 m/s²"]
    assert format_parameters_briefly("sinusoidal", phase=ParameterInterval(np.pi / 2)) == ["90.0 °"]
    assert format_parameters_briefly("outliers", fraction=ParameterInterval(0.001, 0.0009, 0.0011)) == [
        "0.100 ± 0.010 %"
    ]
    assert format_parameters_briefly("bandwidth_limit", order=ParameterInterval(2)) == ["2"]
    (leak,) = format_parameters_briefly(
        "g_sensitivity", coefficient=ParameterInterval(np.radians(1.0) / 3600 / 9.80665)
    )
    assert leak == "1.00 °/h/g"


def test_axis_parameter_has_no_interval_or_unit() -> None:
    (found,) = words.format_parameters(make_step("cross_axis", source=ParameterInterval("gx")), "gz", EMPTY_MODEL)
    assert (found.value, found.interval, found.unit, found.short) == ("gx", "", "", "gx")


def test_retuned_term_is_shown_with_the_value_of_the_model() -> None:
    model = NoiseModel({"gz": (AngleRandomWalk(N=1.5e-4),)})
    bounds = {"N": ParameterInterval(1.8e-4, 1.79e-4, 1.81e-4)}
    (retuned,) = words.format_parameters(make_step("angle_random_walk", kind="retuned", **bounds), "gz", model)
    assert retuned.given == "0.516 °/√h"
    (added,) = words.format_parameters(make_step("angle_random_walk", kind="added", **bounds), "gz", model)
    assert added.given == ""


@pytest.mark.parametrize(
    ("where", "text"),
    [
        (Location(), "everywhere"),
        (Location(frequency=(17.1, 17.5)), "17.1 … 17.5 Hz"),
        (Location(tau=(0.01, 0.64)), "τ = 0.01 … 0.64 s"),
        (Location(time=(1800.0, 1800.01)), "t = 1800 s"),
        (Location(temperature=(20.0, 35.5)), "20 … 35.5 °C"),
        (Location(value=(-5.0, 5.0)), "−286.5 … 286.5 °/s"),
        (Location(time=(0.0, 60.0), source="ax"), "t = 0 … 60 s, from ax"),
    ],
)
def test_range_has_its_unit(where: Location, text: str) -> None:
    assert words.format_range(where, "gz") == text


def test_influence_on_the_allan_deviation_has_its_averaging_time() -> None:
    line, white = rank_findings(samples.explained()).findings
    assert words.describe_allan_influence(line) == "× 1.05 at τ = 0.02 s (gz)"
    assert words.describe_allan_influence(replace(white, influences={})) == "—"


def test_alternative_effects_are_named_with_their_probability() -> None:
    step = samples.explained().axes["gz"].steps[0]
    assert words.describe_alternatives(step) == (
        "Less likely explanations of the same gap: narrowband (0.2 %) and sample rate error (< 0.1 %)."
    )
    assert (
        words.describe_alternatives(replace(step, runners_up=())) == "No other effect explains the gap nearly as well."
    )
    single = words.describe_alternatives(replace(step, runners_up=(AlternativeEffect("bias_step", 0.31),)))
    assert single == "Less likely explanations of the same gap: bias step (31.0 %)."
