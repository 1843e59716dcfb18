"""Tests of the command line: exit status, one-line errors, JSON, signals, pipes and open sockets."""

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
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import allantools
import numpy as np
import psutil
import pytest
import typer

from drivers import units
from drivers.data_types import AXES
from drivers.recordings import save_samples
from monitor.cli import app, main, report_failed_thread
from monitor.cli.shared.options import READING_OPTIONS
from monitor.common import topics
from monitor.common.shipped_config_paths import CONFIG_FOLDER
from monitor.noise.model_loading import read_model
from monitor.publishing.exporters import FORMATS
from monitor.publishing.messages.results import CoefficientsMessage
from monitor.publishing.zenoh.publisher import ZenohPublisher
from monitor.settings.loading import ZenohTable, load_config
from tests.monitor.publishing.example_results import make_estimate
from tests.support.ports import free_endpoint
from tests.support.waiting import FOREVER_S, PATIENCE_S, wait_for

PROGRAM = [sys.executable, "-m", "imu_monitor"]
COMMANDS = ("demo", "run", "check", "doctor", "watch", "analyze", "simulate", "reconcile", "export")
RATE_HZ = 100.0
DEVICE = '[[device]]\nname = "bench-1"\n'
VIRTUAL = DEVICE + 'driver = { link = "virtual" }\n'
CAN = DEVICE + 'driver = {{ link = "can", channel = "can0", decoder = "dbc", decoder_options = {} }}\n'
QUIET = '[zenoh]\nmode = "none"\n[viewer]\nmode = "none"\n'


MODEL = str(CONFIG_FOLDER / "models" / "consumer-mems.toml")


class CompletedRun:
    """Exit status and output of one run of the program."""

    def __init__(self, status: int, out: str, err: str) -> None:
        self.status, self.out, self.err = status, out, err

    def require_one_error_line(self) -> str:
        """Return the single line on standard error and require an empty standard output."""
        assert self.out == ""
        assert self.err.endswith("\n")
        assert self.err.count("\n") == 1, self.err
        assert "Traceback" not in self.err
        return self.err


RunProgram = Callable[..., CompletedRun]


@pytest.fixture
def run_program(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], tmp_path: Path) -> RunProgram:
    """Return a function that runs the program in this process, in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str) -> CompletedRun:
        monkeypatch.setattr(sys, "argv", ["imu-monitor", *arguments])
        capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            main()
        out, err = capfd.readouterr()
        return CompletedRun(int(ended.value.code or 0), out, err)

    return run


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Simulate three minutes of the model consumer-mems."""
    path = tmp_path_factory.mktemp("recording") / "static.csv"
    values = (
        read_model(CONFIG_FOLDER / "models" / "consumer-mems.toml").start_stream(RATE_HZ, 7).draw_next_samples(18_000)
    )
    save_samples(path, np.arange(len(values)) / RATE_HZ, values)
    return path


def run_in_subprocess(*arguments: str, **more: Any) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [*PROGRAM, *arguments], capture_output=True, text=True, timeout=PATIENCE_S, check=False, **more
    )


def test_blas_uses_one_thread_unless_the_user_sets_more() -> None:
    """The program's own threads share the work. A setting of the user has priority."""
    command = [sys.executable, "-c", "import monitor.cli, os; print(os.environ['OPENBLAS_NUM_THREADS'])"]
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    for given, seen in (({}, "1"), ({"OPENBLAS_NUM_THREADS": "3"}, "3")):
        completed = subprocess.run(command, capture_output=True, text=True, env=environment | given, check=True)
        assert completed.stdout.strip() == seen


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
    "no link": (
        DEVICE + "driver = {}\n",
        "driver.link: missing; possible are can, iio, replay, serial, udp, virtual, zenoh",
    ),
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
    "client without a router": (
        VIRTUAL + '[zenoh]\nmode = "client"\n',
        "zenoh.connect: empty, but a client needs a router",
    ),
    "bad log level": (VIRTUAL + '[log]\nlevel = "loud"\n', "log.level: "),
}


@pytest.mark.parametrize("case", WRONG_FILES)
def test_invalid_config_is_refused_in_one_line(run_program: RunProgram, case: str) -> None:
    text, message = WRONG_FILES[case]
    Path("c.toml").write_bytes(text if isinstance(text, bytes) else text.encode())
    for command in ("run", "check"):
        run = run_program(command, "c.toml")
        assert run.status == 2
        line = run.require_one_error_line()
        assert "c.toml: " in line
        assert message in line


def test_check_reports_all_mistakes_and_run_only_the_first(run_program: RunProgram) -> None:
    text = (
        '[[device]]\nname = "a"\nwindw = 1.0\ndriver = { link = "virtual" }\n[viewer]\nmode = "x"\n[log]\nlevel = 3\n'
    )
    Path("c.toml").write_text(text)
    run = run_program("check", "c.toml")
    assert run.status == 2
    assert run.out == ""
    assert [line.split(": ")[:2] for line in run.err.splitlines()] == [
        ["c.toml", key] for key in ("device a", "viewer.mode", "log.level")
    ]
    line = run_program("run", "c.toml").require_one_error_line()
    assert "windw" in line
    assert "(and 2 more: imu-monitor check c.toml)" in line


