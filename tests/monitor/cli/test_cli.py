"""The program as its users meet it: exit status, one line for what is wrong, JSON, signals, pipes, open sockets."""

import contextlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import allantools
import numpy as np
import psutil
import pytest
import typer

from drivers.data_types import AXES
from drivers.recordings import save_samples
from monitor.cli import app, main, report_failed_thread
from monitor.common import topics
from monitor.common.shipped_config_paths import CONFIG_FOLDER
from monitor.noise.model_loading import read_model
from monitor.publishing.exporters import FORMATS
from monitor.publishing.messages.results import CoefficientsMessage
from monitor.publishing.zenoh.publisher import ZenohPublisher
from monitor.settings.loading import ZenohTable, load_config
from tests.monitor.publishing.made import estimate
from tests.support.ports import free_endpoint
from tests.support.waiting import FOREVER_S, PATIENCE_S, wait_for

PROGRAM = [sys.executable, "-m", "monitor.cli"]
COMMANDS = ("demo", "run", "check", "doctor", "watch", "analyze", "simulate", "reconcile", "export")
RATE_HZ = 100.0
DEVICE = '[[device]]\nname = "bench-1"\n'
VIRTUAL = DEVICE + 'driver = { link = "virtual" }\n'
CAN = DEVICE + 'driver = {{ link = "can", channel = "can0", decoder = "dbc", decoder_options = {} }}\n'
QUIET = '[zenoh]\nmode = "none"\n[viewer]\nmode = "none"\n'


MODEL = str(CONFIG_FOLDER / "models" / "consumer-mems.toml")


class Said:
    """What one run of the program left behind."""

    def __init__(self, status: int, out: str, err: str) -> None:
        self.status, self.out, self.err = status, out, err

    def only_line(self) -> str:
        """The one line on standard error; standard output is empty."""
        assert self.out == ""
        assert self.err.endswith("\n")
        assert self.err.count("\n") == 1, self.err
        assert "Traceback" not in self.err
        return self.err


Call = Callable[..., Said]


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], tmp_path: Path) -> Call:
    """The program in this process, in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str) -> Said:
        monkeypatch.setattr(sys, "argv", ["imu-monitor", *arguments])
        capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            main()
        out, err = capfd.readouterr()
        return Said(int(ended.value.code or 0), out, err)

    return run


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three minutes of the shipped model."""
    path = tmp_path_factory.mktemp("recording") / "static.csv"
    values = (
        read_model(CONFIG_FOLDER / "models" / "consumer-mems.toml").start_stream(RATE_HZ, 7).draw_next_samples(18_000)
    )
    save_samples(path, np.arange(len(values)) / RATE_HZ, values)
    return path


def program(*arguments: str, **more: Any) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [*PROGRAM, *arguments], capture_output=True, text=True, timeout=PATIENCE_S, check=False, **more
    )


def test_linear_algebra_keeps_to_one_thread_unless_told() -> None:
    """Threads of the program's own share the work; a user's own setting stays."""
    command = [sys.executable, "-c", "import monitor.cli, os; print(os.environ['OPENBLAS_NUM_THREADS'])"]
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    for given, seen in (({}, "1"), ({"OPENBLAS_NUM_THREADS": "3"}, "3")):
        done = subprocess.run(command, capture_output=True, text=True, env=environment | given, check=True)
        assert done.stdout.strip() == seen


# --- configuration files ---------------------------------------------------------------------------

WRONG_FILES = {
    "unknown key": (VIRTUAL + "windw = 10.0\n", 'windw: unknown key; did you mean "window"?'),
    "unknown table": (VIRTUAL + '[zeno]\nmode = "peer"\n', 'zeno: unknown key; did you mean "zenoh"?'),
    "wrong type": (VIRTUAL + 'rate = "fast"\n', "device bench-1: rate: expected a number from 0.001 Hz to 1 MHz"),
    "infinite rate": (VIRTUAL + "rate = inf\n", "inf Hz"),
    "one name twice": (VIRTUAL + VIRTUAL, '2 devices are named "bench-1"; names must be unique'),
    "name with a slash": (VIRTUAL.replace("bench-1", "a/b"), '"a/b"; letters, digits, - and _ are possible'),
    "no name": ('[[device]]\ndriver = { link = "virtual" }\n', "device[0].name: missing"),
    "no driver": (DEVICE, "device bench-1: driver: missing"),
    "no device": ("", "there is none; add [[device]]"),
    "not TOML": ("[[device\nname =", "not TOML: "),
    "not text": (b"\xff\xfe\x00", "cannot be read: "),
    "unknown protocol": (
        DEVICE + 'driver = { link = "virtual", decoder = "stim30" }\n',
        '"stim30"; possible are stim300',
    ),
    "protocol by number": (DEVICE + 'driver = { link = "virtual", decoder = 3 }\n', "driver.decoder: 3; possible are"),
    "unknown link": (DEVICE + 'driver = { link = "seral" }\n', 'driver.link: "seral"; possible are serial, '),
    "no link": (DEVICE + "driver = {}\n", "driver.link: missing; possible are can, replay, serial, virtual, zenoh"),
    "no protocol": (
        DEVICE + 'driver = { link = "serial", port = "/dev/x" }\n',
        "driver.decoder: missing; possible are",
    ),
    "no port": (DEVICE + 'driver = { link = "serial", decoder = "stim300" }\n', "driver.port: missing"),
    "protocol that does not fit": (
        DEVICE + 'driver = { link = "serial", port = "x", decoder = "ros2_imu" }\n',
        "ros2_imu reads messages, link serial provides bytes",
    ),
    "negative silence": (
        DEVICE + 'driver = { link = "virtual", silence = -1.0 }\n',
        "silence: -1 s is outside",
    ),
    "negative seed": (
        DEVICE + 'driver = { link = "virtual", seed = -1 }\n',
        "seed: -1 is outside",
    ),
    "unknown model": (
        DEVICE + 'driver = { link = "virtual", model = "x" }\n',
        'no model "x", neither a file nor one of those shipped',
    ),
    "DBC without the signal": (
        CAN.format('{ file = "canmod_gps", signals = { gx = "ImuData.Nope" } }'),
        'signals.gx: message ImuData has no signal "Nope"; known are ',
    ),
    "DBC without the message": (
        CAN.format('{ file = "canmod_gps", signals = { gx = "ImuDat.AngularRateX" } }'),
        'has no message "ImuDat"; did you mean "ImuData"?',
    ),
    "no such DBC": (
        CAN.format('{ file = "canmod_gp", signals = { gx = "ImuData.AngularRateX" } }'),
        'did you mean "canmod_gps"?',
    ),
    "bad unit": (VIRTUAL + 'window = "3 parsec"\n', '"3 parsec" is not a duration; write seconds, or "90s"'),
    "window too short": (VIRTUAL + "rate = 100.0\nwindow = 0.1\n", "are 10 samples; possible are 100 to 10000000"),
    "window too long": (VIRTUAL + 'rate = 100.0\nwindow = "2d"\n', "are 17280000 samples; possible are 100 to"),
    "window too long at any rate": (VIRTUAL + 'window = "1e9 s"\n', "1e+09 s; at most 3.456e+06 s"),
    "unknown grid of tau": (VIRTUAL + 'tau = "octav"\n', "device bench-1: tau: "),
    "negative tau": (
        VIRTUAL + "tau = [-1.0]\n",
        "device bench-1: tau[0]: -1 s is outside the supported range 1 µs to 36525 d",
    ),
    "empty tau": (VIRTUAL + "tau = []\n", "tau: none of [] s lies between one sample and 1800 s, half the window"),
    "tau beyond the window": (VIRTUAL + "window = 10.0\ntau = [1000.0]\n", "tau: none of [1000.0] s lies between"),
    "tau below a sample": (VIRTUAL + "rate = 100.0\ntau = [0.001]\n", "tau: none of [0.001] s lies between"),
    "bad rate of fits": (VIRTUAL + 'refit = "10 hz"\n', '"10 hz" is not a rate; write "10 Hz" or "every sample"'),
    "no rate of fits": (VIRTUAL + 'refit = "0 Hz"\n', '"0 Hz" is not a rate; write "10 Hz" or "every sample"'),
    "unknown axis": (
        VIRTUAL + 'axes = { gz = "-gw" }\n',
        'gz = "-gw": expected two axes of the same kind out of gx gy gz ax ay az',
    ),
    "bad viewer": (
        VIRTUAL + '[viewer]\nmode = "nativ"\n',
        'viewer.mode: "nativ"; possible are native, auto, none, web, or a file ending in .rrd',
    ),
    "bad port": (VIRTUAL + "[viewer]\nport = 99999\n", "viewer.port: 99999 is outside the supported range 0 to 65535"),
    "bad size": (VIRTUAL + '[viewer]\nmemory = "lots"\n', 'viewer.memory: "lots" is not a size; write "256MiB"'),
    "bad endpoint": (
        VIRTUAL + '[zenoh]\nlisten = ["7450"]\n',
        'zenoh.listen[0]: "7450" is not an endpoint; write "tcp/',
    ),
    "no zenoh file": (VIRTUAL + '[zenoh]\nconfig = "x.json5"\n', "x.json5: no such file"),
    "client of nobody": (VIRTUAL + '[zenoh]\nmode = "client"\n', "zenoh.connect: empty, but a client needs a router"),
    "bad log level": (VIRTUAL + '[log]\nlevel = "loud"\n', "log.level: "),
}


