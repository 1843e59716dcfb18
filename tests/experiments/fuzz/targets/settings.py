"""Fuzz targets of configuration files, model files and CAN databases.

A valid configuration contains only finite numbers within their ranges. Each mistake in a configuration is reported in
one line and never raises an exception.
"""

import datetime
import shutil
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

from drivers.data_types import Chunk
from drivers.decoders import dbc
from drivers.errors import ConfigError
from drivers.validation.settings_model import SettingsModel
from monitor.common import shipped_config_paths
from monitor.noise.model import NoiseModel
from monitor.noise.model_loading import read_model
from monitor.settings import loading
from tests.contracts.decoder_examples import CAN_DATABASE, CAN_SIGNALS
from tests.experiments.fuzz.checks import check_error_message, feed_and_check
from tests.experiments.fuzz.input_reader import SPECIAL_FLOATS, InputReader
from tests.experiments.fuzz.target import target
from tests.experiments.fuzz.targets.decoders import SECOND_DATABASE, SECOND_SIGNALS
from tests.experiments.fuzz.targets.files import get_folder
from tests.support.settings import read_settings

CONFIG: Final = shipped_config_paths.CONFIG_FOLDER
MAX_LINES: Final = 2000


@cache
def get_config_folder() -> Path:
    """Return a folder with the files that the configurations name."""
    folder = get_folder() / "config"
    folder.mkdir()
    (folder / "imu.dbc").write_text(CAN_DATABASE)
    (folder / "a.csv").write_text("t,gz\n0,1\n0.01,2\n")
    shutil.copy(CONFIG / "models" / "bmi088.toml", folder / "model.toml")
    return folder


def load_example_texts() -> list[str]:
    """Return the shipped configurations and one that contains every table."""
    shipped = [file.read_text("utf-8").replace('"j1939_imu"', '"imu.dbc"') for file in sorted(CONFIG.glob("*.toml"))]
    return [*shipped, COMPLETE_CONFIG]


def generate_seeds() -> Iterator[bytes]:
    """Generate the example configurations and two with extreme nesting or numbers."""
    yield from (text.encode() for text in load_example_texts())
    yield b"a = " + b"[" * 2500
    yield b"rate = " + b"9" * 4400


COMPLETE_CONFIG: Final = """
[[device]]
name = "a"
rate = 100.0
window = "30min"
tau = [0.1, 1.0]
refit = "every sample"
publish = "2 Hz"
model = "model.toml"
thermal_interval = "off"
[device.driver]
link = "replay"
path = "a.csv"
speed = 10
[device.axes]
gz = "-gy"
gy = "gz"
[[device]]
name = "b"
[device.driver]
link = "virtual"
decoder = "dbc"
effect = ["gz.bias:value=1"]
[device.driver.decoder_options]
file = "imu.dbc"
signals = {gz = "RateOfTurn.gyrZ", ax = {signal = "Acceleration.accX", unit = "g", factor = 2.0}}
[device.driver.faults]
lost = 0.1
[[device]]
name = "c"
driver = {link = "serial", port = "socket://127.0.0.1:1", decoder = "text", decoder_options = {columns = ["gx", "t"]}}
[zenoh]
mode = "client"
connect = ["tcp/127.0.0.1:7447"]
[storage]
folder = "kept"
segment = "10min"
keep = 86400
[log]
level = "debug"
"""


def check_config(text: bytes) -> None:
    """Read a configuration and check its contents or its errors."""
    path = get_config_folder() / "a.toml"
    path.write_bytes(text)
    reading = loading.examine_config_file(path)
    config, wrong = reading.config, reading.wrong
    assert (config is None) == bool(wrong)
    assert len(wrong) < MAX_LINES
    for line in wrong:
        assert "\n" not in line, f"several lines: {line[:200]}"
        assert len(line) < 5000
    if config is None:
        try:
            loading.load_config(path)
        except ConfigError as error:
            check_error_message(error)
        else:
            raise AssertionError("a wrong file was loaded")
        return
    assert config.devices
    for device in config.devices:
        check_finite(device)
        assert 0.0 < device.window_s < float("inf")
        assert device.rate_hz is None or 0.0 < device.rate_hz < float("inf"), device.rate_hz
        assert min(device.refit_s, device.publish_s, device.silence_s, device.alarms_per_day) >= 0.0
        assert loading.DEVICE_NAME.fullmatch(device.name)
    check_finite(config.storage)