def test_viewer_file_path_is_relative_to_the_configuration(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text(VIRTUAL + '[viewer]\nmode = "live.rrd"\n')
    assert load_config(tmp_path / "c.toml").viewer.mode == str(tmp_path / "live.rrd")


def test_check_and_run_validate_the_model_of_a_simulated_device(run_program: RunProgram) -> None:
    Path("model.toml").write_text("sample_rate = 100.0\n[gz.angle_random_walk]\nM = 1.0\n")
    Path("c.toml").write_text(DEVICE + 'driver = { link = "virtual", model = "model.toml" }\n' + QUIET)
    for command in ("check", "run"):
        run = run_program(command, "c.toml")
        assert run.status == 2
        assert "model.toml" in run.require_one_error_line()


def test_check_reports_model_mistakes_together_with_all_others(run_program: RunProgram) -> None:
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
    run = run_program("check", "c.toml")
    assert run.status == 2
    begins = [
        "device a: windw: unknown key",
        'device b: driver.link: "sereal"; possible are serial, ',
        "device c: driver.seed: ",
        'log.level: "loud"; possible are ',
        'device a: "gz" is not an effect',
        "device a: ",  # followed by the path of the model file
        "device b: limit of R: times_model = 2, but the model in force has no R on gz",
        "device c: ",
        'device c: "gz" is not an effect',
        'device c: effect "gz.sinusoidal:amplitude=1,frequency=60": ',
    ]
    lines = run.err.splitlines()
    assert len(lines) == len(begins), lines
    for line, begin in zip(lines, begins, strict=True):
        assert line.startswith(f"c.toml: {begin}"), line
    assert sum("model.toml: " in line for line in lines) == 2


def test_check_and_run_validate_the_effects_of_a_simulated_device(run_program: RunProgram) -> None:
    driver = '{ link = "virtual", effect = ["gz.sinusoidal:amplitude=1,frequency=60"] }'
    Path("c.toml").write_text(f"{DEVICE}driver = {driver}\n{QUIET}")
    for command in ("check", "run"):
        run = run_program(command, "c.toml")
        assert run.status == 2
        assert 'effect "gz.sinusoidal:amplitude=1,frequency=60": ' in run.require_one_error_line()


def test_check_and_run_compare_limits_with_the_model(run_program: RunProgram) -> None:
    limit = '[[device.limit]]\naxes = "gz"\nletter = "R"\ntimes_model = 2.0\n'
    device = DEVICE + 'model = "consumer-mems"\n' + limit + '[device.driver]\nlink = "virtual"\n'
    Path("c.toml").write_text(device + QUIET)
    for command in ("check", "run"):
        run = run_program(command, "c.toml")
        assert run.status == 2
        assert (
            "device bench-1: limit of R: times_model = 2, but the model in force has no R on gz"
            in run.require_one_error_line()
        )


@pytest.mark.parametrize("name", sorted(path.name for path in CONFIG_FOLDER.glob("*.toml")))
def test_check_accepts_every_shipped_file(run_program: RunProgram, recording: Path, name: str) -> None:
    shutil.copy(CONFIG_FOLDER / name, name)
    shutil.copy(recording, "recording.csv")  # replay.toml refers to this file
    run = run_program("check", name)
    assert (run.status, run.err) == (0, "")
    assert "no mistakes" in run.out


def test_check_accepts_the_defaults_that_it_prints(run_program: RunProgram) -> None:
    printed = run_program("check", "--print-defaults")
    assert (printed.status, printed.err) == (0, "")
    Path("defaults.toml").write_text(printed.out)
    run = run_program("check", "defaults.toml")
    assert (run.status, run.out, run.err) == (0, "defaults.toml: 1 device, no mistakes\n", "")


def test_check_prints_the_keys_of_one_link_and_one_decoder(run_program: RunProgram) -> None:
    printed = run_program("check", "--print-defaults", "--link", "serial", "--decoder", "text")
    assert (printed.status, printed.err) == (0, "")
    assert 'link = "serial"' in printed.out
    assert "baudrate = 115200" in printed.out
    assert 'columns = ["gx", ' in printed.out
    assert "sentence" not in printed.out
    run = run_program("check", "--print-defaults", "--decoder", "tekst")
    assert run.status == 2
    assert '--decoder: "tekst"; possible are text, ' in run.require_one_error_line()
    assert run_program("check", "--decoder", "text").status == 2


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_lists_commands_and_options(shell: str) -> None:
    for words, number, expected in (("imu-monitor an", 1, "analyze"), ("imu-monitor export --fo", 2, "--format")):
        variables = {"_IMU_MONITOR_COMPLETE": f"complete_{shell}", "_TYPER_COMPLETE_FISH_ACTION": "get-args"}
        variables |= {"COMP_WORDS": words, "COMP_CWORD": str(number), "_TYPER_COMPLETE_ARGS": words}
        done = subprocess.run(
            [*PROGRAM], env=os.environ | variables, capture_output=True, text=True, timeout=PATIENCE_S, check=True
        )
        assert expected in done.stdout
        assert "reconcile" not in done.stdout
        assert "--inflation" not in done.stdout


def test_version_option_prints_the_package_version(run_program: RunProgram) -> None:
    run = run_program("--version")
    assert (run.status, run.out, run.err) == (0, f"imu-monitor {metadata.version('imu-monitor')}\n", "")


# --- arguments -------------------------------------------------------------------------------------


def build_simulate_arguments(*arguments: str) -> tuple[str, ...]:
    """Later arguments override the defaults because the last occurrence of an option counts."""
    return ("simulate", "--seconds", "1", "--out", "x.csv", *arguments)


def build_reconcile_arguments(*arguments: str) -> tuple[str, ...]:
    return ("reconcile", "x.csv", "--out", "found", *arguments)


WRONG_ARGUMENTS = {
    "no command": ((), "Missing command"),
    "unknown command": (("analyse",), "No such command 'analyse'"),
    "unknown option": (("analyze", "x.csv", "--nope"), "No such option: --nope"),
    "missing argument": (("analyze",), "Missing argument 'RECORDING'"),
    "missing configuration": (("run",), "Missing argument 'CONFIG.toml'"),
    "nothing to check": (("check",), "--print-defaults"),
    "findings in a missing folder": (
        ("doctor", "--json", "nowhere/x.json"),
        "--json: nowhere/x.json: cannot be written",
    ),
    "missing file": (("run", "nowhere.toml"), "nowhere.toml: no such file"),
    "folder for a file": (("run", "."), ".: cannot be read"),
    "bad viewer": (("demo", "--viewer", "nativ"), '--viewer: "nativ"; possible are native, auto, '),
    "bad seconds": (("demo", "--seconds", "soon"), "Invalid value for '--seconds'"),
    "zero seconds": (("demo", "--seconds", "0"), "--seconds: 0 s is outside the supported range"),
    "bad endpoint": (
        ("watch", "--connect", "7450"),
        'connect "7450": not a valid endpoint; an example is tcp/127.0.0.1:7450',
    ),
    "bad key": (("watch", "##", "--connect", "tcp/127.0.0.1:9"), 'key expression "##"'),
    "bad rate": (("analyze", "x.csv", "--rate", "-1"), "--rate: -1 Hz is outside the supported range"),
    "rate is no number": (("analyze", "x.csv", "--rate", "nan"), "--rate"),
    "bad tau": (("analyze", "x.csv", "--tau", "octav"), '--tau: "octav"; possible are octave, decade10, or seconds'),
    "negative tau": (("analyze", "x.csv", "--tau", "1,-2"), "--tau: -2 s is outside the supported range"),
    "bad picture": (("analyze", "x.csv", "--plot", "x.pdf"), "--plot: x.pdf: a name ending in .png or .html is needed"),
    "bad window": (
        ("analyze", "x.csv", "--window", "soon"),
        '--window: "soon" is not a duration; write seconds, or "90s"',
    ),
    "zero window": (("analyze", "x.csv", "--window", "0"), '--window: "0" is not a duration'),
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
    "inflation below 1": (
        ("export", MODEL, "--format", "kalibr", "--inflation", "0.5"),
        "--inflation: 0.5 is outside the supported range",
    ),
    "option of another format": (
        ("export", MODEL, "--format", "kalibr", "--dt", "0.01"),
        "--dt: is an option of vins_fusion, fast_lio, px4_ekf2, ardupilot_ekf3, robot_localization, imu_utils, kalman, "
        "not of kalibr",
    ),
    "correlation time of another format": (
        ("export", MODEL, "--format", "gyroparams", "--correlation-time", "9"),
        "--correlation-time: is an option of gnss_ins_sim, kalman, not of gyroparams",
    ),
    "topic of another format": (
        ("export", MODEL, "--format", "kalman", "--rostopic", "/imu"),
        "--rostopic: is an option of kalibr, allan_variance_ros, openvins, not of kalman",
    ),
    "zero time step": (
        ("export", MODEL, "--format", "kalman", "--dt", "0"),
        "--dt: 0 s is outside the supported range",
    ),
    "output in a missing folder": (
        ("export", MODEL, "--format", "kalibr", "--out", "nowhere/x.yaml"),
        "--out: nowhere/x.yaml: cannot be written",
    ),
    "no sensor": (("demo", "--sensor", "consumer-mem"), '--sensor: no model "consumer-mem"'),
    "no such effect": (("demo", "--effect", "gz.sinusodal:amplitude=1"), 'did you mean "sinusoidal"?'),
    "no effect": (("demo", "--effect", "vibration"), '--effect: "vibration" is not an effect; write axis.effect:'),
    "effect too fast": (("demo", "--effect", "gz.sinusoidal:amplitude=1,frequency=60"), "below 50 Hz"),
    "bad time of an effect": (("demo", "--effect-at", "soon"), '--effect-at: "soon" is not a duration'),
    "missing model": (
        build_simulate_arguments("nothing.toml"),
        'no model "nothing.toml", neither a file nor one of those shipped',
    ),
    "misspelled model": (build_simulate_arguments("consumer-mem"), 'did you mean "consumer-mems"?'),
    "zero length": (build_simulate_arguments("consumer-mems", "--seconds", "0"), '--seconds: "0" is not a duration'),
    "length in words": (
        build_simulate_arguments("consumer-mems", "--seconds", "soon"),
        '--seconds: "soon" is not a duration',
    ),
    "zero sample rate": (
        build_simulate_arguments("consumer-mems", "--rate", "0"),
        "--rate: 0 Hz is outside the supported range",
    ),
    "negative seed": (
        build_simulate_arguments("consumer-mems", "--seed", "-1"),
        "--seed: -1 is outside the supported range",
    ),
    "nothing to write": (("simulate", "consumer-mems", "--seconds", "1"), "Missing option '--out'"),
    "unknown suffix": (
        build_simulate_arguments("consumer-mems", "--out", "x.xlsx"),
        "x.xlsx: the suffix is unknown; recordings are written as .csv",
    ),
    "recording in a missing folder": (
        build_simulate_arguments("consumer-mems", "--out", "nowhere/x.csv"),
        "there is no folder nowhere",
    ),
    "summary in a missing folder": (
        build_simulate_arguments("consumer-mems", "--json", "nowhere/x.json"),
        "--json: nowhere/x.json: cannot be",
    ),
    "folder as output file": (build_simulate_arguments("consumer-mems", "--out", ".csv/../.csv"), "cannot be written"),
    "missing temperature recording": (
        build_simulate_arguments("consumer-mems", "--temperature-from", "nowhere.csv"),
        "nowhere.csv: cannot be read: No such file or directory",
    ),
    "no report folder": (("reconcile", "x.csv"), "Missing option '--out'"),
    "no recording to reconcile": (("reconcile", "--out", "x"), "Missing argument 'RECORDING"),
    "reconcile at zero rate": (build_reconcile_arguments("--rate", "0"), "--rate: 0 Hz is outside the supported range"),
    "reconcile at infinite rate": (
        build_reconcile_arguments("--rate", "inf"),
        "--rate: inf Hz is outside the supported range",
    ),
    "reconcile with negative seed": (
        build_reconcile_arguments("--seed", "-1"),
        "--seed: -1 is outside the supported range",
    ),
    "reconcile with missing model": (
        build_reconcile_arguments("--model", "nothing.toml"),
        'no model "nothing.toml", neither a file nor',
    ),
    "reconcile with misspelled model": (
        build_reconcile_arguments("--model", "consumer-mem"),
        'did you mean "consumer-mems"?',
    ),
    "reconcile summary in a missing folder": (
        build_reconcile_arguments("--json", "nowhere/x.json"),
        "--json: nowhere/x.json: cannot be",
    ),
    "missing recording": (("analyze", "nowhere.csv"), "nowhere.csv: cannot be read: No such file or directory"),
}


@pytest.mark.parametrize("case", WRONG_ARGUMENTS)
def test_invalid_argument_is_reported_in_one_line(run_program: RunProgram, case: str) -> None:
    arguments, message = WRONG_ARGUMENTS[case]
    run = run_program(*arguments)
    assert run.status == 2
    assert message in run.require_one_error_line()
    assert not list(Path().iterdir())


def test_help_of_every_command_loads_no_heavy_library() -> None:
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
    completed = subprocess.run(
        [sys.executable, "-c", source], capture_output=True, text=True, timeout=PATIENCE_S, check=True
    )
    assert completed.stdout.count("status 0\n") == 1 + len(COMMANDS)
    assert completed.stdout.count("--help") >= 1 + len(COMMANDS)
    assert completed.stdout.endswith("heavy []\n")


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
def test_invalid_model_is_reported_and_nothing_is_written(run_program: RunProgram, case: str) -> None:
    text, message = WRONG_MODELS[case]
    Path("m.toml").write_text("sample_rate = 100.0\n" + text)
    run = run_program("simulate", "m.toml", "--seconds", "1", "--out", "x.csv", "--truth", "--json", "x.json")
    assert run.status == 2
    line = run.require_one_error_line()
    assert "m.toml: " in line
    assert message in line
    assert [path.name for path in Path().iterdir()] == ["m.toml"]


@pytest.mark.parametrize("option", ["--json", "--temperature-from"])
def test_output_file_may_not_be_another_file_of_the_command(run_program: RunProgram, option: str) -> None:
    Path("x.csv").write_text("t,gz\n")
    same = f"../{Path.cwd().name}/x.csv"
    run = run_program("simulate", "consumer-mems", "--seconds", "1", "--out", "x.csv", option, same)
    assert run.status == 2
    assert f"{option}: " in run.require_one_error_line()
    assert Path("x.csv").read_text() == "t,gz\n"


def test_unknown_model_path_lists_the_known_models(run_program: RunProgram) -> None:
    run = run_program("simulate", "no/where.toml", "--seconds", "1", "--out", "x.csv")
    assert run.status == 2
    assert "known are adis16405, " in run.require_one_error_line()


def test_simulate_asks_for_a_rate_if_the_model_has_none(run_program: RunProgram) -> None:
    Path("m.toml").write_text("[gz.angle_random_walk]\nN = 1e-3\n")
    run = run_program("simulate", "m.toml", "--seconds", "1min", "--out", "x.csv")
    assert run.status == 2
    assert "m.toml: the model has no sample_rate; set the rate with --rate HZ" in run.require_one_error_line()
    run = run_program(
        "simulate", "m.toml", "--seconds", "1min", "--out", "x.csv", "--rate", "20", "--seed", "5", "--json", "-"
    )
    assert (run.status, run.err) == (0, "")
    assert json.loads(run.out) == {
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
def test_simulated_recording_can_be_analyzed(run_program: RunProgram) -> None:
    run = run_program("simulate", "consumer-mems", "--seconds", "3min", "--out", "x.parquet", "--truth")
    assert (run.status, run.err) == (0, "")
    assert run.out == (
        "x.parquet: 18000 samples at 100 Hz, 180 s, seed 1: gx gy gz ax ay az; truth in x.parquet.truth.json\n"
    )
    run = run_program("analyze", "x.parquet", "--json", "-")
    assert run.status == 0
    noise = json.loads(run.out)["axes"]["gz"]["coefficients"]["N"]
    assert noise["lo"] <= 1.5e-4 <= noise["hi"]


@pytest.mark.long
def test_last_option_uses_only_the_end_of_the_recording(run_program: RunProgram, recording: Path) -> None:
    run = run_program("analyze", str(recording), "--last", "1min", "--json", "-")
    assert run.status == 0
    found = json.loads(run.out)
    assert found["samples"] == 6000
    assert "Only the last 60 s are used, 6000 samples." in found["notes"]
    run = run_program("reconcile", str(recording), "--last", "never", "--out", "r")
    assert (run.status, run.err.count("\n")) == (2, 1)
    assert "--last: " in run.err
    run = run_program("compensate", str(recording), "--last", "20s", "--out", "x.npz", "--json", "-")
    with np.load("x.npz") as found:
        assert len(found["gx"]) == 2000


@pytest.mark.long
@pytest.mark.parametrize(("number", "suffix"), [(signal.SIGINT, ".csv"), (signal.SIGTERM, ".npz")])
def test_interrupted_simulation_leaves_no_file(tmp_path: Path, number: int, suffix: str) -> None:
    arguments = ["simulate", "consumer-mems", "--seconds", "40d", "--out", f"x{suffix}", "--truth"]
    process = subprocess.Popen([*PROGRAM, *arguments], cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    try:
        wait_for(lambda: process.poll() is not None or has_growing_file(process.pid, tmp_path), "a file that grows")
        assert process.poll() is None
        process.send_signal(number)
        _, err = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
    assert process.returncode == 128 + number
    assert err == ("imu-monitor: interrupted\n" if number == signal.SIGINT else "")
    assert list(tmp_path.iterdir()) == []


def has_growing_file(pid: int, folder: Path) -> bool:
    """Return True if the process has written to an open file in the folder, even if the file has no name."""
    for opened in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(OSError):
            if os.readlink(opened).startswith(str(folder)) and opened.stat().st_size > 100_000:
                return True
    return False


# --- analyze ---------------------------------------------------------------------------------------


@pytest.mark.long
def test_analyze_prints_complete_json_on_standard_output(run_program: RunProgram, recording: Path) -> None:
    run = run_program("analyze", str(recording), "--json", "-")
    assert (run.status, run.err) == (0, "")
    result = json.loads(run.out)
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
        for coefficient in table["coefficients"].values():
            assert coefficient.keys() - {"or"} == {"value", "lo", "hi", "status"}
            assert coefficient["status"] in ("estimated", "upper_bound", "unestimated")
            assert (coefficient["value"] is None) == (coefficient["status"] != "estimated")
        allan = {name: np.array(column) for name, column in table["allan"].items()}
        assert (allan["lo"] < allan["deviation"]).all()
        assert (allan["deviation"] < allan["hi"]).all()
        assert table["coefficients"]["N"]["status"] == "estimated"


@pytest.mark.long
@pytest.mark.parametrize("grid", ["octave", "decade10", "0.01,0.05,0.5,5,50"])
def test_allan_deviations_equal_allantools(run_program: RunProgram, recording: Path, grid: str) -> None:
    run = run_program("analyze", str(recording), "--json", "x.json", "--tau", grid)
    assert run.status == 0
    result = json.loads(Path("x.json").read_bytes())
    columns = np.loadtxt(recording, delimiter=",", skiprows=1).T[1:]
    for axis, column in zip(AXES, columns, strict=True):
        allan = result["axes"][axis]["allan"]
        tau, deviation, _, _ = allantools.oadev(column, rate=RATE_HZ, data_type="freq", taus=allan["tau"])
        np.testing.assert_allclose(allan["tau"], tau, rtol=1e-12)
        np.testing.assert_allclose(allan["deviation"], deviation, rtol=1e-9)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("x.csv", b"", "x.csv: the file is empty"),
        ("x.csv", b"# a\n\n# b\n", "x.csv: contains only comments and blank lines, expected a header such as t,gx,"),
        ("x.csv", b"t,gx\n", "x.csv: has a header line but no complete line of samples"),
        (
            "x.csv",
            b"gx\n" + b"0.1\n" * 100,
            "x.csv: has neither t nor fs, so its rate is not known; give it with --rate",
        ),
        ("x.csv", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + bytes(range(256)) * 9, "x.csv: no axis among its columns"),
        ("x.npz", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + bytes(range(256)) * 9, "x.npz: is no .npz file"),
        ("x.csv.gz", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + bytes(range(256)) * 9, "x.csv.gz: "),
        ("x.png", b"\x89PNG\r\n\x1a\n", "x.png: the suffix is not that of a recording; known are .csv"),
    ],
)
def test_invalid_recording_is_reported_in_one_line(
    run_program: RunProgram, name: str, content: bytes, message: str
) -> None:
    Path(name).write_bytes(content)
    run = run_program("analyze", name, "--json", "x.json")
    assert run.status == 2
    assert message in run.require_one_error_line()
    assert not Path("x.json").exists()


def test_unknown_columns_are_printed_below_the_message(run_program: RunProgram) -> None:
    Path("x.csv").write_text("t,speed\n0.1,3\n0.2,4\n0.3,5\n0.4,6\n")
    run = run_program("analyze", "x.csv")
    assert (run.status, run.out) == (2, "")
    message, *columns = run.err.splitlines()
    assert message.startswith("imu-monitor: x.csv: no axis among its columns (t, speed)")
    assert message.endswith("such as imu-monitor analyze x.csv --columns gx=speed")
    assert [line.split() for line in columns] == [
        ["column", "guess", "name", "first", "values"],
        ["1", "t", "t", "0.1", "0.2", "0.3"],
        ["2", "speed", "3", "4", "5"],
    ]


def test_folder_without_recordings_is_refused(run_program: RunProgram) -> None:
    run = run_program("analyze", ".")
    assert run.status == 2
    assert "no recordings in this folder" in run.require_one_error_line()


def test_a_rate_makes_a_recording_without_times_readable(run_program: RunProgram) -> None:
    Path("x.csv").write_text("gx\n" + "0.001\n0.002\n0.004\n" * 40)
    run = run_program("analyze", "x.csv", "--rate", "50", "--json", "-")
    assert run.status == 0
    assert json.loads(run.out)["seconds"] == 120 / 50


@pytest.mark.long
def test_truncated_recording_is_read_up_to_the_cut(run_program: RunProgram, recording: Path) -> None:
    whole = recording.read_bytes()
    at = whole.index(b"\n", len(whole) // 2) + 20  # inside a line
    Path("cut.csv").write_bytes(whole[:at])
    run = run_program("analyze", "cut.csv", "--json", "-")
    assert run.status == 0
    result = json.loads(run.out)
    assert result["samples"] == whole[:at].count(b"\n") - 1
    assert any("cut off" in note for note in result["notes"])
    shown = run_program("analyze", "cut.csv")
    assert shown.status == 0
    assert "cut off" in shown.out


@pytest.mark.parametrize("target", ["-", "why.json"])
def test_too_short_recording_gives_json_and_status_3(run_program: RunProgram, target: str) -> None:
    Path("x.csv").write_text("t,gx\n" + "".join(f"{i / 100},{i % 3}\n" for i in range(20)))
    run = run_program("analyze", "x.csv", "--json", target)
    assert run.status == 3
    assert run.err.count("\n") == 1
    assert "20 samples; at least 50 are needed" in run.err
    result = json.loads(run.out if target == "-" else Path(target).read_bytes())
    assert result["schema"] == "imu-monitor/analyze/1"
    assert (result["samples"], result["axes"]) == (20, {})
    assert "at least 50 are needed" in result["notes"][0]


@pytest.mark.long
@pytest.mark.parametrize("option", ["--json", "--plot"])
def test_unwritable_result_is_reported_in_one_line(run_program: RunProgram, recording: Path, option: str) -> None:
    Path("file").touch()
    for target in ("nowhere/x.png", "file/x.png"):
        run = run_program("analyze", str(recording), option, target)
        assert run.status == 2
        assert target in run.require_one_error_line()


def test_total_and_hadamard_deviations_equal_allantools(run_program: RunProgram, recording: Path) -> None:
    """The total deviation is corrected for its bias, which is small at a thirtieth of the recording."""
    assert run_program("analyze", str(recording), "--json", "x.json", "--tau", "0.05,0.1,0.5,1,2,5").status == 0
    result = json.loads(Path("x.json").read_bytes())
    columns = np.loadtxt(recording, delimiter=",", skiprows=1).T[1:]
    for axis, column in zip(AXES, columns, strict=True):
        table = result["axes"][axis]
        _, hadamard, _, _ = allantools.ohdev(column, rate=RATE_HZ, data_type="freq", taus=table["total"]["tau"])
        np.testing.assert_allclose(table["hadamard"]["deviation"], hadamard, rtol=1e-9)
        _, total, _, _ = allantools.totdev(column, rate=RATE_HZ, data_type="freq", taus=table["total"]["tau"])
        np.testing.assert_allclose(table["total"]["deviation"], total, rtol=0.01)


@pytest.mark.long
def test_window_option_gives_dynamic_curves(run_program: RunProgram, recording: Path) -> None:
    run = run_program("analyze", str(recording), "--window", "1min", "--json", "-")
    assert (run.status, run.err) == (0, "")
    found = json.loads(run.out)["dynamic"]
    assert found["window"] == 60.0
    assert (found["t"][0], found["t"][-1], len(found["t"])) == (60.0, 180.0, 41)
    n = found["axes"]["gx"]["coefficients"]["N"]
    whole = json.loads(run.out)["axes"]["gx"]["coefficients"]["N"]["value"]
    assert n["value"] == pytest.approx([whole] * 41, rel=0.1)


@pytest.mark.long
def test_window_longer_than_the_recording_gives_no_dynamic_curves(run_program: RunProgram, recording: Path) -> None:
    run = run_program("analyze", str(recording), "--window", "1h", "--json", "x.json")
    assert run.status == 3
    assert run.err == "imu-monitor: no dynamic curves: 180 s are recorded, less than the window of 3600 s\n"
    assert "N °/√h" in run.out
    result = json.loads(Path("x.json").read_bytes())
    assert result["axes"]["gx"]["coefficients"]["N"]["status"] == "estimated"
    assert "dynamic" not in result
    assert "no dynamic curves: 180 s are recorded, less than the window of 3600 s" in result["notes"]


def test_window_of_too_few_samples_is_refused(run_program: RunProgram, recording: Path) -> None:
    run = run_program("analyze", str(recording), "--window", "0.1")
    assert run.status == 2
    assert "window of 0.1 s: 10 samples at 100 Hz; possible are 1 to" in run.require_one_error_line()


@pytest.mark.long
@pytest.mark.parametrize("name", ["x.png", "x.html"])
def test_plot_format_follows_the_file_suffix(run_program: RunProgram, recording: Path, name: str) -> None:
    pytest.importorskip("matplotlib")
    pytest.importorskip("jinja2")
    run = run_program("analyze", str(recording), "--plot", name)
    assert run.status == 0
    assert "N °/√h" in run.out
    start = Path(name).read_bytes()[:15]
    assert start.startswith(b"\x89PNG" if name == "x.png" else b"<!DOCTYPE html>")


@pytest.mark.long
def test_motion_is_reported_and_removed_on_request(run_program: RunProgram, recording: Path) -> None:
    columns = np.loadtxt(recording, delimiter=",", skiprows=1)
    columns[9000:9300, 1] += np.sin(np.arange(300) / 20)
    save_samples(Path("moved.csv"), columns[:, 0], columns[:, 1:])
    left, struck = (
        json.loads(run_program("analyze", "moved.csv", *more, "--json", "-").out) for more in ((), ("--rest",))
    )
    [motion] = left["motions"]
    assert (motion["axis"], struck["motions"]) == ("gx", [motion])
    assert motion["t"] == pytest.approx(89.75, abs=0.3)
    assert "the sensor moved once, 3 s in all: not removed; --rest removes the samples in motion" in left["notes"]
    assert "the sensor moved once, 3 s in all: removed" in struck["notes"]
    n = [analysis["axes"]["gx"]["coefficients"]["N"]["value"] for analysis in (left, struck)]
    whole = json.loads(run_program("analyze", str(recording), "--json", "-").out)["axes"]["gx"]["coefficients"]["N"][
        "value"
    ]
    assert n[1] == pytest.approx(whole, rel=0.03)
    assert n[0] is None or n[0] > 1.5 * whole


# --- export ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
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
def test_model_is_exported(run_program: RunProgram, arguments: tuple[str, ...], message: list[str]) -> None:
    run = run_program("export", MODEL, "--format", *arguments)
    assert (run.status, run.err) == (0, "")
    assert "source: consumer-mems.toml" in run.out
    for word in message:
        assert word in run.out
    assert run_program("export", MODEL, "--format", *arguments, "--out", "x").out == "x written\n"
    assert Path("x").read_text() == run.out


def test_shipped_model_name_is_exported_like_its_file(run_program: RunProgram) -> None:
    for form in FORMATS:
        named, file = (run_program("export", source, "--format", form) for source in ("consumer-mems", MODEL))
        assert (named.status, named.err) == (0, "")
        assert named.out == file.out


@pytest.mark.parametrize(
    ("command", "usage", "argument"),
    [
        (("analyze",), "[OPTIONS] RECORDING", "  RECORDING  File"),
        (("reconcile",), "[OPTIONS] RECORDING…", "  RECORDING…  File"),
        (("export",), "[OPTIONS] [MODEL.toml|NAME|RESULT.json]...", "  MODEL.toml|NAME|RESULT.json  Model"),
        (("thermal", "fit"), "[OPTIONS] RECORDING", "  RECORDING  File"),
    ],
)
def test_help_names_arguments_without_types(
    run_program: RunProgram, command: tuple[str, ...], usage: str, argument: str
) -> None:
    text = run_program(*command, "--help").out
    assert text.splitlines()[0] == f"Usage: imu-monitor {' '.join(command)} {usage}"
    assert argument in text
    assert f"Example: imu-monitor {' '.join(command)} " in text


def test_help_describes_every_command_in_a_complete_line(run_program: RunProgram) -> None:
    text = run_program("--help").out
    lines = text.partition("Commands:\n")[2].partition("\n\n")[0].splitlines()
    assert len(lines) > 10
    assert all(line.endswith(".") and not line.endswith("...") for line in lines)


def test_help_lists_every_export_format() -> None:
    command = typer.main.get_command(app).commands["export"]  # type: ignore[attr-defined]
    [option] = [parameter for parameter in command.params if "--format" in parameter.opts]
    assert option.help.endswith(f": {', '.join(FORMATS)}.")


@pytest.mark.parametrize(
    ("option", "known"),
    [
        ("gyro_unit", units.RATE),
        ("accel_unit", units.ACCELERATION),
        ("temperature_unit", units.TEMPERATURE),
        ("time_unit", units.TIME),
    ],
)
def test_help_lists_every_unit(option: str, known: Mapping[str, object]) -> None:
    help_text = READING_OPTIONS[option].__metadata__[0].help
    assert set(known) <= set(re.split(r", |: |\.$", help_text))


def test_present_result_of_a_daemon_is_exported(run_program: RunProgram, monkeypatch: pytest.MonkeyPatch) -> None:
    endpoint, message = free_endpoint(), CoefficientsMessage.from_result("bench-1", 1.76e9, 0, make_estimate()).encode()
    Path("x.json").write_bytes(message)
    file_export = run_program("export", "x.json", "--format", "robot_localization")
    publisher = ZenohPublisher(ZenohTable(listen=(endpoint,)), ["bench-1", "bench-2"])
    publisher.start()
    try:
        wait_for(lambda: publisher.state == "ok")
        publisher.put(topics.COEFFICIENTS, "bench-1", message)
        arguments = ("export", "--format", "robot_localization", "--connect", endpoint)
        only, named = run_program(*arguments), run_program(*arguments, "--device", "bench-1")
        publisher.put(topics.COEFFICIENTS, "bench-2", message)
        several = run_program(*arguments)
        monkeypatch.setattr("monitor.publishing.zenoh.clients.PATIENCE_S", 1.0)
        absent = run_program(*arguments, "--device", "bench-3")
    finally:
        publisher.close()
    assert (file_export.status, file_export.err) == (0, "")
    assert "# source: device bench-1, live\n" in only.out
    assert only.out.replace("device bench-1, live", "x.json") == file_export.out
    assert named.out == only.out
    assert (several.status, absent.status) == (2, 1)
    assert "result of 2 devices; choose one with --device: bench-1, bench-2" in several.require_one_error_line()
    assert "no coefficients of bench-3 in 1 s (ok)" in absent.require_one_error_line()


@pytest.mark.long
def test_commands_read_a_table_with_other_columns_and_units(run_program: RunProgram, recording: Path) -> None:
    header, *rows = recording.read_text().splitlines()
    names = dict(zip(("t", "gx", "gy", "gz", "ax", "ay", "az"), "abcdefg", strict=True))
    Path("other.csv").write_text(";".join(names[name] for name in header.split(",")) + "\n" + "".join(
        f"{1e3 * float(t)!r};{';'.join(others)}\n".replace(".", ",") for t, *others in (row.split(",") for row in rows)
    ))  # fmt: skip
    mapping = ("--columns", ",".join(f"{quantity}={name}" for quantity, name in names.items()), "--time-unit", "ms")
    first = run_program("analyze", str(recording), "--json", "-")
    second = run_program("analyze", "other.csv", *mapping, "--json", "-")
    assert first.status == second.status == 0
    assert json.loads(first.out)["axes"] == json.loads(second.out)["axes"]
    assert run_program("compensate", "other.csv", *mapping, "--out", "x.npz").status in (0, 3)
    wrong = run_program("analyze", "other.csv", "--gyro-unit", "grad/s")
    assert wrong.require_one_error_line().startswith(
        'imu-monitor: --gyro-unit: "grad/s" is not a unit of angular rate;'
    )
    for command in (("thermal", "fit"), ("thermal", "predict", "--model", "x"), ("reconcile", "--out", "x")):
        line = run_program(*command, "other.csv", "--columns", "gq=a").require_one_error_line()
        assert line.startswith('imu-monitor: --columns: "gq"; possible are g')


def test_result_of_analyze_is_exported(
    run_program: RunProgram, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run_program("analyze", str(recording), "--json", "x.json").status == 0
    found = json.loads(Path("x.json").read_bytes())["axes"]
    run = run_program("export", "x.json", "--format", "kalibr")
    assert (run.status, run.err[:38]) == (0, "note: upper bounds instead of values: ")
    worst = max(found[axis]["coefficients"]["N"]["value"] for axis in ("gx", "gy", "gz"))
    assert f"gyroscope_noise_density: {worst:.6e}" in run.out
    with Path("x.json").open() as piped:
        monkeypatch.setattr(sys, "stdin", piped)
        assert run_program("export", "-", "--format", "kalibr").out == run.out.replace("source: x.json", "source: -")


def test_too_short_a_recording_exports_nothing(run_program: RunProgram) -> None:
    Path("x.csv").write_text("t,gx\n" + "".join(f"{i / 100},{i % 3}\n" for i in range(20)))
    assert run_program("analyze", "x.csv", "--json", "x.json").status == 3
    run = run_program("export", "x.json", "--format", "kalibr")
    assert run.status == 3
    assert (
        "nothing to export: no axis has any of Q, N, B, K, R: a longer recording is needed"
        in run.require_one_error_line()
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "nothing to export"),
        (b"[gz", "x: not TOML: "),
        (b"\xff\xfe", "x: cannot be read: "),
        (b"{", "x: not the JSON of an analysis: "),
        (b'{"schema": "imu-monitor/status/1", "axes": {}}', 'x: schema "imu-monitor/status/1"; an export needs'),
    ],
)
def test_invalid_export_source_is_reported_in_one_line(run_program: RunProgram, content: bytes, message: str) -> None:
    Path("x").write_bytes(content)
    run = run_program("export", "x", "--format", "kalibr")
    assert run.status == 2
    assert message in run.require_one_error_line()


# --- reconcile -------------------------------------------------------------------------------------

GYROS = "".join(f"[{axis}.angle_random_walk]\nN = 1.0e-4\n" for axis in AXES[:3])


@pytest.fixture(scope="session")
def recording_with_unmodeled_line(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write two minutes of three gyroscopes with a 17.3 Hz line on gz, which the model in ``model.toml`` lacks."""
    folder = tmp_path_factory.mktemp("hidden")
    n = 12_000
    values = 1e-3 * np.random.default_rng(3).standard_normal((n, 3))
    values[:, 2] += 3e-4 * np.sin(2.0 * np.pi * 17.3 * np.arange(n) / RATE_HZ)
    np.savez(folder / "bench.npz", fs=RATE_HZ, **dict(zip(AXES[:3], values.T, strict=True)))
    (folder / "model.toml").write_text(GYROS)
    return folder / "bench.npz"


@pytest.mark.long
def test_reconcile_names_the_missing_line_and_writes_a_model_with_it(
    run_program: RunProgram, recording_with_unmodeled_line: Path
) -> None:
    model = str(recording_with_unmodeled_line.with_name("model.toml"))
    run = run_program(
        "reconcile", str(recording_with_unmodeled_line), "--model", model, "--out", "found", "--seed", "4"
    )
    assert (run.status, run.err) == (0, "")
    assert re.search(r"Line at 17\.3 Hz", run.out)
    report = json.loads(Path("found/report.json").read_bytes())
    assert (report["verdict"], report["seed"]) == ("explained", 4)
    assert [step["effect"] for step in report["axes"]["gz"]["steps"]] == ["sinusoidal"]
    assert report["axes"]["gx"]["steps"] == []
    assert re.search(r"17\.(29|30)", Path("found/report.html").read_text("utf-8"))
    again = run_program(
        "reconcile", str(recording_with_unmodeled_line), "--model", "found/model.toml", "--out", "again", "--json", "-"
    )
    assert (again.status, again.err.splitlines()) == (0, ["again/report.html written", "again/model.toml written"])
    assert json.loads(again.out)["verdict"] == "agrees"
    assert json.loads(again.out) == json.loads(Path("again/report.json").read_bytes())


def test_reconcile_refuses_an_invalid_recording(run_program: RunProgram) -> None:
    run = run_program("reconcile", "nowhere.csv", "--out", "found")
    assert run.status == 2
    assert "nowhere.csv: cannot be read: No such file or directory" in run.require_one_error_line()
    Path("x.csv").write_bytes(b"t,gx\n")
    run = run_program("reconcile", "x.csv", "--out", "found")
    assert run.status == 2
    assert "x.csv: has a header line but no complete line of samples" in run.require_one_error_line()
    assert not list(Path().glob("found/*"))


def test_reconcile_refuses_an_invalid_model(run_program: RunProgram, recording_with_unmodeled_line: Path) -> None:
    Path("m.toml").write_text("[gz.sinusodal]\namplitude = 1.0\n")
    run = run_program("reconcile", str(recording_with_unmodeled_line), "--model", "m.toml", "--out", "found")
    assert run.status == 2
    assert 'did you mean "sinusoidal"?' in run.require_one_error_line()
    assert not Path("found").exists()


def test_reconcile_reports_an_unusable_output_folder_in_one_line(
    run_program: RunProgram, recording_with_unmodeled_line: Path
) -> None:
    Path("file").touch()
    for place in ("file", "file/found"):
        run = run_program("reconcile", str(recording_with_unmodeled_line), "--out", place)
        assert run.status == 2
        assert f"--out: {place}: cannot be" in run.require_one_error_line()


@pytest.mark.parametrize("target", ["-", "why.json"])
def test_reconcile_writes_a_report_of_a_too_short_recording(run_program: RunProgram, target: str) -> None:
    rows = np.random.default_rng(1).standard_normal(500)
    Path("x.csv").write_text("t,gx\n" + "".join(f"{i / 100},{x}\n" for i, x in enumerate(rows)))
    run = run_program("reconcile", "x.csv", "--out", "found", "--json", target)
    assert run.status == 3
    assert run.err.count("\n") == 1
    assert "500 samples; " in run.err
    assert [path.name for path in Path("found").iterdir()] == ["report.json"]
    for text in (Path("found/report.json").read_bytes(), run.out if target == "-" else Path(target).read_bytes()):
        report = json.loads(text)
        assert report["schema"] == "imu-monitor/reconcile/1"
        assert report["verdict"] is None
        assert "500 samples; " in report["why"]


def test_reconcile_of_a_constant_axis_gives_status_3(run_program: RunProgram) -> None:
    np.savez("x.npz", fs=100.0, gx=np.full(6000, 0.1))
    run = run_program("reconcile", "x.npz", "--out", "found")
    assert run.status == 3
    assert "gx: all samples have the same value" in run.err
    assert "gx: all samples have the same value" in json.loads(Path("found/report.json").read_bytes())["why"]


# --- as a process ----------------------------------------------------------------------------------


@pytest.mark.long
def test_progress_bar_is_erased_at_the_end(recording: Path) -> None:
    pty = pytest.importorskip("pty", reason="there are no pseudo-terminals here")
    master, terminal = pty.openpty()
    command = [*PROGRAM, "analyze", str(recording), "--window", "20"]
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "120"}
    with subprocess.Popen(command, stdin=terminal, stdout=terminal, stderr=terminal, env=environment) as process:
        os.close(terminal)
        shown = b""
        with contextlib.suppress(OSError):  # on Linux, reading from a closed pseudo-terminal raises OSError
            while part := os.read(master, 65_536):
                shown += part
        assert process.wait(PATIENCE_S) == 0
    os.close(master)
    assert b"dynamic curves" in shown
    assert shown.rindex(b"\x1b[2K") < shown.index(b"Gyroscopes")  # erased before the table


@pytest.mark.long
def test_interrupted_analysis_ends_in_one_line(tmp_path: Path) -> None:
    values = np.random.default_rng(1).standard_normal((20_000, 6))
    np.savez(tmp_path / "long.npz", fs=100.0, **dict(zip(AXES, values.T, strict=True)))
    source = """
import sys
import threading
import monitor.commands.analyze as offline
from imu_monitor import main
def report_start(*values, **options):
    print("working", file=sys.stderr, flush=True)
    from monitor.estimation.allan.dynamic_allan import compute_dynamic_allan
    while True:
        compute_dynamic_allan(*values, **options)
offline.compute_dynamic_allan = report_start
main()
"""
    with run_daemon([sys.executable, "-c", source, "analyze", str(tmp_path / "long.npz"), "--window", "100"]) as daemon:
        daemon.wait_for_line("working")
        assert daemon.signal_and_wait(signal.SIGINT) == 128 + signal.SIGINT
        assert daemon.read_remaining_errors() == "imu-monitor: interrupted\n"


@pytest.mark.long
def test_signal_ends_reconcile_without_traceback(tmp_path: Path) -> None:
    values = np.random.default_rng(1).standard_normal((20_000, 6))
    np.savez(tmp_path / "long.npz", fs=100.0, **dict(zip(AXES, values.T, strict=True)))
    source = """
import sys
import threading
import monitor.commands.reconcile as reconciling
from imu_monitor import main
original = reconciling.reconcile
def report_start(recording, model, seed, each, tell):
    print("working", file=sys.stderr, flush=True)
    while True:
        original(recording, model, seed, each, tell)
reconciling.reconcile = report_start
main()
"""
    command = [sys.executable, "-c", source, "reconcile", str(tmp_path / "long.npz"), "--out", str(tmp_path / "found")]
    with run_daemon(command) as daemon:
        daemon.wait_for_line("working")
        assert daemon.signal_and_wait(signal.SIGTERM) == 128 + signal.SIGTERM
        assert "Traceback" not in daemon.read_remaining_errors()
    assert not list((tmp_path / "found").iterdir())


def test_invalid_config_ends_a_real_process_with_status_2(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text(VIRTUAL + "windw = 1.0\n")
    completed = run_in_subprocess("run", "c.toml", cwd=tmp_path, env={**os.environ, "PYTHONPATH": os.getcwd()})
    assert (completed.returncode, completed.stdout) == (2, "")
    assert completed.stderr.splitlines() == [
        'imu-monitor: c.toml: device bench-1: windw: unknown key; did you mean "window"?',
    ]


@pytest.mark.long
@pytest.mark.parametrize(
    "arguments", [("check", "--print-defaults"), ("analyze", "RECORDING", "--json", "-"), ("--help",)]
)
def test_closed_output_pipe_causes_no_traceback(recording: Path, arguments: tuple[str, ...]) -> None:
    """``imu-monitor … | head -1`` closes the pipe in this way."""
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "wb") as closed:
        command = [*PROGRAM, *(str(recording) if word == "RECORDING" else word for word in arguments)]
        completed = subprocess.run(command, stdout=closed, stderr=subprocess.PIPE, timeout=PATIENCE_S, check=False)
    assert (completed.returncode, completed.stderr) == (1, b"")


@pytest.mark.long
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
@pytest.mark.parametrize("arguments", [("RECORDING", "--json", "-"), ("RECORDING",)])
def test_full_disk_behind_standard_output_is_reported_in_one_line(recording: Path, arguments: tuple[str, ...]) -> None:
    with open("/dev/full", "wb") as full:
        command = [*PROGRAM, "analyze", *(str(recording) if word == "RECORDING" else word for word in arguments)]
        completed = subprocess.run(
            command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=PATIENCE_S, check=False
        )
    assert completed.returncode == 1
    assert completed.stderr.count("\n") == 1
    assert "No space left" in completed.stderr


class DaemonProcess:
    """The program in a process of its own, with the lines that it has written to standard error."""

    def __init__(self, command: list[str]) -> None:
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        self.lines: list[str] = []

    def wait_for_line(self, word: str) -> None:
        """Wait for a line with this word on standard error."""
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.lines.append(line)
            if word in line:
                return
        raise AssertionError(f"the program ended without writing {word}: {''.join(self.lines)}")

    def signal_and_wait(self, number: int) -> int:
        self.process.send_signal(number)
        return self.process.wait(PATIENCE_S)

    def read_remaining_errors(self) -> str:
        assert self.process.stderr is not None
        return self.process.stderr.read()


@contextlib.contextmanager
def run_daemon(command: list[str]) -> Iterator[DaemonProcess]:
    daemon = DaemonProcess(command)
    try:
        yield daemon
    finally:
        daemon.process.kill()
        daemon.process.wait(PATIENCE_S)
        assert daemon.process.stderr is not None
        daemon.process.stderr.close()


@pytest.mark.long
@pytest.mark.parametrize(("command", "number"), [("demo", signal.SIGINT), ("run", signal.SIGTERM)])
def test_signal_stops_the_daemon_cleanly(tmp_path: Path, command: str, number: int) -> None:
    if command == "run":
        (tmp_path / "c.toml").write_text(VIRTUAL + QUIET)
        arguments = ["run", str(tmp_path / "c.toml")]
    else:
        arguments = ["demo", "--viewer", "none"]
    with run_daemon([*PROGRAM, *arguments]) as daemon:
        daemon.wait_for_line("state=running")
        assert daemon.signal_and_wait(number) == 0
        assert "Traceback" not in daemon.read_remaining_errors()
    port = next(match[1] for line in daemon.lines if (match := re.search(r"waiting for (\S+)/tty", line)))
    assert not Path(port).exists()  # the simulated port has been removed


@pytest.mark.parametrize(("result", "status"), [(None, 0), (3, 3)])  # None is the result of the commands of the daemon
def test_thread_that_computes_does_not_abort_the_program_at_its_end(result: int | None, status: int) -> None:
    """A thread that is in a transform when the interpreter ends would abort the process with SIGABRT."""
    source = f"""
import atexit, threading
import numpy as np
import scipy.fft
import imu_monitor
import monitor.cli
started = threading.Event()
values = np.ones(1 << 21)
def transform():
    while True:
        scipy.fft.dct(values)
        started.set()
def command(**_):
    atexit.register(print, "orderly")
    threading.Thread(target=transform, daemon=True).start()
    started.wait()
    return {result}
monitor.cli.app = command
imu_monitor.main()
"""
    run = subprocess.run(
        [sys.executable, "-c", source], capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert (run.returncode, run.stdout, run.stderr) == (status, "orderly\n", "")


@pytest.mark.long
def test_second_interrupt_ends_the_daemon_at_once() -> None:
    source = """
import sys, time
import monitor.daemon.service
from monitor.cli import main
def block(self):
    print("draining", file=sys.stderr, flush=True)
    time.sleep(86_400.0)
monitor.daemon.service.Service._drain = block
sys.argv = ["imu-monitor", "demo", "--viewer", "none"]
main()
"""
    with run_daemon([sys.executable, "-c", source]) as daemon:
        daemon.wait_for_line("state=running")
        daemon.process.send_signal(signal.SIGINT)
        daemon.wait_for_line("draining")
        assert daemon.signal_and_wait(signal.SIGINT) == -signal.SIGINT


RECORDING_DEMO = """
import json, sys
import monitor.daemon.service
from drivers.data_types import concatenate_blocks
from imu_monitor import main  # ends the process although daemon threads are running
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
"""Demo that finally prints the number of each published sample and the numbers of samples made and dropped."""


def test_demo_receives_every_sample_its_sensor_sent() -> None:
    begun_s = time.monotonic()
    completed = run_demo_until_running(
        [sys.executable, "-c", RECORDING_DEMO], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    took_s = time.monotonic() - begun_s
    assert completed.returncode == 0, completed.stderr
    assert took_s >= 2.0  # a lower bound holds on any machine
    assert "1 running" in completed.stdout
    assert "Traceback" not in completed.stderr
    row = next(line for line in completed.stdout.splitlines() if re.match(r"demo\s", line))
    received, lost, bad = map(int, re.findall(r"running\s+\S+\s+(\d+)\s+(\d+)\s+(\d+)", row)[0])
    numbers, simulated, dropped = json.loads(completed.stderr.splitlines()[-1])
    # The sensor's counter shows whether each sample up to the newest was received or is known to be missing.
    assert received == len(numbers) > 0
    assert received + lost + bad == numbers[-1] - numbers[0] + 1
    assert numbers[-1] < simulated <= 100.0 * took_s
    # A simulated sensor drops samples if the terminal of a loaded machine is full. Nothing else may be missing.
    assert lost + bad <= dropped


@pytest.mark.long
@pytest.mark.parametrize("where", ["full disk", "closed pipe"])
def test_unwritable_log_does_not_stop_sampling(where: str) -> None:
    if where == "full disk":
        if not Path("/dev/full").exists():
            pytest.skip("there is no /dev/full here")
        log = os.open("/dev/full", os.O_WRONLY)
    else:
        reading, log = os.pipe()
        os.close(reading)
    with os.fdopen(log, "wb") as closed:
        completed = run_demo_until_running(stdout=subprocess.PIPE, stderr=closed)
    assert completed.returncode == 0
    assert "1 running" in completed.stdout


def run_demo_until_running(program: Sequence[str] = PROGRAM, **pipes: Any) -> "subprocess.CompletedProcess[str]":
    """Run the demo for a few seconds, or longer if a loaded machine needs longer to start the sensor."""
    for seconds in (2, 5, 20, 80):
        command = [*program, "demo", "--seconds", str(seconds), "--viewer", "none"]
        completed = subprocess.run(command, text=True, timeout=seconds + PATIENCE_S, check=False, **pipes)
        if completed.returncode != 0 or "1 running" in completed.stdout:
            break
    return completed


# --- sockets ---------------------------------------------------------------------------------------


def wait_for_bound_addresses(process: psutil.Process, least: int) -> list[tuple[str, int]]:
    """Return the bound addresses once there are at least this many."""
    return (
        wait_for(lambda: found if len(found := list_bound_addresses(process)) >= least else None, f"{least} sockets")
        or []
    )


def list_bound_addresses(process: psutil.Process) -> list[tuple[str, int]]:
    """Return the addresses on which the process and its children accept packets or connections."""
    found = set()  # a child that is just starting has the sockets of its parent
    for relative in (process, *process.children(recursive=True)):
        with contextlib.suppress(psutil.Error):
            for opened in relative.net_connections("inet"):
                if opened.status == psutil.CONN_LISTEN or (opened.type == socket.SOCK_DGRAM and opened.laddr):
                    found.add((opened.laddr.ip, opened.laddr.port))
    return sorted(found)


@pytest.mark.long
def test_defaults_listen_on_loopback_only() -> None:
    """Zenoh, Rerun's server and its web page listen."""
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    with run_daemon([*PROGRAM, "demo", "--viewer", "web"]) as daemon:
        daemon.wait_for_line("state=running")
        addresses = wait_for_bound_addresses(psutil.Process(daemon.process.pid), 3)
        assert len(addresses) >= 3, addresses
        assert {address for address, _ in addresses} <= {"127.0.0.1", "::1"}
        assert daemon.signal_and_wait(signal.SIGTERM) == 0, daemon.read_remaining_errors()


@pytest.mark.long
def test_zenoh_file_without_scouting_does_not_enable_scouting(tmp_path: Path) -> None:
    """A Zenoh file that only configures TLS must not enable scouting."""
    (tmp_path / "zenoh.json5").write_text("{ /* nothing of scouting */ transport: {} }")
    (tmp_path / "c.toml").write_text(VIRTUAL + '[zenoh]\nconfig = "zenoh.json5"\n[viewer]\nmode = "none"\n')
    with run_daemon([*PROGRAM, "run", str(tmp_path / "c.toml")]) as daemon:
        daemon.wait_for_line("state=running")
        addresses = wait_for_bound_addresses(psutil.Process(daemon.process.pid), 1)
        assert len(addresses) == 1
        assert addresses[0][0] == "127.0.0.1"


@pytest.mark.long
def test_watch_opens_no_listening_socket() -> None:
    with run_daemon([*PROGRAM, "watch", "--seconds", "3"]) as daemon:
        process = psutil.Process(daemon.process.pid)
        opened = False
        while daemon.process.poll() is None:
            with contextlib.suppress(psutil.Error):  # the process may end at any moment
                opened = opened or any("zenoh" in Path(file.path).name for file in process.memory_maps())
            assert list_bound_addresses(process) == []
            time.sleep(0.1)
        assert opened
        assert daemon.process.wait(PATIENCE_S) == 0


# --- history


@pytest.fixture(scope="session")
def history_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write two hours of history of two devices."""
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
def test_history_prints_plots_and_exports(run_program: RunProgram, history_folder: Path, tmp_path: Path) -> None:
    run = run_program(
        "history", str(history_folder), "--device", "bench-1", "--axis", "gz",
        "--json", "h.json", "--out", "h.csv", "--plot", "h.png",
    )  # fmt: skip
    assert (run.status, run.err) == (0, "")
    assert "bench-1: 2025-11-21 00:00 to 2025-11-21 02:00 UTC, 120 rows of 1 min, 720,000 samples" in run.out
    assert "moved 100" in run.out
    history = json.loads((tmp_path / "h.json").read_bytes())
    assert (history["schema"], history["device"], len(history["start"])) == ("imu-monitor/history/1", "bench-1", 120)
    assert history["axes"]["gz"]["N"]["n"] == [600] * 120
    header, *rows = (tmp_path / "h.csv").read_text().splitlines()
    assert header.startswith("t (Unix s),width (s),gz.N (rad/sqrt(s))")
    assert len(rows) == 120
    assert (tmp_path / "h.png").stat().st_size > 10_000


def test_history_accepts_a_time_range_and_a_step(run_program: RunProgram, history_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text(f'{VIRTUAL}[storage]\nfolder = "{history_folder}"\n')
    more = ("--from", "2025-11-21T00:30", "--to", "2025-11-21 01:30", "--step", "15min")
    run = run_program("history", "c.toml", "--device", "bench-2", "--json", "-", *more)
    history = json.loads(run.out)
    assert run.status == 0
    assert history["start"] == [1_763_683_200 + 900 * i for i in range(2, 6)]
    assert history["axes"]["gz"]["N"]["n"] == [9000] * 4


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
        (("{kept}", "--out", "h.xls"), 2, "tables are written as .csv"),
        (("{kept}", "--connect", "tcp/127.0.0.1:1"), 2, "not both"),
        ((".",), 2, "history.sqlite: no such file"),
        (("absent.toml",), 2, "no such file"),
        (("--connect", "here"), 2, "not a valid endpoint"),
    ],
)
def test_invalid_history_request_is_reported_in_one_line(
    run_program: RunProgram, history_folder: Path, arguments: tuple[str, ...], status: int, line: str
) -> None:
    run = run_program("history", *(argument.replace("{kept}", str(history_folder)) for argument in arguments))
    assert run.status == status
    assert line in run.require_one_error_line()


def test_history_option_without_storage_is_refused(run_program: RunProgram, tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text(VIRTUAL + QUIET)
    run = run_program("run", "c.toml", "--history", "1d")
    assert run.status == 2
    assert (
        run.require_one_error_line() == "imu-monitor: --history: there is no history to show; set folder in [storage]\n"
    )
    assert "not a duration" in run_program("run", "c.toml", "--history", "long").require_one_error_line()


def test_history_command_without_storage_is_refused(run_program: RunProgram, tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text(VIRTUAL)
    run = run_program("history", "c.toml")
    assert run.status == 2
    assert "[storage] has no folder" in run.require_one_error_line()


def test_history_of_a_running_daemon_equals_the_stored_history(
    run_program: RunProgram, history_folder: Path, tmp_path: Path
) -> None:
    from monitor.daemon.service import Service
    from tests.support.ports import free_endpoint

    endpoint = free_endpoint()
    history_folder = Path(shutil.copytree(history_folder, tmp_path / "kept"))  # the daemon adds to it
    zenoh = f'[zenoh]\nlisten = ["{endpoint}"]\n[viewer]\nmode = "none"\n'
    (tmp_path / "c.toml").write_text(f'{VIRTUAL}{zenoh}[storage]\nrecord = false\nfolder = "{history_folder}"\n')
    service = Service(load_config(tmp_path / "c.toml"))
    thread = threading.Thread(target=service.run, args=(FOREVER_S,))
    thread.start()
    try:
        wait_for(lambda: service.zenoh.state == "ok")
        span = ("--from", "2025-11-21", "--to", "2025-11-22")
        run = run_program("history", "--connect", endpoint, "--json", "-", *span)
        local = run_program("history", str(history_folder), "--device", "bench-1", "--json", "-", *span)
        empty = run_program("history", "--connect", endpoint, "--from", "2000-01-01", "--to", "2000-01-02")
    finally:
        service.request_stop()
        thread.join(PATIENCE_S)
    assert not thread.is_alive()
    received, stored = json.loads(run.out), json.loads(local.out)
    assert (received["axes"], received["start"]) == (stored["axes"], stored["start"])
    assert empty.status == 3
    assert "no results in this time range" in empty.require_one_error_line()


# --- unexpected errors


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
def test_unexpected_error_is_reported_in_one_line(
    error: Exception, status: int, line: str, run_program: RunProgram, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("monitor.commands.recording_loading.load_recording", fail)
    run = run_program("analyze", "a.csv")
    assert line in run.require_one_error_line()
    assert len(run.err) < 1000
    assert run.status == status
    for arguments in (("--debug", "analyze", "a.csv"), ("analyze", "a.csv", "--debug")):
        run = run_program(*arguments)
        assert run.status == status
        assert run.err.startswith("Traceback (most recent call last):")
        assert line in run.err


@pytest.mark.parametrize("debug", [False, True])
def test_failed_thread_is_reported_in_one_line(
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
    ("arguments", "message"),
    [
        (
            ("export", "m.toml"),
            "Missing option '--format' (FORMAT): Program that reads the parameters: kalibr, allan_variance_ros, ",
        ),
        (
            ("simulate", "m.toml", "--seconds", "1"),
            "Missing option '--out' (FILE): Recording to write: .csv, .csv.gz",
        ),
        (("simulate", "m.toml"), "Missing option '--seconds' (S): Duration in s"),
        (("compensate", "a.csv"), "Missing option '--out' (FILE): Compensated recording to write"),
        (("reconcile", "a.csv"), "Missing option '--out' (DIR): Folder for the report"),
        (
            ("thermal", "predict", "a.csv"),
            "Missing option '--model' (MODEL.json): Model file that thermal fit has",
        ),
        (
            ("analyze",),
            "Missing argument 'RECORDING': File of a recording, or folder of segments. See imu-monitor analyze --help",
        ),
        (("analyze", "a.csv", "--rte", "1"), "No such option: --rte of imu-monitor analyze; did you mean --rate?"),
        (
            ("analyze", "a.csv", "--xyz"),
            "No such option: --xyz of imu-monitor analyze; known are --tau, --window, --rest, --units, --json,",
        ),
        (("thermal", "fitt", "a.csv"), "Did you mean 'fit'?"),
        (("quux",), "known are demo, run, check, "),
        ((), "Missing command; known are demo, run, check, "),
        ((), "history, export, thermal. See imu-monitor --help"),  # without the hidden command
        (("thermal",), "Missing command; known are fit, predict"),
    ],
)
def test_missing_or_unknown_names_are_reported_with_the_possible_ones(
    arguments: tuple[str, ...], message: str, run_program: RunProgram
) -> None:
    run = run_program(*arguments)
    assert message in run.require_one_error_line()
    assert run.status == 2
