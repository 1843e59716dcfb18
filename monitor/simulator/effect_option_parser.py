"""Parser for effects that begin while a simulated sensor runs, such as "gz.sinusoidal:amplitude=1e-3,frequency=17"."""

import json
import re
from collections.abc import Iterator
from typing import Final

from drivers.errors import ConfigError
from monitor.noise.effect import Effect
from monitor.noise.model import NoiseModel

EFFECT_SYNTAX: Final = re.compile(r"\s*([^.:\s]+)\.([^.:\s]+)\s*:\s*(.*)")
"""Regular expression for an effect: axis, name and parameters."""
EXAMPLE: Final = "gz.sinusoidal:amplitude=1e-3,frequency=17"
"""Example in the error message."""


def parse_effects(text: str) -> list[tuple[str, Effect]]:
    """Parse an effect; return one pair of axis and effect for each axis that the text selects (``gz``, ``g*``).

    The effect is read as a table of a model file, so that mistakes give the same messages.

    Raises
    ------
    ConfigError
        If the text is not a valid effect. For an unknown name, the message suggests the most similar known name.

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
    """Yield the parameters as lines of TOML."""
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
    """Return a value in TOML: a number unquoted, and any other value, such as an axis, in quotes."""
    for kind in (int, float):
        try:
            return repr(kind(value))
        except ValueError:
            continue
    return json.dumps(value)