@pytest.mark.parametrize("case", WRONG_FILES)
def test_a_wrong_file_refuses_to_start_in_one_line(call: Call, case: str) -> None:
    text, words = WRONG_FILES[case]
    Path("c.toml").write_bytes(text if isinstance(text, bytes) else text.encode())
    for command in ("run", "check"):
        said = call(command, "c.toml")
        assert said.status == 2
        line = said.only_line()
        assert "c.toml: " in line
        assert words in line


def test_check_tells_all_that_is_wrong_and_run_the_first(call: Call) -> None:
    text = (
        '[[device]]\nname = "a"\nwindw = 1.0\ndriver = { link = "virtual" }\n[viewer]\nmode = "x"\n[log]\nlevel = 3\n'
    )
    Path("c.toml").write_text(text)
    said = call("check", "c.toml")
    assert said.status == 2
    assert said.out == ""
    assert [line.split(": ")[:2] for line in said.err.splitlines()] == [
        ["c.toml", key] for key in ("device a", "viewer.mode", "log.level")
    ]
    line = call("run", "c.toml").only_line()
    assert "windw" in line
    assert "(and 2 more: imu-monitor check c.toml)" in line


def test_a_file_for_the_view_is_beside_the_configuration(tmp_path: Path) -> None:
    """As every relative path in it."""
    (tmp_path / "c.toml").write_text(VIRTUAL + '[viewer]\nmode = "live.rrd"\n')
    assert load_config(tmp_path / "c.toml").viewer.mode == str(tmp_path / "live.rrd")


def test_check_reads_the_model_of_a_simulated_device_too(call: Call) -> None:
    Path("model.toml").write_text("sample_rate = 100.0\n[gz.angle_random_walk]\nM = 1.0\n")
    Path("c.toml").write_text(DEVICE + 'driver = { link = "virtual", model = "model.toml" }\n' + QUIET)
    for command in ("check", "run"):
        said = call(command, "c.toml")
        assert said.status == 2
        assert "model.toml" in said.only_line()


def test_check_tells_what_is_wrong_with_models_beside_all_else(call: Call) -> None:
    Path("model.toml").write_text("sample_rate = 100.0\n[gz.angle_random_walk]\nM = 1.0\n")
    limits = "".join(f'[[device.limit]]\naxes = "gz"\nletter = "{letter}"\ntimes_model = 2.0\n' for letter in "RK")
    effects = '["gz.sinusoidal:amplitude=1,frequency=60", "gz"]'
    Path("c.toml").write_text(
        f'[[device]]\nname = "a"\nwindw = 1\n'
        f'driver = {{ link = "virtual", model = "model.toml", effect = {effects} }}\n'
        f'[[device]]\nname = "b"\nmodel = "consumer-mems"\ndriver = {{ link = "sereal" }}\n{limits}'
        f'[[device]]\nname = "c"\nmodel = "model.toml"\n'
        f'driver = {{ link = "virtual", seed = -1, effect = {effects} }}\n[log]\nlevel = "loud"\n'
    )
    said = call("check", "c.toml")
    assert said.status == 2
    begins = [
        "device a: windw: unknown key",
        'device b: driver.link: "sereal"; possible are serial, ',
        "device c: driver.seed: ",
        'log.level: "loud"; possible are ',
        'device a: "gz" is not an effect',
        "device a: ",  # and the file of the model
        "device b: limit of R: times_model = 2, but the model in force has no R on gz",
        "device c: ",
        'device c: "gz" is not an effect',
        'device c: effect "gz.sinusoidal:amplitude=1,frequency=60": ',
    ]
    lines = said.err.splitlines()
    assert len(lines) == len(begins), lines
    for line, begin in zip(lines, begins, strict=True):
        assert line.startswith(f"c.toml: {begin}"), line
    assert sum("model.toml: " in line for line in lines) == 2


def test_check_reads_the_effects_of_a_simulated_device_too(call: Call) -> None:
    driver = '{ link = "virtual", effect = ["gz.sinusoidal:amplitude=1,frequency=60"] }'
    Path("c.toml").write_text(f"{DEVICE}driver = {driver}\n{QUIET}")
    for command in ("check", "run"):
        said = call(command, "c.toml")
        assert said.status == 2
        assert 'effect "gz.sinusoidal:amplitude=1,frequency=60": ' in said.only_line()


def test_check_holds_limits_against_the_model_too(call: Call) -> None:
    limit = '[[device.limit]]\naxes = "gz"\nletter = "R"\ntimes_model = 2.0\n'
    device = DEVICE + 'model = "consumer-mems"\n' + limit + '[device.driver]\nlink = "virtual"\n'
    Path("c.toml").write_text(device + QUIET)
    for command in ("check", "run"):
        said = call(command, "c.toml")
        assert said.status == 2
        assert "device bench-1: limit of R: times_model = 2, but the model in force has no R on gz" in said.only_line()


@pytest.mark.parametrize("name", sorted(path.name for path in CONFIG_FOLDER.glob("*.toml")))
def test_check_accepts_every_shipped_file(call: Call, recording: Path, name: str) -> None:
    shutil.copy(CONFIG_FOLDER / name, name)
    shutil.copy(recording, "recording.csv")  # the one that replay.toml names
    said = call("check", name)
    assert (said.status, said.err) == (0, "")
    assert "no mistakes" in said.out


def test_check_accepts_the_defaults_that_it_prints(call: Call) -> None:
    printed = call("check", "--print-defaults")
    assert (printed.status, printed.err) == (0, "")
    Path("defaults.toml").write_text(printed.out)
    said = call("check", "defaults.toml")
    assert (said.status, said.out, said.err) == (0, "defaults.toml: 1 device, no mistakes\n", "")


def test_check_prints_the_keys_of_one_link_and_one_decoder(call: Call) -> None:
    printed = call("check", "--print-defaults", "--link", "serial", "--decoder", "text")
    assert (printed.status, printed.err) == (0, "")
    assert 'link = "serial"' in printed.out
    assert "baudrate = 115200" in printed.out
    assert 'columns = ["gx", ' in printed.out
    assert "sentence" not in printed.out
    said = call("check", "--print-defaults", "--decoder", "tekst")
    assert said.status == 2
    assert '--decoder: "tekst"; possible are text, ' in said.only_line()
    assert call("check", "--decoder", "text").status == 2


