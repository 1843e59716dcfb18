"""Tests of the parser of effects in one line."""

import pytest

from drivers.data_types import AXES
from drivers.errors import ConfigError
from monitor.noise.effects import EFFECTS
from monitor.simulator.effect_option_parser import parse_effects


def test_effect_is_parsed_for_one_axis_or_a_kind_of_axes() -> None:
    sinusoidal = EFFECTS["sinusoidal"](amplitude=1e-3, frequency=17.0)
    assert parse_effects("gz.sinusoidal:amplitude=1e-3,frequency=17") == [("gz", sinusoidal)]
    assert parse_effects(" gz.sinusoidal : frequency = 17 , amplitude = 1e-3 ") == [("gz", sinusoidal)]
    assert parse_effects("a*.sinusoidal:amplitude=1e-3,frequency=17") == [(axis, sinusoidal) for axis in AXES[3:]]


def test_axis_is_accepted_as_a_parameter() -> None:
    ((axis, effect),) = parse_effects("gz.g_sensitivity:source=ax,coefficient=1e-4")
    assert (axis, effect) == ("gz", EFFECTS["g_sensitivity"](source="ax", coefficient=1e-4))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is not an effect; write axis.effect:parameter=value"),
        ("gz", "is not an effect"),
        ("gz.sinusoidal", "is not an effect"),
        ("gz:sinusoidal", "is not an effect"),
        ("gy.sinusodal:amplitude=1,frequency=2", 'did you mean "sinusoidal"?'),
        ("gw.sinusoidal:amplitude=1,frequency=2", 'unknown axis "gw"'),
        ("gz.sinusoidal:amplitud=1,frequency=2", 'did you mean "amplitude"?'),
        ("gz.sinusoidal:amplitude=1", "frequency is missing"),
        ("gz.sinusoidal:", "amplitude is missing"),
        ("gz.sinusoidal:amplitude=1,amplitude=2", "amplitude occurs twice"),
        ("gz.sinusoidal:amplitude", '"amplitude" is not a parameter; write name=value'),
        ("gz.sinusoidal:amplitude=,frequency=2", "is not a parameter"),
        ("gz.sinusoidal:amplitude=-1,frequency=2", "amplitude"),
        ("gz.sinusoidal:amplitude=nan,frequency=2", "amplitude"),
        ("gz.sinusoidal:amplitude=much,frequency=2", "amplitude"),
        ('g"z.sinusoidal:amplitude=1,frequency=2', "unknown axis"),
        ("gz.sinu\\soidal:amplitude=1", "unknown effect"),
    ],
)
def test_invalid_effect_is_refused_in_one_line(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_effects(text)
    line = str(caught.value)
    assert message in line
    assert "\n" not in line
