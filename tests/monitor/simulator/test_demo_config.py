"""Tests of the configuration of the demo: sensors, effects and invalid options."""

from pathlib import Path

import pytest

from drivers.errors import ConfigError
from monitor.common.shipped_config_paths import CONFIG_FOLDER
from monitor.settings.loading import WINDOW_SAMPLES, VirtualTable, load_config
from monitor.simulator.demo_config import DEMO_CONFIG, build_demo_config

SHIPPED = sorted(path.stem for path in (CONFIG_FOLDER / "models").glob("*.toml"))


def test_default_is_the_shipped_configuration() -> None:
    config, (device,) = build_demo_config(), build_demo_config().devices
    assert (config.zenoh, config.viewer) == (load_config(DEMO_CONFIG).zenoh, load_config(DEMO_CONFIG).viewer)
    assert (device.link, device.rate_hz, device.window_s) == (load_config(DEMO_CONFIG).devices[0].link, 100.0, 600.0)


@pytest.mark.parametrize("name", SHIPPED)
def test_any_shipped_sensor_can_be_used(name: str) -> None:
    (device,) = build_demo_config(name).devices
    assert isinstance(device.link, VirtualTable)
    assert Path(device.link.model).stem == name
    assert device.rate_hz
    assert WINDOW_SAMPLES[0] <= device.window_s * device.rate_hz <= WINDOW_SAMPLES[1]


def test_model_file_is_used_at_its_rate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.toml").write_text("sample_rate = 400000.0\n[gz.angle_random_walk]\nN = 1e-4\n")
    (device,) = build_demo_config("mine.toml").devices
    assert (device.rate_hz, device.window_s) == (400_000.0, 25.0)
    Path("mine.toml").write_text("[gz.angle_random_walk]\nN = 1e-4\n")
    assert build_demo_config("mine.toml").devices[0].rate_hz == 100.0


def test_effects_and_their_start_time_are_set() -> None:
    (device,) = build_demo_config(None, ["gz.bias:value=1", "ax.bias:value=2"], 5.0).devices
    assert isinstance(device.link, VirtualTable)
    assert (device.link.effect, device.link.effect_at) == (("gz.bias:value=1", "ax.bias:value=2"), 5.0)


def test_invalid_option_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r'--sensor: no model "consumer-mem".*did you mean "consumer-mems"\?'):
        build_demo_config("consumer-mem")
    Path("bad.toml").write_text("[gz.angle_random_walk]\nM = 1.0\n")
    with pytest.raises(ConfigError, match=r"--sensor: .*bad\.toml: gz\.angle_random_walk: unknown parameter"):
        build_demo_config("bad.toml")
    with pytest.raises(ConfigError, match=r'--effect: gz: unknown effect "sinusodal"; did you mean "sinusoidal"'):
        build_demo_config(None, ["gz.sinusodal:amplitude=1,frequency=2"])