def test_completion_lists_commands_and_options() -> None:
    for words, number, expected in (("imu-monitor an", 1, "analyze"), ("imu-monitor export --fo", 2, "--format")):
        variables = {"_IMU_MONITOR_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(number)}
        done = subprocess.run(
            [*PROGRAM], env=os.environ | variables, capture_output=True, text=True, timeout=PATIENCE_S, check=True
        )
        assert done.stdout.split() == [expected]


def test_the_version_is_that_of_the_package(call: Call) -> None:
    said = call("--version")
    assert (said.status, said.out, said.err) == (0, f"imu-monitor {metadata.version('imu-monitor')}\n", "")


# --- arguments -------------------------------------------------------------------------------------


def simulating(*arguments: str) -> tuple[str, ...]:
    """Of an option given twice the last counts."""
    return ("simulate", "--seconds", "1", "--out", "x.csv", *arguments)


def comparing(*arguments: str) -> tuple[str, ...]:
    return ("reconcile", "x.csv", "--out", "found", *arguments)


WRONG_ARGUMENTS = {
    "no command": ((), "Missing command"),
    "unknown command": (("analyse",), "No such command 'analyse'"),
    "unknown option": (("analyze", "x.csv", "--nope"), "No such option: --nope"),
    "missing argument": (("analyze",), "Missing argument 'RECORDING'"),
    "missing configuration": (("run",), "Missing argument 'CONFIG.toml'"),
    "nothing to check": (("check",), "--print-defaults"),
    "findings nowhere": (("doctor", "--json", "nowhere/x.json"), "--json: nowhere/x.json: cannot be written"),
    "missing file": (("run", "nowhere.toml"), "nowhere.toml: no such file"),
    "folder for a file": (("run", "."), ".: cannot be read"),
    "bad viewer": (("demo", "--viewer", "nativ"), '--viewer: "nativ"; possible are native, auto, '),
    "bad seconds": (("demo", "--seconds", "soon"), "Invalid value for '--seconds'"),
    "no seconds": (("demo", "--seconds", "0"), "--seconds: 0 s is outside the supported range"),
    "bad endpoint": (
        ("watch", "--connect", "7450"),
        'connect "7450": not a valid endpoint; an example is tcp/127.0.0.1:7450',
    ),
    "bad key": (("watch", "##", "--connect", "tcp/127.0.0.1:9"), 'key expression "##"'),
    "bad rate": (("analyze", "x.csv", "--rate", "-1"), "--rate: -1 Hz is outside the supported range"),
    "no rate": (("analyze", "x.csv", "--rate", "nan"), "--rate"),
    "bad tau": (("analyze", "x.csv", "--tau", "octav"), '--tau: "octav"; possible are octave, decade10, or seconds'),
    "negative tau": (("analyze", "x.csv", "--tau", "1,-2"), "--tau: -2 s is outside the supported range"),
    "bad picture": (("analyze", "x.csv", "--plot", "x.pdf"), "--plot: x.pdf: a name ending in .png or .html is needed"),
    "bad window": (
        ("analyze", "x.csv", "--window", "soon"),
        '--window: "soon" is not a duration; write seconds, or "90s"',
    ),
    "no window": (("analyze", "x.csv", "--window", "0"), '--window: "0" is not a duration'),
    "infinite rate": (("analyze", "x.csv", "--rate", "inf"), "--rate: inf Hz is outside the supported range"),
    "unknown units": (("analyze", "x.csv", "--units", "cgs"), '--units: "cgs"; possible are imu, datasheet, si'),
    "no format": (("export", "x.toml"), "Missing option '--format'"),
    "unknown format": (("export", MODEL, "--format", "rovio"), 'unknown format "rovio"; possible are kalibr,'),
    "no source": (
        ("export", "x.toml", "--format", "kalibr"),
        'no model "x.toml", neither a file nor one of those shipped',
    ),
    "folder for a source": (("export", ".", "--format", "kalibr"), 'no model ".", neither a file nor one of those'),
    "nothing to export": (("export", "--format", "kalibr"), "give either a model or the JSON of analyze, or --connect"),
    "two sources": (
        ("export", MODEL, "--format", "kalibr", "--connect", "tcp/127.0.0.1:1"),
        "give either a model or the JSON of analyze, or --connect",
    ),
    "deflation": (
        ("export", MODEL, "--format", "kalibr", "--inflation", "0.5"),
        "--inflation: 0.5 is outside the supported range",
    ),
    "other's option": (
        ("export", MODEL, "--format", "kalibr", "--dt", "0.01"),
        "--dt: is an option of vins_fusion, fast_lio, px4_ekf2, ardupilot_ekf3, robot_localization, imu_utils, kalman, "
        "not of kalibr",
    ),
    "other's time": (
        ("export", MODEL, "--format", "gyroparams", "--correlation-time", "9"),
        "--correlation-time: is an option of gnss_ins_sim, kalman, not of gyroparams",
    ),
    "other's topic": (
        ("export", MODEL, "--format", "kalman", "--rostopic", "/imu"),
        "--rostopic: is an option of kalibr, allan_variance_ros, openvins, not of kalman",
    ),
    "no time step": (("export", MODEL, "--format", "kalman", "--dt", "0"), "--dt: 0 s is outside the supported range"),
    "nowhere to write": (
        ("export", MODEL, "--format", "kalibr", "--out", "nowhere/x.yaml"),
        "--out: nowhere/x.yaml: cannot be written",
    ),
    "no sensor": (("demo", "--sensor", "consumer-mem"), '--sensor: no model "consumer-mem"'),
    "no such effect": (("demo", "--effect", "gz.sinusodal:amplitude=1"), 'did you mean "sinusoidal"?'),
    "no effect": (("demo", "--effect", "vibration"), '--effect: "vibration" is not an effect; write axis.effect:'),
    "effect too fast": (("demo", "--effect", "gz.sinusoidal:amplitude=1,frequency=60"), "below 50 Hz"),
    "bad time of an effect": (("demo", "--effect-at", "soon"), '--effect-at: "soon" is not a duration'),
    "no model": (simulating("nothing.toml"), 'no model "nothing.toml", neither a file nor one of those shipped'),
    "nearest model": (simulating("consumer-mem"), 'did you mean "consumer-mems"?'),
    "no length": (simulating("consumer-mems", "--seconds", "0"), '--seconds: "0" is not a duration'),
    "length in words": (simulating("consumer-mems", "--seconds", "soon"), '--seconds: "soon" is not a duration'),
    "no rate of samples": (simulating("consumer-mems", "--rate", "0"), "--rate: 0 Hz is outside the supported range"),
    "negative seed": (simulating("consumer-mems", "--seed", "-1"), "--seed: -1 is outside the supported range"),
    "nothing to write": (("simulate", "consumer-mems", "--seconds", "1"), "Missing option '--out'"),
    "unknown form": (simulating("consumer-mems", "--out", "x.mat"), "x.mat: the suffix is not that of a recording"),
    "nowhere to write it": (simulating("consumer-mems", "--out", "nowhere/x.csv"), "there is no folder nowhere"),
    "nowhere to say it": (simulating("consumer-mems", "--json", "nowhere/x.json"), "--json: nowhere/x.json: cannot be"),
    "folder to write": (simulating("consumer-mems", "--out", ".csv/../.csv"), "cannot be written"),
    "no temperature": (
        simulating("consumer-mems", "--temperature-from", "nowhere.csv"),
        "nowhere.csv: cannot be read: No such file or directory",
    ),
    "nowhere to leave it": (("reconcile", "x.csv"), "Missing option '--out'"),
    "nothing to compare": (("reconcile", "--out", "x"), "Missing argument 'RECORDING"),
    "no rate to compare at": (comparing("--rate", "0"), "--rate: 0 Hz is outside the supported range"),
    "infinite rate to compare at": (comparing("--rate", "inf"), "--rate: inf Hz is outside the supported range"),
    "negative seed to compare by": (comparing("--seed", "-1"), "--seed: -1 is outside the supported range"),
    "no model to compare with": (comparing("--model", "nothing.toml"), 'no model "nothing.toml", neither a file nor'),
    "nearest model to compare with": (comparing("--model", "consumer-mem"), 'did you mean "consumer-mems"?'),
    "nowhere to say what differs": (comparing("--json", "nowhere/x.json"), "--json: nowhere/x.json: cannot be"),
    "no recording": (("analyze", "nowhere.csv"), "nowhere.csv: cannot be read: No such file or directory"),
}


@pytest.mark.parametrize("case", WRONG_ARGUMENTS)
def test_a_wrong_argument_is_one_line(call: Call, case: str) -> None:
    arguments, words = WRONG_ARGUMENTS[case]
    said = call(*arguments)
    assert said.status == 2
    assert words in said.only_line()
    assert not list(Path().iterdir())


def test_help_of_every_command_is_quick() -> None:
    """None of the heavy libraries is loaded for it."""
    source = f"""
import sys
import threading
from monitor.cli import main
for command in ([], *([name] for name in {COMMANDS!r})):
    sys.argv = ["imu-monitor", *command, "--help"]
    try:
        main()
    except SystemExit as ended:
        print("status", ended.code)
heavy = {{"numpy", "scipy", "numba", "rerun", "zenoh", "can", "matplotlib", "pyarrow"}}
print("heavy", sorted(heavy & sys.modules.keys()))
"""
    done = subprocess.run(
        [sys.executable, "-c", source], capture_output=True, text=True, timeout=PATIENCE_S, check=True
    )
    assert done.stdout.count("status 0\n") == 1 + len(COMMANDS)
    assert done.stdout.count("--help") >= 1 + len(COMMANDS)
    assert done.stdout.endswith("heavy []\n")


# --- simulate --------------------------------------------------------------------------------------

WRONG_MODELS = {
    "unknown effect": (
        "[gz.sinusodal]\namplitude = 1.0\n",
        'gz: unknown effect "sinusodal"; did you mean "sinusoidal"?',
    ),
    "unknown axis": ("[gw.bias]\nvalue = 1.0\n", 'unknown axis "gw"'),
    "missing parameter": ("[gz.sinusoidal]\namplitude = 1.0\n", "gz.sinusoidal: frequency is missing"),
    "negative parameter": ("[gz.angle_random_walk]\nN = -1.0\n", "gz.angle_random_walk: N must"),
    "above Nyquist": (
        "[gz.sinusoidal]\namplitude = 1.0\nfrequency = 99.0\n",
        "gz.sinusoidal: frequency must be below 50",
    ),
    "no source axis": ("[gz.g_sensitivity]\ncoefficient = 1.0\n", "gz.g_sensitivity: source is missing"),
    "source without effects": (
        '[gz.g_sensitivity]\nsource = "ax"\ncoefficient = 1.0\n',
        "gz.g_sensitivity: the model has no effect on its source ax",
    ),
    "two clocks": (
        "[gx.sample_rate_error]\nratio = 1.01\n[gz.sample_rate_error]\nratio = 1.02\n",
        "sample_rate_error: a recording has one clock",
    ),
    "no temperature": (
        "[gz.temperature_bias]\ncoefficient = 1.0\nreference = 25.0\n",
        "gz.temperature_bias: no temperature",
    ),
    "unknown key": ("sample_rat = 100.0\n", 'unknown key "sample_rat"; did you mean "sample_rate"?'),
    "unknown table": ("[temprature]\nmean = 25.0\n", 'unknown axis "temprature"; did you mean "temperature"?'),
    "no axis": ("", "the model has no axis"),
    "no TOML": ("[gz", "not TOML"),
}


@pytest.mark.parametrize("case", WRONG_MODELS)
def test_a_wrong_model_is_one_line_and_nothing_is_written(call: Call, case: str) -> None:
    text, words = WRONG_MODELS[case]
    Path("m.toml").write_text("sample_rate = 100.0\n" + text)
    said = call("simulate", "m.toml", "--seconds", "1", "--out", "x.csv", "--truth", "--json", "x.json")
    assert said.status == 2
    line = said.only_line()
    assert "m.toml: " in line
    assert words in line
    assert [path.name for path in Path().iterdir()] == ["m.toml"]


@pytest.mark.parametrize("option", ["--json", "--temperature-from"])
def test_what_is_written_is_no_other_file_of_the_command(call: Call, option: str) -> None:
    Path("x.csv").write_text("t,gz\n")
    same = f"../{Path.cwd().name}/x.csv"
    said = call("simulate", "consumer-mems", "--seconds", "1", "--out", "x.csv", option, same)
    assert said.status == 2
    assert f"{option}: " in said.only_line()
    assert Path("x.csv").read_text() == "t,gz\n"


def test_a_path_to_no_model_names_those_that_there_are(call: Call) -> None:
    said = call("simulate", "no/where.toml", "--seconds", "1", "--out", "x.csv")
    assert said.status == 2
    assert "known are adis16405, " in said.only_line()


def test_a_model_without_a_rate_asks_for_one(call: Call) -> None:
    Path("m.toml").write_text("[gz.angle_random_walk]\nN = 1e-3\n")
    said = call("simulate", "m.toml", "--seconds", "1min", "--out", "x.csv")
    assert said.status == 2
    assert "m.toml: the model has no sample_rate; set the rate with --rate HZ" in said.only_line()
    said = call(
        "simulate", "m.toml", "--seconds", "1min", "--out", "x.csv", "--rate", "20", "--seed", "5", "--json", "-"
    )
    assert (said.status, said.err) == (0, "")
    assert json.loads(said.out) == {
        "schema": "imu-monitor/simulate/1",
        "out": "x.csv",
        "samples": 1200,
        "rate": 20.0,
        "seconds": 60.0,
        "seed": 5,
        "axes": ["gz"],
        "temperature": False,
        "truth": None,
    }
    assert len(Path("x.csv").read_text().splitlines()) == 1201


@pytest.mark.long
def test_what_was_simulated_is_analyzed(call: Call) -> None:
    said = call("simulate", "consumer-mems", "--seconds", "3min", "--out", "x.parquet", "--truth")
    assert (said.status, said.err) == (0, "")
    assert said.out == (
        "x.parquet: 18000 samples at 100 Hz, 180 s, seed 1: gx gy gz ax ay az; truth in x.parquet.truth.json\n"
    )
    said = call("analyze", "x.parquet", "--json", "-")
    assert said.status == 0
    noise = json.loads(said.out)["axes"]["gz"]["coefficients"]["N"]
    assert noise["lo"] <= 1.5e-4 <= noise["hi"]


@pytest.mark.long
def test_the_end_of_a_recording_alone(call: Call, recording: Path) -> None:
    said = call("analyze", str(recording), "--last", "1min", "--json", "-")
    assert said.status == 0
    found = json.loads(said.out)
    assert found["samples"] == 6000
    assert "Only the last 60 s are used, 6000 samples." in found["notes"]
    said = call("reconcile", str(recording), "--last", "never", "--out", "r")
    assert (said.status, said.err.count("\n")) == (2, 1)
    assert "--last: " in said.err
    said = call("compensate", str(recording), "--last", "20s", "--out", "x.npz", "--json", "-")
    with np.load("x.npz") as found:
        assert len(found["gx"]) == 2000


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("suffix", [".csv", ".npz"])
def test_a_simulation_that_is_broken_off_leaves_nothing(tmp_path: Path, number: int, suffix: str) -> None:
    arguments = ["simulate", "consumer-mems", "--seconds", "40d", "--out", f"x{suffix}", "--truth"]
    process = subprocess.Popen([*PROGRAM, *arguments], cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    try:
        wait_for(lambda: process.poll() is not None or growing(process.pid, tmp_path), "a file that grows")
        assert process.poll() is None
        process.send_signal(number)
        _, err = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
    assert process.returncode == 128 + number
    assert err == ("imu-monitor: interrupted\n" if number == signal.SIGINT else "")
    assert list(tmp_path.iterdir()) == []


def growing(pid: int, folder: Path) -> bool:
    """Whether the process holds a file in that folder, named or not, into which it has written."""
    for opened in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(OSError):
            if os.readlink(opened).startswith(str(folder)) and opened.stat().st_size > 100_000:
                return True
    return False


# --- analyze ---------------------------------------------------------------------------------------


@pytest.mark.long
def test_json_on_standard_output_is_all_there_is(call: Call, recording: Path) -> None:
    said = call("analyze", str(recording), "--json", "-")
    assert (said.status, said.err) == (0, "")
    result = json.loads(said.out)
    assert {"schema", "rate", "samples", "seconds", "notes", "axes"} <= result.keys()
    assert result["schema"] == "imu-monitor/analyze/1"
    assert (result["rate"], result["samples"], result["seconds"]) == (RATE_HZ, 18_000, 180.0)
    assert all("K or R" in note for note in result["notes"])
    assert list(result["axes"]) == list(AXES)
    assert (result["motions"], result["changes"]) == ([], [])
    assert "dynamic" not in result
    for table in result["axes"].values():
        assert table.keys() == {"allan", "total", "hadamard", "coefficients", "bandwidth"}
        for name in ("allan", "total", "hadamard"):
            assert table[name].keys() == {"tau", "deviation", "lo", "hi"}
            assert len({len(column) for column in table[name].values()}) == 1
        assert table["total"]["tau"][-1] > 90.0  # beyond half the recording
        assert list(table["coefficients"]) == list("QNBKR")
        for one in table["coefficients"].values():
            assert one.keys() - {"or"} == {"value", "lo", "hi", "status"}
            assert one["status"] in ("estimated", "upper_bound", "unestimated")
            assert (one["value"] is None) == (one["status"] != "estimated")
        allan = {name: np.array(column) for name, column in table["allan"].items()}
        assert (allan["lo"] < allan["deviation"]).all()
        assert (allan["deviation"] < allan["hi"]).all()
        assert table["coefficients"]["N"]["status"] == "estimated"


@pytest.mark.long
@pytest.mark.parametrize("grid", ["octave", "decade10", "0.01,0.05,0.5,5,50"])
def test_deviations_are_those_of_allantools(call: Call, recording: Path, grid: str) -> None:
    said = call("analyze", str(recording), "--json", "x.json", "--tau", grid)
    assert said.status == 0
    result = json.loads(Path("x.json").read_bytes())
    columns = np.loadtxt(recording, delimiter=",", skiprows=1).T[1:]
    for axis, column in zip(AXES, columns, strict=True):
        allan = result["axes"][axis]["allan"]
        tau, deviation, _, _ = allantools.oadev(column, rate=RATE_HZ, data_type="freq", taus=allan["tau"])
        np.testing.assert_allclose(allan["tau"], tau, rtol=1e-12)
        np.testing.assert_allclose(allan["deviation"], deviation, rtol=1e-9)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("x.csv", b"", "x.csv: the file is empty"),
        ("x.csv", b"t,gx\n", "x.csv: has a header line but no complete line of samples"),
        (
            "x.csv",
            b"gx\n" + b"0.1\n" * 100,
            "x.csv: has neither t nor fs, so its rate is not known; give it with --rate",
        ),
        ("x.csv", b"t,speed\n" + b"0.1,1\n" * 100, "x.csv: no axis among its columns"),
        ("x.csv", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + bytes(range(256)) * 9, "x.csv: no axis among its columns"),
        ("x.npz", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + bytes(range(256)) * 9, "x.npz: is no .npz file"),
        ("x.csv.gz", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + bytes(range(256)) * 9, "x.csv.gz: "),
        ("x.png", b"\x89PNG\r\n\x1a\n", "x.png: the suffix is not that of a recording; known are .csv"),
    ],
)
def test_what_is_no_recording_is_said_in_one_line(call: Call, name: str, content: bytes, words: str) -> None:
    Path(name).write_bytes(content)
    said = call("analyze", name, "--json", "x.json")
    assert said.status == 2
    assert words in said.only_line()
    assert not Path("x.json").exists()


