"""What ``demo`` runs: the shipped configuration, with another sensor or effects that it takes on while it runs."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, ParamSpec, TypeVar

import msgspec

from drivers.errors import ConfigError
from monitor.noise.catalogue import read_model
from monitor.settings import loading
from monitor.settings.loading import CONFIG_FOLDER, Config, VirtualTable
from monitor.simulator import DEFAULT_RATE_HZ, effects_of

P = ParamSpec("P")
T = TypeVar("T")

CONFIG: Final = CONFIG_FOLDER / "demo.toml"


def demo(sensor: str | None = None, effects: Sequence[str] = (), effect_at_s: float | None = None) -> Config:
    """The configuration of ``demo``.

    Args:
        sensor: a model of the catalogue, or a file; None = the one of the shipped configuration
        effects: as ``effects_of`` reads them
        effect_at_s: when they come, in seconds since the start
    Raises:
        ConfigError: one line: the option, and what is wrong with it
    """
    config = loading.load(CONFIG)
    (device,) = config.devices
    table = device.link
    assert isinstance(table, VirtualTable)
    given = {
        "model": None if sensor is None else str(_said_of("--sensor", loading.model_path, sensor, Path.cwd())),
        "effect": tuple(effects) or None,
        "effect_at": effect_at_s,
    }
    table = msgspec.structs.replace(table, **{key: value for key, value in given.items() if value is not None})
    rate_hz = _said_of("--sensor", read_model, Path(table.model)).sample_rate_hz or DEFAULT_RATE_HZ
    for text in effects:
        _said_of("--effect", effects_of, text)
    window_s = min(device.window_s, loading.WINDOW_SAMPLES[1] / rate_hz)
    # its own model is in force, so that the viewer tells when the sensor stops agreeing with it
    device = replace(device, link=table, rate_hz=rate_hz, window_s=window_s, model=Path(table.model))
    return replace(config, devices=(device,), path=None)


def _said_of(option: str, function: Callable[P, T], *arguments: P.args, **named: P.kwargs) -> T:
    """The function's result; what is wrong is said of this option."""
    try:
        return function(*arguments, **named)
    except ConfigError as error:
        raise ConfigError(f"{option}: {error}") from error