def check_finite(value: Any) -> None:
    """Check that all numbers in a value and its fields are finite."""
    if isinstance(value, float):
        assert value == value, "not a number"
        assert abs(value) < float("inf"), "infinite"
    elif isinstance(value, tuple | list):
        for item in value:
            check_finite(item)
    elif isinstance(value, Mapping):
        for item in value.values():
            check_finite(item)
    elif isinstance(value, SettingsModel):
        for name in type(value).model_fields:
            check_finite(getattr(value, name))
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            check_finite(getattr(value, field.name))


WORDS: Final = (
    "[[device]]", "[device.driver]", "link = ", "[zenoh]", "[storage]", "[log]", "[viewer]", "= nan\n", "= inf\n",
    '"1e999"', "1e400", "'''", '"""', "[[", "]]", "{", "}", "1979-05-27T07:32:00Z", "true", '"9e9d"', "\\u0000", "= -1",
)  # fmt: skip


@target("settings", generate_seeds, 4500, WORDS)
def settings_text(data: bytes) -> None:
    """Check any text as a configuration."""
    check_config(data)


@cache
def load_example_tables() -> list[dict[str, Any]]:
    return [tomllib.loads(text) for text in load_example_texts()]


@target("settings-values", lambda: [bytes([i, *range(8 * k, 8 * k + 16)]) for i in range(7) for k in range(6)], 100)
def settings_values(data: bytes) -> None:
    """Check a shipped configuration in which values are replaced by values of any type."""
    reader = InputReader(data)
    table = _copy(reader.choose(load_example_tables()))
    for _ in range(6):
        if not reader:
            break
        at: Any = table
        for _ in range(8):
            keys = list(at) if isinstance(at, dict) else list(range(len(at)))
            if not keys:
                break
            key = keys[reader.read_byte() % len(keys)]
            if not isinstance(at[key], dict | list) or reader.read_byte() % 8 == 0:
                at[key] = draw_unusual_value(reader)
                break
            at = at[key]
        if reader.read_byte() % 4 == 0 and isinstance(at, dict):
            at[reader.choose(KEYS)] = draw_unusual_value(reader)
    check_config(_toml(table).encode("utf-8", "surrogatepass"))


KEYS: Final = (
    "rate", "window", "tau", "refit", "publish", "alarms_per_day", "thermal_interval", "silence", "model", "axes",
    "driver", "link", "port", "baudrate", "speed", "seed", "effect", "effect_at", "faults", "rate_hz", "decoder",
    "bytes_per_second", "decoder_options", "columns", "scale", "counter_modulus", "signals", "tick", "source",
    "segment", "keep", "disk_share", "config", "listen", "connect", "prefix", "memory", "mode", "name", "", "a.b", "ä",
)  # fmt: skip