def test_a_folder_without_recordings(call: Call) -> None:
    said = call("analyze", ".")
    assert said.status == 2
    assert "no recordings in this folder" in said.only_line()


def test_a_rate_makes_a_recording_without_times_readable(call: Call) -> None:
    Path("x.csv").write_text("gx\n" + "0.1\n0.2\n0.4\n" * 40)
    said = call("analyze", "x.csv", "--rate", "50", "--json", "-")
    assert said.status == 0
    assert json.loads(said.out)["seconds"] == 120 / 50


@pytest.mark.long
def test_a_file_cut_off_in_the_middle_is_read_up_to_the_cut(call: Call, recording: Path) -> None:
    whole = recording.read_bytes()
    at = whole.index(b"\n", len(whole) // 2) + 20  # inside a line
    Path("cut.csv").write_bytes(whole[:at])
    said = call("analyze", "cut.csv", "--json", "-")
    assert said.status == 0
    result = json.loads(said.out)
    assert result["samples"] == whole[:at].count(b"\n") - 1
    assert any("cut off" in note for note in result["notes"])
    shown = call("analyze", "cut.csv")
    assert shown.status == 0
    assert "cut off" in shown.out


@pytest.mark.parametrize("target", ["-", "why.json"])
def test_too_short_a_recording_is_an_answer_too(call: Call, target: str) -> None:
    Path("x.csv").write_text("t,gx\n" + "".join(f"{i / 100},{i % 3}\n" for i in range(20)))
    said = call("analyze", "x.csv", "--json", target)
    assert said.status == 3
    assert said.err.count("\n") == 1
    assert "20 samples; at least 50 are needed" in said.err
    result = json.loads(said.out if target == "-" else Path(target).read_bytes())
    assert result["schema"] == "imu-monitor/analyze/1"
    assert (result["samples"], result["axes"]) == (20, {})
    assert "at least 50 are needed" in result["notes"][0]


@pytest.mark.long
@pytest.mark.parametrize("option", ["--json", "--plot"])
def test_a_result_that_cannot_be_written_is_one_line(call: Call, recording: Path, option: str) -> None:
    Path("file").touch()
    for target in ("nowhere/x.png", "file/x.png"):
        said = call("analyze", str(recording), option, target)
        assert said.status == 2
        assert target in said.only_line()


def test_total_and_hadamard_deviations_are_those_of_allantools(call: Call, recording: Path) -> None:
    """Hadamard's as they are; total is corrected for its bias, which is small at a thirtieth of the recording."""
    assert call("analyze", str(recording), "--json", "x.json", "--tau", "0.05,0.1,0.5,1,2,5").status == 0
    result = json.loads(Path("x.json").read_bytes())
    columns = np.loadtxt(recording, delimiter=",", skiprows=1).T[1:]
    for axis, column in zip(AXES, columns, strict=True):
        table = result["axes"][axis]
        _, hadamard, _, _ = allantools.ohdev(column, rate=RATE_HZ, data_type="freq", taus=table["total"]["tau"])
        np.testing.assert_allclose(table["hadamard"]["deviation"], hadamard, rtol=1e-9)
        _, total, _, _ = allantools.totdev(column, rate=RATE_HZ, data_type="freq", taus=table["total"]["tau"])
        np.testing.assert_allclose(table["total"]["deviation"], total, rtol=0.01)


@pytest.mark.long
@pytest.mark.parametrize("window", ["60", "1min"])
def test_a_window_gives_curves_over_time(call: Call, recording: Path, window: str) -> None:
    said = call("analyze", str(recording), "--window", window, "--json", "-")
    assert (said.status, said.err) == (0, "")
    found = json.loads(said.out)["dynamic"]
    assert found["window"] == 60.0
    assert (found["t"][0], found["t"][-1], len(found["t"])) == (60.0, 180.0, 41)
    n = found["axes"]["gx"]["coefficients"]["N"]
    whole = json.loads(said.out)["axes"]["gx"]["coefficients"]["N"]["value"]
    assert n["value"] == pytest.approx([whole] * 41, rel=0.1)


@pytest.mark.long
def test_a_window_longer_than_the_recording_is_an_answer_too(call: Call, recording: Path) -> None:
    said = call("analyze", str(recording), "--window", "1h", "--json", "x.json")
    assert said.status == 3
    assert said.err == "imu-monitor: no dynamic curves: 180 s are recorded, less than the window of 3600 s\n"
    assert "N °/√h" in said.out
    result = json.loads(Path("x.json").read_bytes())
    assert result["axes"]["gx"]["coefficients"]["N"]["status"] == "estimated"
    assert "dynamic" not in result
    assert "no dynamic curves: 180 s are recorded, less than the window of 3600 s" in result["notes"]


def test_a_window_of_too_few_samples_is_wrong(call: Call, recording: Path) -> None:
    said = call("analyze", str(recording), "--window", "0.1")
    assert said.status == 2
    assert "window of 0.1 s: 10 samples at 100 Hz; possible are 1 to" in said.only_line()


@pytest.mark.long
@pytest.mark.parametrize("name", ["x.png", "x.html"])
def test_a_plot_is_what_its_name_says(call: Call, recording: Path, name: str) -> None:
    pytest.importorskip("matplotlib")
    pytest.importorskip("jinja2")
    said = call("analyze", str(recording), "--plot", name)
    assert said.status == 0
    assert "N °/√h" in said.out
    start = Path(name).read_bytes()[:15]
    assert start.startswith(b"\x89PNG" if name == "x.png" else b"<!DOCTYPE html>")


@pytest.mark.long
def test_motion_is_told_and_struck_out_on_demand(call: Call, recording: Path) -> None:
    columns = np.loadtxt(recording, delimiter=",", skiprows=1)
    columns[9000:9300, 1] += np.sin(np.arange(300) / 20)
    save_samples(Path("moved.csv"), columns[:, 0], columns[:, 1:])
    left, struck = (json.loads(call("analyze", "moved.csv", *more, "--json", "-").out) for more in ((), ("--rest",)))
    [motion] = left["motions"]
    assert (motion["axis"], struck["motions"]) == ("gx", [motion])
    assert motion["t"] == pytest.approx(89.75, abs=0.3)
    assert "the sensor moved once, 3 s in all: not removed; --rest removes the samples in motion" in left["notes"]
    assert "the sensor moved once, 3 s in all: removed" in struck["notes"]
    n = [one["axes"]["gx"]["coefficients"]["N"]["value"] for one in (left, struck)]
    whole = json.loads(call("analyze", str(recording), "--json", "-").out)["axes"]["gx"]["coefficients"]["N"]["value"]
    assert n[1] == pytest.approx(whole, rel=0.03)
    assert n[0] is None or n[0] > 1.5 * whole


# --- export ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("kalibr", "--rostopic", "/imu7"), ["rostopic: /imu7", "gyroscope_noise_density: 1.500000e-04"]),
        (
            ("kalibr", "--inflation", "2"),
            ["gyroscope_noise_density: 3.000000e-04", "N, B and K are 2 times"],
        ),
        (("gyroparams",), ["gyroparams(", "accelparams("]),
        (("kalman",), ["dt = 0.01 ", "[gz]", "psd_white = 2.250000e-08"]),
        (("kalman", "--dt", "0.5", "--correlation-time", "60"), ["dt = 0.5 ", "correlation_time = 6.000000e+01"]),
    ],
)
def test_a_model_is_exported(call: Call, arguments: tuple[str, ...], words: list[str]) -> None:
    said = call("export", MODEL, "--format", *arguments)
    assert (said.status, said.err) == (0, "")
    assert "source: consumer-mems.toml" in said.out
    for word in words:
        assert word in said.out
    assert call("export", MODEL, "--format", *arguments, "--out", "x").out == ""
    assert Path("x").read_text() == said.out


