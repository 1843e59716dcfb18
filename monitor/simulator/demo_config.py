"""Configuration of the ``demo`` command.

Options of the command can replace the sensor and add noise effects.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from monitor.common import shipped_config_paths
from monitor.common.shipped_config_paths import CONFIG_FOLDER
from monitor.noise.model_loading import read_model
from monitor.noise.model_toml import prefix_config_errors
from monitor.settings import loading
from monitor.settings.loading import Config, VirtualTable
from monitor.simulator import DEFAULT_RATE_HZ, parse_effects

DEMO_CONFIG: Final = CONFIG_FOLDER / "demo.toml"
"""Path of the shipped configuration."""


def build_demo_config(
    sensor: str | None = None, effects: Sequence[str] = (), effect_at_s: float | None = None
) -> Config:
    """Build the configuration of the ``demo`` command.

    Parameters
    ----------
    sensor : str, optional
        Name of a shipped noise model, or path of a model file. By default, the shipped configuration is not changed.
    effects : sequence of str, optional
        Noise effects in the syntax of ``parse_effects``.
    effect_at_s : float, optional
        Start time of the effects in seconds after the start of the sensor.

    Raises
    ------
    ConfigError
        If an option is invalid. The message begins with the name of the option.
    """
    config = loading.load_config(DEMO_CONFIG)
    (device,) = config.devices
    table = device.link
    assert isinstance(table, VirtualTable)
    with prefix_config_errors("--sensor"):
        model = Path(table.model) if sensor is None else shipped_config_paths.resolve_model_path(sensor, Path.cwd())
        rate_hz = read_model(model).sample_rate_hz or DEFAULT_RATE_HZ
    with prefix_config_errors("--effect"):
        for text in effects:
            parse_effects(text)
    given = {"effect": tuple(effects) or None, "effect_at": effect_at_s}
    given = {key: value for key, value in given.items() if value is not None}
    table = table.model_copy(update={"model": str(model), **given})
    window_s = min(device.window_s, loading.WINDOW_SAMPLES[1] / rate_hz)
    # the viewer then shows when the sensor no longer agrees with the noise model
    driver = replace(device.driver, link=table)
    update = {"driver": driver, "rate_hz": rate_hz, "window_s": window_s, "model": model}
    device = device.model_copy(update=update)
    return replace(config, devices=(device,), path=None)
