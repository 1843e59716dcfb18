"""Effects that a running sensor takes on, as people write them: "gz.sinusoidal:amplitude=1e-3,frequency=17"."""

import json
import re
from collections.abc import Iterator
from typing import Final

from drivers.errors import ConfigError
from monitor.noise.effect import Effect
from monitor.noise.model import NoiseModel

WRITTEN: Final = re.compile(r"\s*([^.:\s]+)\.([^.:\s]+)\s*:\s*(.*)")
EXAMPLE: Final = "gz.sinusoidal:amplitude=1e-3,frequency=17"


def effects_of(text: str) -> list[tuple[str, Effect]]:
    """The effect on its axis, or on each axis of a kind (``g*``).

    It is read as a table of a model file is, so that what is wrong is said in the same words.

    >>> effects_of("gz.angle_random_walk:N=1e-3")
    [('gz', AngleRandomWalk(N=0.001))]

    Raises:
        ConfigError: one line: what is wrong, and the nearest known name
    """
    written = WRITTEN.fullmatch(text)
    if written is None:
        raise ConfigError(f'"{text}" is no effect; write axis.effect:parameter=value,… as in {EXAMPLE}')
    axis, effect, parameters = written.groups()
    table = [f"[{json.dumps(axis)}.{json.dumps(effect)}]", *_parameters(text, parameters)]
    return list(NoiseModel.from_toml("\n".join(table)))


def _parameters(text: str, parameters: str) -> Iterator[str]:
    given: set[str] = set()
    for part in filter(None, map(str.strip, parameters.split(","))):
        name, equals, value = (word.strip() for word in part.partition("="))
        if not (name and equals and value):
            raise ConfigError(f'"{text}": "{part}" is no parameter; write name=value')
        if name in given:
            raise ConfigError(f'"{text}": {name} occurs twice')
        given.add(name)
        yield f"{json.dumps(name)} = {_toml(value)}"


def _toml(value: str) -> str:
    """A number as such, anything else (an axis) in quotes."""
    for kind in (int, float):
        try:
            return repr(kind(value))
        except ValueError:
            continue
    return json.dumps(value)