def test_the_name_of_a_shipped_model_is_exported_like_its_file(call: Call) -> None:
    for form in FORMATS:
        named, file = (call("export", source, "--format", form) for source in ("consumer-mems", MODEL))
        assert (named.status, named.err) == (0, "")
        assert named.out == file.out


def test_the_help_lists_every_format() -> None:
    command = typer.main.get_command(app).commands["export"]  # type: ignore[attr-defined]
    [option] = [one for one in command.params if "--format" in one.opts]
    assert option.metavar == "|".join(FORMATS)


def test_the_present_result_of_a_daemon_is_exported(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    endpoint, message = free_endpoint(), CoefficientsMessage.from_result("bench-1", 1.76e9, 0, estimate()).encode()
    Path("x.json").write_bytes(message)
    there = call("export", "x.json", "--format", "robot_localization")
    publisher = ZenohPublisher(ZenohTable(listen=(endpoint,)), ["bench-1", "bench-2"])
    publisher.start()
    try:
        wait_for(lambda: publisher.state == "ok")
        publisher.put(topics.COEFFICIENTS, "bench-1", message)
        asked = ("export", "--format", "robot_localization", "--connect", endpoint)
        only, named = call(*asked), call(*asked, "--device", "bench-1")
        publisher.put(topics.COEFFICIENTS, "bench-2", message)
        several = call(*asked)
        monkeypatch.setattr("monitor.publishing.zenoh.coefficients_client.PATIENCE_S", 1.0)
        absent = call(*asked, "--device", "bench-3")
    finally:
        publisher.close()
    assert (there.status, there.err) == (0, "")
    assert "# source: device bench-1, live\n" in only.out
    assert only.out.replace("device bench-1, live", "x.json") == there.out
    assert named.out == only.out
    assert (several.status, absent.status) == (2, 1)
    assert "result of 2 devices; choose one with --device: bench-1, bench-2" in several.only_line()
    assert "no coefficients of bench-3 in 1 s (ok)" in absent.only_line()


@pytest.mark.long
def test_what_analyze_wrote_is_exported(call: Call, recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert call("analyze", str(recording), "--json", "x.json").status == 0
    found = json.loads(Path("x.json").read_bytes())["axes"]
    said = call("export", "x.json", "--format", "kalibr")
    assert (said.status, said.err) == (0, "")
    worst = max(found[axis]["coefficients"]["N"]["value"] for axis in ("gx", "gy", "gz"))
    assert f"gyroscope_noise_density: {worst:.6e}" in said.out
    with Path("x.json").open() as piped:
        monkeypatch.setattr(sys, "stdin", piped)
        assert call("export", "-", "--format", "kalibr").out == said.out.replace("source: x.json", "source: -")


def test_too_short_a_recording_exports_nothing(call: Call) -> None:
    Path("x.csv").write_text("t,gx\n" + "".join(f"{i / 100},{i % 3}\n" for i in range(20)))
    assert call("analyze", "x.csv", "--json", "x.json").status == 3
    said = call("export", "x.json", "--format", "kalibr")
    assert said.status == 3
    assert "nothing to export: no axis has any of Q, N, B, K, R: a longer recording is needed" in said.only_line()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "nothing to export"),
        (b"[gz", "x: not TOML: "),
        (b"\xff\xfe", "x: cannot be read: "),
        (b"{", "x: not the JSON of an analysis: "),
        (b'{"schema": "imu-monitor/status/1", "axes": {}}', 'x: schema "imu-monitor/status/1"; an export needs'),
    ],
)
def test_what_cannot_be_exported_is_said_in_one_line(call: Call, content: bytes, words: str) -> None:
    Path("x").write_bytes(content)
    said = call("export", "x", "--format", "kalibr")
    assert said.status == 2
    assert words in said.only_line()


