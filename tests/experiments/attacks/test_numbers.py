"""Tests of absurd numbers in every numeric option, configuration key, model parameter and recording.

Each number is accepted, or rejected with exit status 2 and one line. There is no traceback, no warning on the terminal,
and no unlimited use of time or memory. The quick tests use a few values. The marker ``attack`` selects all values.
"""

import itertools
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Final, get_args, get_origin, get_type_hints

import numpy as np
import pytest

import drivers.decoders
import drivers.links
from drivers import module_lookup, number_ranges
from drivers.data_types import AXES
from drivers.errors import ConfigError, ImuError
from drivers.number_ranges import NumberRange
from drivers.recordings import load_samples
from drivers.settings_model import KeywordOrType, SettingsModel, fields_by_key
from monitor import cli
from monitor.commands.analyze import analyze_recording
from monitor.commands.recording_loading import DEFAULT_LOADING, LoadingOptions, load_recording
from monitor.common import shipped_config_paths
from monitor.noise.effects import EFFECTS
from monitor.noise.model import NoiseModel
from monitor.noise.temperature import Temperature
from monitor.settings import driver_settings, loading, schema

pytestmark = pytest.mark.timeout(900)
ROOT: Final = Path(cli.__file__).resolve().parents[2]
ALL_VALUES: Final = (
    *("0", "-1", "1e-300", "1e-9", "1e300", "nan", "inf", "-inf", "1e9", "1e12", str(1 << 63), "", "text"),
    *("9" * 5000, "0x10", "1e400", "1_000", " 5", "1e-3", "1e6"),
)
"""Unreasonable values, and two values at the ends of supported ranges."""
FEW_VALUES: Final = ("-1", "1e-300", "1e300", "nan", "", "9" * 5000)
DURATIONS: Final = ("1e300d", "0s", "-1h", "1e-300ms", "h", "9" * 400 + "d", "1 fortnight")
NUMERIC_METAVARS: Final = ("S", "HZ", "N", "F", "T", "P,Q", "octave|decade10|S,S,…")
ALLOWED_STATUS: Final = (0, 2, 3)


# --- options of commands


def iter_numeric_options() -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield command and name of every option that takes a number or a duration."""
    for path, callback in iter_commands():
        for name, kind in get_type_hints(callback, include_extras=True).items():
            for info in get_option_infos(kind):
                if {int, float} & set(iter_leaf_types(kind)) or info.metavar in NUMERIC_METAVARS:
                    # in Annotated, typer stores the first name as the default
                    names = (info.default, *(info.param_decls or ()))
                    long = [option for option in names if isinstance(option, str) and option.startswith("--")]
                    yield path, long[0] if long else f"--{name.replace('_', '-')}"


def iter_commands() -> Iterator[tuple[tuple[str, ...], Callable[..., Any]]]:
    groups = [((), cli.app), *(((group.name,), group.typer_instance) for group in cli.app.registered_groups)]
    for path, app in groups:
        for command in app.registered_commands:
            assert command.callback is not None
            yield (*path, command.name or command.callback.__name__), command.callback


def get_option_infos(kind: Any) -> list[Any]:
    """Return typer's descriptions of the option that a parameter type contains."""
    found = [item for item in getattr(kind, "__metadata__", ()) if type(item).__name__ == "OptionInfo"]
    return found + [
        info for part in get_args(kind) if get_origin(kind) is not Annotated for info in get_option_infos(part)
    ]


def iter_leaf_types(kind: Any) -> Iterator[Any]:
    parts = get_args(kind)[:1] if get_origin(kind) is Annotated else get_args(kind)
    if not parts:
        yield kind
    for part in parts:
        yield from iter_leaf_types(part)