def draw_unusual_value(reader: InputReader) -> Any:
    """Return a value that is unusual in a configuration."""
    kind = reader.read_byte() % 12
    if kind == 0:
        return reader.choose(SPECIAL_FLOATS)
    if kind == 1:
        return reader.choose((0, -1, 1, 1 << 31, 1 << 63, 10**400, -(10**30), 10**5000))
    if kind == 2:
        return reader.choose(
            ("", "x", "1e999 s", "1e-320 Hz", "0.0 Hz", "nan", "every sample", "off", "\x1b[2J", "ü" * 300)
        )
    if kind == 3:
        return [draw_unusual_value(reader) for _ in range(reader.read_byte() % 4)]
    if kind == 4:
        return {reader.choose(KEYS): draw_unusual_value(reader) for _ in range(reader.read_byte() % 3)}
    if kind == 5:
        return reader.read_byte() % 2 == 0
    if kind == 6:
        return reader.choose((datetime.date(1, 1, 1), datetime.datetime(9999, 1, 1), datetime.time(1, 2)))
    if kind == 7:
        return reader.choose(
            ("replay", "serial", "can", "zenoh", "virtual", "loopback", "base", "dbc", "text", "stim300")
        )
    if kind == 8:
        return reader.read_piece().decode("utf-8", "replace")[:50]
    if kind == 9:
        return reader.read_special_float()
    if kind == 10:
        return reader.choose(
            ("a.csv", "imu.dbc", "model.toml", "/nowhere", ".", "~nobody/x", "\0", "a.csv/x", "x" * 300)
        )
    return reader.read_int64()


def _copy(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _copy(one) for key, one in value.items()}
    return [_copy(one) for one in value] if isinstance(value, list) else value


def _toml(table: Mapping[str, Any]) -> str:
    return "".join(f"{_word(key)} = {_value(value)}\n" for key, value in table.items())


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return _word(value)
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_word(key)} = {_value(one)}" for key, one in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, datetime.date | datetime.time):
        return value.isoformat()
    if isinstance(value, int) and abs(value) > 10**4000:
        return "9" * 5000
    return repr(value)


def _word(text: str) -> str:
    return '"' + "".join(c if c.isalnum() and c.isascii() else f"\\U{ord(c):08X}" for c in text) + '"'


# --- models


@target(
    "model",
    lambda: [
        *(file.read_bytes() for file in sorted((CONFIG / "models").glob("*.toml"))),
        b"[gz.bias]\nvalue = 1" + b"0" * 400,
        b"sample_rate = 1" + b"0" * 400,
        b"gz = " + b"[" * 1200,
    ],
    2000,
    (
        "[gz.bias]",
        '["g*".sinusoidal]',
        "[[ax.",
        "sample_rate = ",
        "[temperature]",
        "nan",
        "inf",
        "1e400",
        "[" * 20,
        "9" * 50,
    ),
)
def model(data: bytes) -> None:
    """Check that a model is the same after it has been written and read again."""
    path = get_folder() / "a-model.toml"
    path.write_bytes(data)
    try:
        found = read_model(path)
    except ConfigError as error:
        check_error_message(error)
        return
    check_finite([value for _, effect in found for value in (getattr(effect, f.name) for f in fields(effect))])
    str(found)
    assert NoiseModel.from_toml(found.to_toml()).to_toml() == found.to_toml()


# --- CAN databases


def _databases() -> Iterator[bytes]:
    yield from (CAN_DATABASE.encode(), SECOND_DATABASE.encode())
    yield (CONFIG / "dbc" / "xsens_mti.dbc").read_bytes()[:1500]


@target(
    "dbc",
    _databases,
    1500,
    ("BO_ ", " SG_ ", "|", "@1+", "@0-", "(0,0)", "1e400", "nan", "SIG_VALTYPE_", "BA_ ", "M", "m0"),
)
def database(data: bytes) -> None:
    """Check that a CAN database is rejected, or gives a decoder with valid samples."""
    path = get_folder() / "a.dbc"
    path.write_bytes(data)
    signals = CAN_SIGNALS if b"RateOfTurn" in data else SECOND_SIGNALS
    try:
        decoder = dbc.build(read_settings(dbc.Settings, {"file": str(path), "signals": signals}))
    except ConfigError as error:
        check_error_message(error)
        return
    tail = data[-64:]
    feed_and_check(
        decoder,
        [
            [
                Chunk(tail[: 8 + i % 2 * 56], 5, address & ~(1 << 30))
                for i in range(3)
                for address in decoder.accepted_addresses
            ]
        ],
    )