# --- reconcile -------------------------------------------------------------------------------------

GYROS = "".join(f"[{axis}.angle_random_walk]\nN = 1.0e-4\n" for axis in AXES[:3])


@pytest.fixture(scope="session")
def hidden_line(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two minutes of three gyroscopes, a line of 17.3 Hz on one of them; ``model.toml`` beside it does not know."""
    folder = tmp_path_factory.mktemp("hidden")
    n = 12_000
    values = 1e-3 * np.random.default_rng(3).standard_normal((n, 3))
    values[:, 2] += 3e-4 * np.sin(2.0 * np.pi * 17.3 * np.arange(n) / RATE_HZ)
    np.savez(folder / "bench.npz", fs=RATE_HZ, **dict(zip(AXES[:3], values.T, strict=True)))
    (folder / "model.toml").write_text(GYROS)
    return folder / "bench.npz"


@pytest.mark.long
def test_what_is_missing_is_named_and_written_down(call: Call, hidden_line: Path) -> None:
    model = str(hidden_line.with_name("model.toml"))
    said = call("reconcile", str(hidden_line), "--model", model, "--out", "found", "--seed", "4")
    assert (said.status, said.err) == (0, "")
    assert re.search(r"Line at 17\.3 Hz", said.out)
    report = json.loads(Path("found/report.json").read_bytes())
    assert (report["verdict"], report["seed"]) == ("explained", 4)
    assert [step["effect"] for step in report["axes"]["gz"]["steps"]] == ["sinusoidal"]
    assert report["axes"]["gx"]["steps"] == []
    assert re.search(r"17\.(29|30)", Path("found/report.html").read_text("utf-8"))
    again = call("reconcile", str(hidden_line), "--model", "found/model.toml", "--out", "again", "--json", "-")
    assert (again.status, again.err) == (0, "")
    assert json.loads(again.out)["verdict"] == "agrees"
    assert json.loads(again.out) == json.loads(Path("again/report.json").read_bytes())


def test_what_is_no_recording_is_compared_with_nothing(call: Call) -> None:
    said = call("reconcile", "nowhere.csv", "--out", "found")
    assert said.status == 2
    assert "nowhere.csv: cannot be read: No such file or directory" in said.only_line()
    Path("x.csv").write_bytes(b"t,speed\n" + b"0.1,1\n" * 100)
    said = call("reconcile", "x.csv", "--out", "found")
    assert said.status == 2
    assert "x.csv: no axis among its columns" in said.only_line()
    assert not list(Path().glob("found/*"))


def test_a_wrong_model_is_compared_with_nothing(call: Call, hidden_line: Path) -> None:
    Path("m.toml").write_text("[gz.sinusodal]\namplitude = 1.0\n")
    said = call("reconcile", str(hidden_line), "--model", "m.toml", "--out", "found")
    assert said.status == 2
    assert 'did you mean "sinusoidal"?' in said.only_line()
    assert not Path("found").exists()


def test_a_folder_that_cannot_be_made_is_one_line(call: Call, hidden_line: Path) -> None:
    Path("file").touch()
    for place in ("file", "file/found"):
        said = call("reconcile", str(hidden_line), "--out", place)
        assert said.status == 2
        assert f"--out: {place}: cannot be" in said.only_line()


@pytest.mark.parametrize("target", ["-", "why.json"])
def test_too_short_a_recording_is_an_answer_of_the_comparison_too(call: Call, target: str) -> None:
    rows = np.random.default_rng(1).standard_normal(500)
    Path("x.csv").write_text("t,gx\n" + "".join(f"{i / 100},{x}\n" for i, x in enumerate(rows)))
    said = call("reconcile", "x.csv", "--out", "found", "--json", target)
    assert said.status == 3
    assert said.err.count("\n") == 1
    assert "500 samples; " in said.err
    assert [path.name for path in Path("found").iterdir()] == ["report.json"]
    for text in (Path("found/report.json").read_bytes(), said.out if target == "-" else Path(target).read_bytes()):
        report = json.loads(text)
        assert report["schema"] == "imu-monitor/reconcile/1"
        assert report["verdict"] is None
        assert "500 samples; " in report["why"]


def test_an_axis_that_stands_still_is_no_answer(call: Call) -> None:
    np.savez("x.npz", fs=100.0, gx=np.full(6000, 0.1))
    said = call("reconcile", "x.npz", "--out", "found")
    assert said.status == 3
    assert "gx: all samples have the same value" in said.err
    assert "gx: all samples have the same value" in json.loads(Path("found/report.json").read_bytes())["why"]


# --- as a process ----------------------------------------------------------------------------------


@pytest.mark.long
def test_a_bar_shows_on_a_terminal_and_is_gone_at_the_end(recording: Path) -> None:
    pty = pytest.importorskip("pty", reason="there are no pseudo-terminals here")
    master, terminal = pty.openpty()
    command = [*PROGRAM, "analyze", str(recording), "--window", "20"]
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "120"}
    with subprocess.Popen(command, stdin=terminal, stdout=terminal, stderr=terminal, env=environment) as process:
        os.close(terminal)
        shown = b""
        with contextlib.suppress(OSError):  # Linux ends a pseudo-terminal so
            while part := os.read(master, 65_536):
                shown += part
        assert process.wait(PATIENCE_S) == 0
    os.close(master)
    assert b"dynamic curves" in shown
    assert shown.rindex(b"\x1b[2K") < shown.index(b"Gyroscopes")  # erased before the table


@pytest.mark.long
def test_an_interrupt_ends_an_analysis_in_one_line(tmp_path: Path) -> None:
    values = np.random.default_rng(1).standard_normal((1_000_000, 6))
    np.savez(tmp_path / "long.npz", fs=100.0, **dict(zip(AXES, values.T, strict=True)))
    source = """
import sys
import threading
import monitor.commands.analyze as offline
from monitor.cli import main
def told(values, rate_hz, window_s, tau, progress):
    print("working", file=sys.stderr, flush=True)
    from monitor.estimation.allan.dynamic_allan import compute_dynamic_allan
    return compute_dynamic_allan(values, rate_hz, window_s, tau, progress=progress)
offline.compute_dynamic_allan = told
main()
"""
    with daemon([sys.executable, "-c", source, "analyze", str(tmp_path / "long.npz"), "--window", "1000"]) as one:
        one.hears("working")
        assert one.status_after(signal.SIGINT) == 128 + signal.SIGINT
        assert one.rest() == "imu-monitor: interrupted\n"


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_comparison_in_one_line(tmp_path: Path, number: int) -> None:
    values = np.random.default_rng(1).standard_normal((400_000, 6))
    np.savez(tmp_path / "long.npz", fs=100.0, **dict(zip(AXES, values.T, strict=True)))
    source = """
import sys
import threading
import monitor.commands.reconcile as reconciling
from monitor.cli import main
original = reconciling.reconcile
def told(recording, model, seed, each, tell):
    print("working", file=sys.stderr, flush=True)
    return original(recording, model, seed, each, tell)
reconciling.reconcile = told
main()
"""
    command = [sys.executable, "-c", source, "reconcile", str(tmp_path / "long.npz"), "--out", str(tmp_path / "found")]
    with daemon(command) as one:
        one.hears("working")
        assert one.status_after(number) == 128 + number
        assert "Traceback" not in one.rest()
    assert not list((tmp_path / "found").iterdir())


def test_a_wrong_file_ends_a_real_process(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text(VIRTUAL + "windw = 1.0\n")
    done = program("run", "c.toml", cwd=tmp_path, env={**os.environ, "PYTHONPATH": os.getcwd()})
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.splitlines() == [
        'imu-monitor: c.toml: device bench-1: windw: unknown key; did you mean "window"?',
    ]


@pytest.mark.long
@pytest.mark.parametrize(
    "arguments", [("check", "--print-defaults"), ("analyze", "RECORDING", "--json", "-"), ("--help",)]
)
def test_a_reader_that_has_gone_is_no_crash(recording: Path, arguments: tuple[str, ...]) -> None:
    """As in ``imu-monitor … | head -1``."""
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "wb") as closed:
        command = [*PROGRAM, *(str(recording) if word == "RECORDING" else word for word in arguments)]
        done = subprocess.run(command, stdout=closed, stderr=subprocess.PIPE, timeout=PATIENCE_S, check=False)
    assert (done.returncode, done.stderr) == (1, b"")


@pytest.mark.long
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
@pytest.mark.parametrize("arguments", [("RECORDING", "--json", "-"), ("RECORDING",)])
def test_a_full_disk_behind_standard_output_is_one_line(recording: Path, arguments: tuple[str, ...]) -> None:
    with open("/dev/full", "wb") as full:
        command = [*PROGRAM, "analyze", *(str(recording) if word == "RECORDING" else word for word in arguments)]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=PATIENCE_S, check=False)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "No space left" in done.stderr


class Daemon:
    """The program running in a process of its own, with what it has said so far."""

    def __init__(self, command: list[str]) -> None:
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        self.lines: list[str] = []

    def hears(self, word: str) -> None:
        """Wait for a line with that word on standard error."""
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.lines.append(line)
            if word in line:
                return
        raise AssertionError(f"it ended without {word}: {''.join(self.lines)}")

    def status_after(self, number: int) -> int:
        self.process.send_signal(number)
        return self.process.wait(PATIENCE_S)

    def rest(self) -> str:
        assert self.process.stderr is not None
        return self.process.stderr.read()


@contextlib.contextmanager
def daemon(command: list[str]) -> Iterator[Daemon]:
    one = Daemon(command)
    try:
        yield one
    finally:
        one.process.kill()
        one.process.wait(PATIENCE_S)
        assert one.process.stderr is not None
        one.process.stderr.close()


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("command", ["demo", "run"])
def test_a_signal_stops_in_order(tmp_path: Path, command: str, number: int) -> None:
    if command == "run":
        (tmp_path / "c.toml").write_text(VIRTUAL + QUIET)
        arguments = ["run", str(tmp_path / "c.toml")]
    else:
        arguments = ["demo", "--viewer", "none"]
    with daemon([*PROGRAM, *arguments]) as one:
        one.hears("state=running")
        assert one.status_after(number) == 0
        assert "Traceback" not in one.rest()
    port = next(match[1] for line in one.lines if (match := re.search(r"waiting for (\S+)/tty", line)))
    assert not Path(port).exists()  # the simulated port is taken away again


@pytest.mark.long
def test_a_second_interrupt_ends_at_once() -> None:
    source = """
import sys, time
import monitor.daemon.service
from monitor.cli import main
def stuck(self):
    print("draining", file=sys.stderr, flush=True)
    time.sleep(86_400.0)
monitor.daemon.service.Service._drain = stuck
sys.argv = ["imu-monitor", "demo", "--viewer", "none"]
main()
"""
    with daemon([sys.executable, "-c", source]) as one:
        one.hears("state=running")
        one.process.send_signal(signal.SIGINT)
        one.hears("draining")
        assert one.status_after(signal.SIGINT) == -signal.SIGINT


COUNTED_DEMO = """
import json, sys
import monitor.daemon.service
from drivers.data_types import concatenate_blocks
from monitor.cli import main
from tests.system.rig import RecordingOutput
run = monitor.daemon.service.Service.run
def counted(self, *arguments):
    output = RecordingOutput()
    self.outputs.append(output)
    run(self, *arguments)
    truth = self.workers[0].simulated.fault_counts
    if "demo" in output.blocks:
        numbers = (concatenate_blocks(output.blocks["demo"]).ticks // 10_000_000).tolist()
        print(json.dumps([numbers, truth.total_simulated_samples, truth.dropped]), file=sys.stderr)
monitor.daemon.service.Service.run = counted
sys.argv[0] = "imu-monitor"
sys.exit(main())
"""
"""The demo, which writes at its end the number of each published sample, and how many the sensor made and dropped."""


def test_the_demo_receives_every_sample_that_its_sensor_sent() -> None:
    begun_s = time.monotonic()
    done = demo_until_it_runs([sys.executable, "-c", COUNTED_DEMO], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    took_s = time.monotonic() - begun_s
    assert done.returncode == 0, done.stderr
    assert took_s >= 2.0  # a lower bound holds on any machine
    assert "1 running" in done.stdout
    assert "Traceback" not in done.stderr
    row = next(line for line in done.stdout.splitlines() if re.match(r"demo\s", line))
    received, lost, bad = map(int, re.findall(r"running\s+\S+\s+(\d+)\s+(\d+)\s+(\d+)", row)[0])
    numbers, made, dropped = json.loads(done.stderr.splitlines()[-1])
    # by the sensor's counter: each sample between the first and the newest was received, or is known to be missing
    assert received == len(numbers) > 0
    assert received + lost + bad == numbers[-1] - numbers[0] + 1
    assert numbers[-1] < made <= 100.0 * took_s
    # a sensor that finds no room in the terminal of a loaded machine drops samples; nothing else may be missing
    assert lost + bad <= dropped


@pytest.mark.long
@pytest.mark.parametrize("where", ["full disk", "closed pipe"])
def test_a_log_that_cannot_be_written_stops_no_samples(where: str) -> None:
    if where == "full disk":
        if not Path("/dev/full").exists():
            pytest.skip("there is no /dev/full here")
        log = os.open("/dev/full", os.O_WRONLY)
    else:
        reading, log = os.pipe()
        os.close(reading)
    with os.fdopen(log, "wb") as closed:
        done = demo_until_it_runs(stdout=subprocess.PIPE, stderr=closed)
    assert done.returncode == 0
    assert "1 running" in done.stdout


def demo_until_it_runs(program: Sequence[str] = PROGRAM, **pipes: Any) -> "subprocess.CompletedProcess[str]":
    """Run the demo for some seconds, and for longer where a loaded machine needs longer to start the sensor."""
    for seconds in (2, 5, 20, 80):
        command = [*program, "demo", "--seconds", str(seconds), "--viewer", "none"]
        done = subprocess.run(command, text=True, timeout=seconds + PATIENCE_S, check=False, **pipes)
        if done.returncode != 0 or "1 running" in done.stdout:
            break
    return done


# --- sockets ---------------------------------------------------------------------------------------


def all_bound(process: psutil.Process, least: int) -> list[tuple[str, int]]:
    """The same, once there are so many."""
    return wait_for(lambda: found if len(found := bound(process)) >= least else None, f"{least} sockets") or []


def bound(process: psutil.Process) -> list[tuple[str, int]]:
    """Addresses on which the process and its children take packets or connections."""
    found = set()  # a child that is just being started has those of its parent
    for one in (process, *process.children(recursive=True)):
        with contextlib.suppress(psutil.Error):
            for opened in one.net_connections("inet"):
                if opened.status == psutil.CONN_LISTEN or (opened.type == socket.SOCK_DGRAM and opened.laddr):
                    found.add((opened.laddr.ip, opened.laddr.port))
    return sorted(found)


@pytest.mark.long
@pytest.mark.parametrize(("viewer", "least"), [("none", 1), ("web", 3)])
def test_defaults_listen_on_loopback_only(viewer: str, least: int) -> None:
    """zenoh's port; with the page also Rerun's server and the page itself."""
    if viewer == "web":
        pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    with daemon([*PROGRAM, "demo", "--viewer", viewer]) as one:
        one.hears("state=running")
        addresses = all_bound(psutil.Process(one.process.pid), least)
        assert len(addresses) >= least, addresses
        assert {address for address, _ in addresses} <= {"127.0.0.1", "::1"}
        assert one.status_after(signal.SIGTERM) == 0


@pytest.mark.long
def test_a_zenoh_file_opens_nothing_by_what_it_leaves_out(tmp_path: Path) -> None:
    """One that is there for TLS only must not turn scouting on."""
    (tmp_path / "zenoh.json5").write_text("{ /* nothing of scouting */ transport: {} }")
    (tmp_path / "c.toml").write_text(VIRTUAL + '[zenoh]\nconfig = "zenoh.json5"\n[viewer]\nmode = "none"\n')
    with daemon([*PROGRAM, "run", str(tmp_path / "c.toml")]) as one:
        one.hears("state=running")
        addresses = all_bound(psutil.Process(one.process.pid), 1)
        assert len(addresses) == 1
        assert addresses[0][0] == "127.0.0.1"


@pytest.mark.long
def test_watching_listens_nowhere() -> None:
    with daemon([*PROGRAM, "watch", "--seconds", "3"]) as one:
        process = psutil.Process(one.process.pid)
        opened = False
        while one.process.poll() is None:
            with contextlib.suppress(psutil.Error):  # it may end at any moment
                opened = opened or any("zenoh" in Path(file.path).name for file in process.memory_maps())
            assert bound(process) == []
            time.sleep(0.1)
        assert opened
        assert one.process.wait(PATIENCE_S) == 0


# --- history


@pytest.fixture(scope="session")
def histories(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what was kept of two devices for two hours."""
    from monitor.history.history_row import HistoryRow
    from monitor.history.sqlite_store import FILE_NAME, HistoryFileWriter
    from monitor.history.stored_events import StoredEvent

    folder = tmp_path_factory.mktemp("kept")
    store = HistoryFileWriter(folder / FILE_NAME)
    names, rng = ("gz.N", "gz.N.lo", "gz.N.hi", "gz.B", "temperature"), np.random.default_rng(1)
    for device in ("bench-1", "bench-2"):
        for i in range(120):
            last = np.array([1.5e-4, 1.4e-4, 1.6e-4, 4e-5, 25.0], np.float32) * np.float32(rng.uniform(0.9, 1.1))
            start_s, n = 1_763_683_200 + 60 * i, np.full(5, 600)
            row = HistoryRow(start_s, 60, start_s + 59.0, names, n, last, last, last, (6000, 0, 0, 0), 1)
            store.write_rows_and_events(
                [(device, row)], [(device, StoredEvent(start_s + 1.0, "moved", f"moved {i}"))] if i % 50 == 0 else []
            )
    store.close()
    return folder


@pytest.mark.long
def test_history_prints_plots_and_exports(call: Call, histories: Path, tmp_path: Path) -> None:
    said = call(
        "history", str(histories), "--device", "bench-1", "--axis", "gz",
        "--json", "h.json", "--out", "h.csv", "--plot", "h.png",
    )  # fmt: skip
    assert (said.status, said.err) == (0, "")
    assert "bench-1: 2025-11-21 00:00 to 2025-11-21 02:00 UTC, 120 rows of 1 min, 720,000 samples" in said.out
    assert "moved 100" in said.out
    told = json.loads((tmp_path / "h.json").read_bytes())
    assert (told["schema"], told["device"], len(told["start"])) == ("imu-monitor/history/1", "bench-1", 120)
    assert told["axes"]["gz"]["N"]["n"] == [600] * 120
    header, *rows = (tmp_path / "h.csv").read_text().splitlines()
    assert header.startswith("t (Unix s),width (s),gz.N (rad/sqrt(s))")
    assert len(rows) == 120
    assert (tmp_path / "h.png").stat().st_size > 10_000


def test_history_of_a_span_and_a_step_by_its_configuration(call: Call, histories: Path, tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text(f'{VIRTUAL}[storage]\nfolder = "{histories}"\n')
    more = ("--from", "2025-11-21T00:30", "--to", "2025-11-21 01:30", "--step", "15min")
    said = call("history", "c.toml", "--device", "bench-2", "--json", "-", *more)
    told = json.loads(said.out)
    assert said.status == 0
    assert told["start"] == [1_763_683_200 + 900 * i for i in range(2, 6)]
    assert told["axes"]["gz"]["N"]["n"] == [9000] * 4


@pytest.mark.parametrize(
    ("arguments", "status", "line"),
    [
        ((), 2, "CONFIG.toml or a folder is needed"),
        (("{kept}",), 2, "choose one with --device: bench-1, bench-2"),
        (("{kept}", "--device", "bench-3"), 2, 'did you mean "bench-'),
        (
            ("{kept}", "--device", "bench-1", "--from", "-1h"),
            3,
            "no results in this time range; stored are 2025-11-21 00:00:00",
        ),
        (("{kept}", "--from", "soon"), 2, '--from: "soon" is not a time'),
        (("{kept}", "--from", "2025-11-22", "--to", "2025-11-21"), 2, "is not after --from"),
        (("{kept}", "--axis", "g"), 2, "possible are gx, gy"),
        (("{kept}", "--plot", "h.pdf"), 2, "ending in .png"),
        (("{kept}", "--out", "h.xls"), 2, "known are .csv"),
        (("{kept}", "--connect", "tcp/127.0.0.1:1"), 2, "not both"),
        ((".",), 2, "history.sqlite: no such file"),
        (("absent.toml",), 2, "no such file"),
        (("--connect", "here"), 2, "not a valid endpoint"),
    ],
)
def test_what_history_cannot_do_is_one_line(
    call: Call, histories: Path, arguments: tuple[str, ...], status: int, line: str
) -> None:
    said = call("history", *(one.replace("{kept}", str(histories)) for one in arguments))
    assert said.status == status
    assert line in said.only_line()


def test_a_view_of_what_is_not_kept_is_refused(call: Call, tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text(VIRTUAL + QUIET)
    said = call("run", "c.toml", "--history", "1d")
    assert said.status == 2
    assert said.only_line() == "imu-monitor: --history: there is no history to show; set folder in [storage]\n"
    assert "not a duration" in call("run", "c.toml", "--history", "long").only_line()


def test_history_without_storage_is_said(call: Call, tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text(VIRTUAL)
    said = call("history", "c.toml")
    assert said.status == 2
    assert "[storage] has no folder" in said.only_line()


def test_history_of_a_running_daemon(call: Call, histories: Path, tmp_path: Path) -> None:
    from monitor.daemon.service import Service
    from tests.support.ports import free_endpoint

    endpoint = free_endpoint()
    histories = Path(shutil.copytree(histories, tmp_path / "kept"))  # the daemon adds to it
    zenoh = f'[zenoh]\nlisten = ["{endpoint}"]\n[viewer]\nmode = "none"\n'
    (tmp_path / "c.toml").write_text(f'{VIRTUAL}{zenoh}[storage]\nrecord = false\nfolder = "{histories}"\n')
    service = Service(load_config(tmp_path / "c.toml"))
    thread = threading.Thread(target=service.run, args=(FOREVER_S,))
    thread.start()
    try:
        wait_for(lambda: service.zenoh.state == "ok")
        span = ("--from", "2025-11-21", "--to", "2025-11-22")
        said = call("history", "--connect", endpoint, "--json", "-", *span)
        there = call("history", str(histories), "--device", "bench-1", "--json", "-", *span)
        nothing = call("history", "--connect", endpoint, "--from", "2000-01-01", "--to", "2000-01-02")
    finally:
        service.request_stop()
        thread.join(PATIENCE_S)
    assert not thread.is_alive()
    told, kept = json.loads(said.out), json.loads(there.out)
    assert (told["axes"], told["start"]) == (kept["axes"], kept["start"])
    assert nothing.status == 3
    assert "no results in this time range" in nothing.only_line()


# --- errors that nobody foresaw


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (
            ZeroDivisionError("division\nby zero"),
            1,
            "internal error: ZeroDivisionError: division by zero; please report",
        ),
        (KeyError("gx"), 1, "internal error: KeyError: 'gx'; please report it with the output of the same command"),
        (ValueError("x" * 9000), 1, " …; please report it"),
        (RecursionError("too deep"), 1, "internal error: RecursionError: too deep"),
        (MemoryError("Unable to allocate 233. GiB"), 1, "not enough memory (Unable to allocate 233. GiB); read less"),
        (MemoryError(), 1, "not enough memory; read less data"),
        (PermissionError(13, "Permission denied", "a.csv"), 1, "Permission denied: 'a.csv'"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_an_unexpected_error_is_one_line(
    error: Exception, status: int, line: str, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("monitor.commands.analyze.run_analysis", fail)
    done = call("analyze", "a.csv")
    assert line in done.only_line()
    assert len(done.err) < 1000
    assert done.status == status
    for arguments in (("--debug", "analyze", "a.csv"), ("analyze", "a.csv", "--debug")):
        done = call(*arguments)
        assert done.status == status
        assert done.err.startswith("Traceback (most recent call last):")
        assert line in done.err


@pytest.mark.parametrize("debug", [False, True])
def test_a_thread_that_fails_is_one_line(
    debug: bool, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail() -> None:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr(threading, "excepthook", partial(report_failed_thread, debug))
    thread = threading.Thread(target=fail, name="warm-up")
    thread.start()
    thread.join()
    *before, line = capsys.readouterr().err.splitlines()
    assert line.startswith('imu-monitor: thread "warm-up" ended: internal error: ZeroDivisionError: division by zero;')
    assert bool(before) == debug


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ("export", "m.toml"),
            "Missing option '--format' (kalibr|allan_variance_ros|openvins|",
        ),
        (
            ("simulate", "m.toml", "--seconds", "1"),
            "Missing option '--out' (FILE): Recording to write: .csv, .csv.gz",
        ),
        (("simulate", "m.toml"), "Missing option '--seconds' (S): Length in seconds"),
        (("compensate", "a.csv"), "Missing option '--out' (FILE): Recording without drift"),
        (("reconcile", "a.csv"), "Missing option '--out' (DIR): Folder for the report"),
        (
            ("thermal", "predict", "a.csv"),
            "Missing option '--model' (MODEL.json): Model file that thermal fit has",
        ),
        (("analyze",), "Missing argument 'RECORDING': File, or folder of segments. See imu-monitor analyze --help"),
        (("analyze", "a.csv", "--rte", "1"), "No such option: --rte of imu-monitor analyze; did you mean --rate?"),
        (
            ("analyze", "a.csv", "--xyz"),
            "No such option: --xyz of imu-monitor analyze; known are --rate, --last, --tau,",
        ),
        (("thermal", "fitt", "a.csv"), "Did you mean 'fit'?"),
        (("quux",), "known are demo, run, check, "),
        ((), "Missing command; known are demo, run, check, "),
        (("thermal",), "Missing command; known are fit, predict"),
    ],
)
def test_what_is_missing_or_unknown_is_named_with_what_is_possible(
    arguments: tuple[str, ...], words: str, call: Call
) -> None:
    done = call(*arguments)
    assert words in done.only_line()
    assert done.status == 2