@pytest.fixture
def arguments(tmp_path: Path) -> dict[tuple[str, ...], list[str]]:
    """Return valid arguments of each command, without options."""
    rng = np.random.default_rng(1)
    recording, model = tmp_path / "r.npz", str(shipped_config_paths.CONFIG_FOLDER / "models" / "consumer-mems.toml")
    temperature_c = 25.0 + 5.0 * np.sin(np.arange(2000) / 200.0)
    samples: dict[str, Any] = {axis: rng.normal(size=2000) for axis in AXES}
    np.savez(recording, t=np.arange(2000) / 100.0, temperature=temperature_c, **samples)
    config = tmp_path / "c.toml"
    config.write_text('[[device]]\nname = "a"\ndriver = { link = "virtual" }\n[storage]\nfolder = "kept"\n')
    out = ["--out", str(tmp_path / "out.npz")]
    return {
        ("demo",): [],
        ("run",): [str(config)],
        ("watch",): [],
        ("view",): [],
        ("analyze",): [str(recording)],
        ("simulate",): [model, "--seconds", "1", *out],
        ("reconcile",): [str(recording), "--out", str(tmp_path / "report")],
        ("compensate",): [str(recording), *out],
        ("history",): [str(tmp_path)],
        ("export",): [model, "--format", "kalman"],
        ("thermal", "fit"): [str(recording)],
        ("thermal", "predict"): [str(recording), "--model", str(tmp_path / "absent.json")],
    }


def test_every_kind_of_numeric_option_is_found() -> None:
    found = set(iter_numeric_options())
    for expected in (
        (("analyze",), "--rate"), (("analyze",), "--tau"), (("simulate",), "--seed"), (("simulate",), "--seconds"),
        (("run",), "--history"), (("export",), "--inflation"), (("export",), "--dt"),
        (("thermal", "fit"), "--interval"),
        (("history",), "--from"), (("compensate",), "--order"), (("watch",), "--seconds"), (("demo",), "--effect-at"),
    ):  # fmt: skip
        assert expected in found


def test_options_with_few_values(arguments: dict[tuple[str, ...], list[str]], tmp_path: Path) -> None:
    try_options(tuple(arguments), FEW_VALUES, arguments, tmp_path)


@pytest.mark.attack
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("command", sorted({path for path, _ in iter_numeric_options()}), ids=" ".join)
def test_options_with_all_values(
    command: tuple[str, ...], arguments: dict[tuple[str, ...], list[str]], tmp_path: Path
) -> None:
    try_options((command,), ALL_VALUES + DURATIONS, arguments, tmp_path)


def try_options(
    chosen: Sequence[tuple[str, ...]],
    values: Sequence[str],
    arguments: dict[tuple[str, ...], list[str]],
    folder: Path,
) -> None:
    options = [(command, option) for command, option in iter_numeric_options() if command in chosen]
    assert options
    cases = [[*command, *arguments[command], option, value] for command, option in options for value in values]
    for result in run_in_child(cases, folder):
        check_command_result(result)


