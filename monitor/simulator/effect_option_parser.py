"""Parser for noise effects in the syntax "gz.sinusoidal:amplitude=1e-3,frequency=17"."""

import json
import re
from collections.abc import Iterator
from typing import Final

from drivers.errors import ConfigError
from monitor.noise.effect import Effect
from monitor.noise.model import NoiseModel

EFFECT_SYNTAX: Final = re.compile(r"\s*([^.:\s]+)\.([^.:\s]+)\s*:\s*(.*)")
"""Regular expression for a noise effect: axis, name and parameters."""
EXAMPLE: Final = "gz.sinusoidal:amplitude=1e-3,frequency=17"
"""Example for error messages."""


def parse_effects(text: str) -> list[tuple[str, Effect]]:
    """Parse a noise effect, and return pairs of axis and effect for all selected axes.

    The effect is parsed as a table of a noise model file, so that error messages are the same.

    Raises
    ------
    ConfigError
        If the text is not a valid noise effect.

    Examples
    --------
    >>> parse_effects("gz.angle_random_walk:N=1e-3")
    [('gz', AngleRandomWalk(N=0.001))]
    """
    written = EFFECT_SYNTAX.fullmatch(text)
    if written is None:
        raise ConfigError(f'"{text}" is not an effect; write axis.effect:parameter=value,… as in {EXAMPLE}')
    axis, effect, parameters = written.groups()
    table = [f"[{json.dumps(axis)}.{json.dumps(effect)}]", *_parameters(text, parameters)]
    return list(NoiseModel.from_toml("\n".join(table)))


def _parameters(text: str, parameters: str) -> Iterator[str]:
    given: set[str] = set()
    for part in filter(None, map(str.strip, parameters.split(","))):
        name, equals, value = (word.strip() for word in part.partition("="))
        if not (name and equals and value):
            raise ConfigError(f'"{text}": "{part}" is not a parameter; write name=value')
        if name in given:
            raise ConfigError(f'"{text}": {name} occurs twice')
        given.add(name)
        yield f"{json.dumps(name)} = {_toml(value)}"


def _toml(value: str) -> str:
    """Format a number or a quoted string in TOML notation."""
    for kind in (int, float):
        try:
            return repr(kind(value))
        except ValueError:
            continue
    return json.dumps(value)