def run_in_child(cases: list[list[str]], folder: Path) -> list[dict[str, Any]]:
    """Run command lines in one child process with limits of memory and of the time of each command."""
    cases_file, results_file = folder / "cases.json", folder / "results.json"
    cases_file.write_text(json.dumps(cases))
    program = [sys.executable, str(Path(__file__).with_name("child.py")), str(cases_file), str(results_file)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(program, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stderr == ""
    found: list[dict[str, Any]] = json.loads(results_file.read_text())
    assert len(found) == len(cases)
    return found


def check_command_result(result: dict[str, Any]) -> None:
    shown = [argument[:60] for argument in result["arguments"]]
    assert result["uncaught"] == "", (shown, result["uncaught"])
    assert result["warnings"] == [], shown
    assert result["status"] in ALLOWED_STATUS, (shown, result["err"])
    assert "Traceback" not in result["err"], shown
    assert "internal error" not in result["err"], (shown, result["err"])
    assert result["err"].count("\n") == (1 if result["status"] else 0), (shown, result["err"])
    assert len(result["err"]) < 3000, shown


# --- keys of a configuration

DEVICE: Final = '[[device]]\nname = "a"\nrate = 100.0\n{keys}\n[device.driver]\n{driver}\n'
CAN: Final = 'file = "canmod_gps", signals = { gz = "ImuData.GyroZ" }'
VIRTUAL: Final = 'link = "virtual"'
ALL_TOML_VALUES: Final = (
    *("0", "-1", "1e-300", "1e300", "nan", "inf", "-inf", "1e9", "1e12", str((1 << 63) - 1), str(1 << 63), "9" * 5000),
    *('""', '"text"', '"1e300 Hz"', '"1e-300 Hz"', '"nan Hz"', '"1e300s"', '"1e-300s"', '"99999999999999999999d"'),
    *(
        '"' + "9" * 400 + '"',
        '"99999999999999999999MiB"',
        '"0MiB"',
        '"1e9%"',
        '"999%"',
        '"h:99999"',
        "true",
        "[1e300]",
    ),
    *('["1e300"]', "{ a = 1e300 }", "1979-05-27"),
)
FEW_TOML_VALUES: Final = ("-1", "1e-300", "1e300", "nan", '"1e300 Hz"', '"1e300s"')


def iter_config_tables() -> Iterator[tuple[str, type[SettingsModel], str]]:
    """Yield a configuration with {} in place of ``key = value``, the model of the keys, and a name."""
    quiet = '[viewer]\nmode = "none"\n'
    virtual = DEVICE.format(keys="", driver=VIRTUAL)
    yield '[[device]]\nname = "a"\n{}\ndriver = { link = "virtual" }\n', schema.Device, "device"
    limit = '[[device.limit]]\naxes = "gz"\nletter = "N"\n{}\n'
    yield virtual + limit, schema.Limit, "limit"
    yield virtual + "[device.driver.faults]\n{}\n", driver_settings.FaultsTable, "faults"
    yield DEVICE.format(keys="", driver=VIRTUAL + "\n{}"), driver_settings.VirtualTable, "virtual"
    for name, kind in (
        ("viewer", schema.ViewerTable), ("metrics", schema.MetricsTable), ("influx", schema.InfluxTable),
        ("ros2", schema.Ros2Table), ("log", schema.LogTable),
    ):  # fmt: skip
        yield virtual + f"[{name}]\n{{}}\n", kind, name
    yield virtual + '[storage]\nfolder = "kept"\n{}\n', schema.Storage, "storage"
    yield virtual + '[[hook]]\non = ["*"]\nkey = "a/b"\n{}\n', schema.Hook, "hook"
    yield virtual + quiet + "[zenoh]\n{}\n", schema.ZenohTable, "zenoh"
    for name, driver in (
        ("serial", 'link = "serial"\nport = "/dev/x"\ndecoder = "stim300"\n{}'),
        (
            "can",
            'link = "can"\ndecoder = "dbc"\ndecoder_options = {{ {CAN} }}\n{{}}',
        ),
        ("iio", 'link = "iio"\ndevice = "0"\nenable = true\n{}'),
        ("replay", 'link = "replay"\npath = "r.npz"\n{}'),
        ("udp", 'link = "udp"\nport = 9\ndecoder = "mavlink"\n{}'),
        ("zenoh", 'link = "zenoh"\nkey = "a/b"\n{}'),
    ):
        yield (
            DEVICE.format(keys="", driver=driver),
            module_lookup.import_module(drivers.links, name, "_link").Settings,
            f"link {name}",
        )
    for name in module_lookup.list_modules(drivers.decoders):
        wanted = {
            "dbc": 'file = "canmod_gps"\nsignals = { gz = "ImuData.GyroZ" }\n',
            "epson_uart": 'model = "g366pdg0"\n',
            "text": 'columns = ["gz"]\n',
        }
        driver = f'link = "virtual"\ndecoder = "{name}"\n[device.driver.decoder_options]\n{wanted.get(name, "")}{{}}'
        yield (
            DEVICE.format(keys="", driver=driver),
            module_lookup.import_module(drivers.decoders, name).Settings,
            f"decoder {name}",
        )


def find_numeric_keys(kind: type[SettingsModel]) -> list[str]:
    """Return the keys that take a number, or a text that contains a number."""
    found = []
    for key, field in fields_by_key(kind).items():
        has_number_as_text = isinstance(field.default, str) and any(c.isdigit() for c in field.default)
        if has_number_as_text or key == "listen" or {int, float} & set(iter_leaf_types(field.annotation)):
            found.append(key)
    return found


def list_numeric_keys() -> list[tuple[str, str, str]]:
    """Return a text with {}, a key and a name for each numeric key. In the settings, a bool is no number."""
    return [(text, key, name) for text, kind, name in iter_config_tables() for key in find_numeric_keys(kind)]


def test_every_kind_of_numeric_key_is_found() -> None:
    found = {(name, key) for _, key, name in list_numeric_keys()}
    for expected in (
        ("device", "rate"), ("device", "tau"), ("device", "refit"), ("device", "alarms_per_day"), ("limit", "hold"),
        ("faults", "jitter"), ("virtual", "seed"), ("virtual", "silence"), ("viewer", "memory"), ("viewer", "port"),
        ("storage", "keep"), ("hook", "timeout"), ("metrics", "listen"), ("influx", "interval"), ("ros2", "domain"),
        ("link serial", "baudrate"),
        ("link can", "bitrate"), ("link replay", "bytes_per_second"), ("decoder text", "scale"),
        ("decoder dbc", "tick"),
        ("decoder stim300", "rate"), ("decoder witmotion", "gyro_range"),
    ):  # fmt: skip
        assert expected in found


@pytest.mark.parametrize(
    "values", [FEW_TOML_VALUES, pytest.param(ALL_TOML_VALUES, marks=pytest.mark.attack)], ids=["few", "all"]
)
def test_configuration_keys(values: Sequence[str], tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    np.savez(tmp_path / "r.npz", fs=100.0, gz=np.zeros(10))
    for (text, key, name), value in itertools.product(list_numeric_keys(), values):
        for text_value in (value, f"{{ gz = {value} }}") if key in ("scale", "signals") else (value,):
            path.write_text(text.replace("{}", f"{key} = {text_value}"))
            path.chmod(0o600)
            wrong = loading.examine_config_file(path).wrong
            for line in wrong:
                assert "\n" not in line
                assert len(line) < 3000, (name, key, value[:60])


@pytest.mark.attack
def test_check_with_absurd_configuration_keys(tmp_path: Path) -> None:
    """The command ``check`` also builds the simulated sensors."""
    cases = []
    for i, ((text, key, _), value) in enumerate(itertools.product(list_numeric_keys(), FEW_TOML_VALUES)):
        path = tmp_path / f"{i}.toml"
        path.write_text(text.replace("{}", f"{key} = {value}"))
        path.chmod(0o600)
        cases.append(["check", str(path)])
    for result in run_in_child(cases, tmp_path):
        assert (result["uncaught"], result["warnings"]) == ("", []), result
        assert result["status"] in (0, 2)
        assert result["status"] == 0 or 1 <= result["err"].count("\n") <= 3, result


def test_every_numeric_key_has_a_number_range() -> None:
    """The type of every numeric key must contain the supported range, so no new key is forgotten."""
    lacking = []
    for _, kind, name in iter_config_tables():
        for key, field in fields_by_key(kind).items():
            if {int, float} & set(iter_leaf_types(field.annotation)) and not has_number_range(
                (field.annotation, field.metadata)
            ):
                lacking.append(f"{name}: {key}")
    # these keys are compared with a list, converted from a rate with a separate check, or passed to a library
    assert sorted(set(lacking)) == [
        *("decoder stim300: identifier", "device: publish", "device: refit"),
        *("link can: channel", "link serial: stopbits"),
    ]


def has_number_range(parts: Any) -> bool:
    """Return True if annotations contain a number range, also in a type that a keyword may replace."""
    if isinstance(parts, NumberRange):
        return True
    if isinstance(parts, KeywordOrType):
        return has_number_range(parts._kind)
    inner = parts if isinstance(parts, tuple | list) else (*get_args(parts), *getattr(parts, "__metadata__", ()))
    return any(has_number_range(part) for part in inner)


# --- parameters of models

PARAMETERS: Final = (
    *("0", "-1", "1e-300", "1e-30", "1e30", "1e300", "nan", "inf", "1e9", str((1 << 63) - 1), '"text"', "true"),
)
TEMPERATURE_KEYS: Final = {"mean": "20.0", "swing": "1.0", "period": "60.0", "wander": "1.0", "wander_time": "60.0"}
NOISE_EFFECT: Final = "[gz.angle_random_walk]\nN = 1e-3\n"
OTHER_EFFECTS: Final = "[ax.bias]\nvalue = 1.0\n[temperature]\nmean = 20.0\n"


def generate_models(values: Sequence[str]) -> Iterator[str]:
    """Yield models with one absurd number each."""
    assert set(TEMPERATURE_KEYS) == {f.name for f in fields(Temperature)}
    for value in values:
        yield f"sample_rate = {value}\n{NOISE_EFFECT}"
        for key in TEMPERATURE_KEYS:
            keys = format_assignments(TEMPERATURE_KEYS | {key: value})
            yield f"sample_rate = 100.0\n{NOISE_EFFECT}[temperature]\n{keys}"
        for effect in EFFECTS.values():
            given = {f.name: example_value(f.name) for f in fields(effect)}  # type: ignore[arg-type]
            for name in given:
                around = OTHER_EFFECTS if effect.name == "angle_random_walk" else OTHER_EFFECTS + NOISE_EFFECT
                yield f"sample_rate = 100.0\n{around}[gz.{effect.name}]\n{format_assignments(given | {name: value})}"


def format_assignments(table: Mapping[str, str]) -> str:
    return "".join(f"{name} = {value}\n" for name, value in table.items())


def example_value(parameter: str) -> str:
    return '"ax"' if parameter == "source" else "1.0"


def test_model_parameters_with_few_values() -> None:
    for text in generate_models(("1e300",)):
        try_model(text)


@pytest.mark.attack
def test_model_parameters_with_all_values() -> None:
    for text in generate_models(PARAMETERS):
        try_model(text)


def try_model(text: str) -> None:
    """Read a model, simulate it, and compute its Allan variance. Warnings are errors in tests."""
    try:
        model = NoiseModel.from_toml(text)
        rate_hz = model.sample_rate_hz or 100.0
        series = model.start_stream(rate_hz, 1).draw_next_samples(64)
    except ConfigError:
        return
    assert series.shape == (64, 6), text
    assert not np.isinf(series).any(), text
    avar = model.avar("gz", np.array([1.0, 64.0]) / rate_hz, 1.0 / rate_hz)
    assert not np.isinf(avar).any(), text


# --- recordings

STATED_RATES: Final = (
    0.0,
    -1.0,
    1e-300,
    1e-9,
    1e9,
    1e12,
    1e300,
    np.nan,
    np.inf,
    np.longdouble("1e4000"),
    np.float16(100),
    1 << 62,
)


def draw_columns(n: int = 400) -> dict[str, Any]:
    return {axis: np.random.default_rng(1).normal(size=n) for axis in AXES}


@pytest.mark.parametrize("fs", STATED_RATES, ids=str)
def test_stated_rate_of_a_recording(fs: Any, tmp_path: Path) -> None:
    path = tmp_path / "r.npz"
    np.savez(path, fs=fs, **draw_columns())
    is_answered(path, total_and_hadamard=True)


@pytest.mark.parametrize("step_s", [1e-300, 1e-12, 1e-9, 1e-7, 1e-6, 1e-5, 15.0, 900.0, 1e4, 1e7])
def test_time_stamps_of_a_recording(step_s: float, tmp_path: Path) -> None:
    path = tmp_path / "r.npz"
    np.savez(path, t=np.arange(400) * step_s, **draw_columns())
    answered = is_answered(path, total_and_hadamard=True)
    assert answered == (1e-6 <= step_s <= 900.0), step_s


@pytest.mark.parametrize(("outlier", "row"), [(-4.59e9, 198), (4.59e9, 0), (1e300, 399)])
def test_one_outlying_time_stamp(outlier: float, row: int, tmp_path: Path) -> None:
    try_outlier(1.7e9, row, outlier, tmp_path)


@pytest.mark.attack
def test_outlying_time_stamps_everywhere(tmp_path: Path) -> None:
    outliers = (4.59e9, -4.59e9, 0.0, 1e18, 1e300, np.nan)
    for t0, row, outlier in itertools.product((0.0, 1.7e9, -1e9), (0, 1, 200, 398, 399), outliers):
        try_outlier(t0, row, outlier, tmp_path)


def try_outlier(t0: float, row: int, outlier: float, tmp_path: Path) -> None:
    path, t = tmp_path / "r.npz", t0 + np.arange(400) / 100.0
    t[row] = outlier
    np.savez(path, t=t, **draw_columns())
    is_answered(path)
    is_answered(path, LoadingOptions(last_s=2.0))


@pytest.mark.parametrize("value", [np.longdouble("1e4000"), np.longdouble("-1e4000"), np.longdouble("nan")])
def test_column_of_long_doubles(value: Any, tmp_path: Path) -> None:
    path, data = tmp_path / "r.npz", draw_columns()
    data["gx"] = data["gx"].astype(np.longdouble)
    data["gx"][7] = value
    np.savez(path, fs=100.0, **data)
    found = load_samples(path)
    assert np.isnan(found.values[7, 0])
    assert np.isfinite(found.values[8, 0])
    assert is_answered(path)


@pytest.mark.parametrize("value", [1e30, 1e155, 1e300, 1e-300, 5e-324, -1e307])
@pytest.mark.attack
def test_absurd_samples(value: float, tmp_path: Path) -> None:
    path, data = tmp_path / "r.npz", draw_columns()
    data["gx"][100:110] = value
    data["gz"] = data["gz"] * value
    np.savez(path, fs=100.0, **data)
    is_answered(path, total_and_hadamard=True)


@pytest.mark.parametrize("last_s", [1e-6, 1e-3, 1e9])
def test_very_short_or_very_long_end_of_a_recording(last_s: float, tmp_path: Path) -> None:
    path = tmp_path / "r.npz"
    np.savez(path, t=np.arange(400) / 100.0, **draw_columns())
    assert len(load_samples(path, last_s=last_s)) == (400 if last_s > 1.0 else 1)


@pytest.mark.parametrize("rate_hz", [number_ranges.RATE_HZ.low, 20e3, number_ranges.RATE_HZ.high])
def test_every_supported_rate_is_answered(rate_hz: float, tmp_path: Path) -> None:
    """The rates are both ends of the range and that of a vibration sensor. Another test covers slow sensors."""
    path = tmp_path / "r.npz"
    np.savez(path, t=np.arange(2000) / rate_hz, **draw_columns(2000))
    found = analyze_recording(load_recording(path), total_and_hadamard=True, window_s=500.0 / rate_hz)
    assert found.analysis.estimate.rate_hz == pytest.approx(rate_hz, rel=1e-3)


def is_answered(path: Path, loading: LoadingOptions = DEFAULT_LOADING, **keys: Any) -> bool:
    """Return True if the analysis succeeds. Warnings are errors in tests."""
    try:
        analyze_recording(load_recording(path, loading), **keys)
    except ImuError:
        return False
    return True
