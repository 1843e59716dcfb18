"""Tests of unusual environments: foreign packages with the program's names, variables, closed streams and folders.

The program runs from a script as pip installs it. In each environment, the program succeeds or reports in one line why
it cannot.
"""

import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

import imu_monitor
from drivers.data_types import AXES
from monitor.common.shipped_config_paths import CONFIG_FOLDER
from monitor.daemon.operations import reconcile_on_request

ROOT: Final = Path(imu_monitor.__file__).resolve().parents[1]
SCRIPT: Final = "import sys\nfrom imu_monitor import main\nsys.exit(main())\n"
DEMO: Final = str(CONFIG_FOLDER / "demo.toml")
FOREIGN_SOURCE: Final = 'raise RuntimeError("a foreign package was imported")\n'
TIMEOUT_S: Final = 600.0
"""Time limit that only a program that hangs reaches, even on a loaded machine."""
pytestmark = pytest.mark.timeout(900)
REGULAR_USER: Final = os.geteuid() != 0

Run = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture
def script(tmp_path: Path) -> Path:
    """Write the script that pip creates for ``imu-monitor = "imu_monitor:main"``."""
    path = tmp_path / "bin" / "imu-monitor"
    path.parent.mkdir()
    path.write_text(SCRIPT)
    return path


@pytest.fixture
def run(script: Path, tmp_path: Path) -> Run:
    def run_script(*arguments: str, environment: Mapping[str, str | None] | None = None, **more: Any) -> Any:
        changed = os.environ | {"PYTHONPATH": str(ROOT)} | (environment or {})
        variables = {name: value for name, value in changed.items() if value is not None}
        more = {"cwd": tmp_path, "capture_output": True, "text": True, "timeout": TIMEOUT_S} | more
        return subprocess.run([sys.executable, str(script), *arguments], env=variables, check=False, **more)

    return run_script


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "r.npz"
    rng = np.random.default_rng(1)
    np.savez(path, fs=100.0, **{axis: 1e-3 * rng.standard_normal(2000) for axis in AXES})  # type: ignore[arg-type]
    return path


def check_success(done: "subprocess.CompletedProcess[str]") -> None:
    """Check that the exit status is 0 and standard error is empty."""
    assert (done.returncode, done.stderr) == (0, "")


def check_one_line_error(done: "subprocess.CompletedProcess[str]", status: int) -> str:
    assert done.returncode == status, done.stderr
    assert done.stderr.startswith("imu-monitor: ")
    assert done.stderr.count("\n") == 1, done.stderr
    return done.stderr


# --- foreign packages

ON_DEMAND: Final = pytest.mark.attack
"""Mark of most cases, because each process takes about a second."""
FOREIGN_FORMS: Final = (
    "packages",
    "sitecustomize",
    pytest.param("modules", marks=ON_DEMAND),
    pytest.param("namespaces", marks=ON_DEMAND),
)


def create_foreign_packages(folder: Path, form: str) -> Path:
    """Create a folder with foreign packages that have the names of the program's packages."""
    folder.mkdir()
    for name in ("monitor", "drivers", "config"):
        if form in ("packages", "namespaces"):
            (folder / name).mkdir()
            (folder / name / "errors.py").write_text(FOREIGN_SOURCE)
        if form == "packages":
            (folder / name / "__init__.py").write_text(FOREIGN_SOURCE)
        elif form == "modules":
            (folder / f"{name}.py").write_text(FOREIGN_SOURCE)
        elif form == "sitecustomize":
            (folder / f"{name}.py").write_text("OWN = False\n")
    if form == "sitecustomize":
        (folder / "sitecustomize.py").write_text("import monitor, drivers, config\n")
    return folder


@pytest.mark.parametrize("form", FOREIGN_FORMS)
def test_program_finds_its_packages_behind_foreign_ones_on_the_module_path(form: str, run: Run, tmp_path: Path) -> None:
    path = create_foreign_packages(tmp_path / "ros", form)
    done = run("check", DEMO, environment={"PYTHONPATH": f"{path}{os.pathsep}{ROOT}"})
    check_success(done)
    assert "1 device, no mistakes" in done.stdout


@pytest.mark.parametrize(
    "form", ["modules", *(pytest.param(one, marks=ON_DEMAND) for one in ("packages", "namespaces"))]
)
def test_program_finds_its_packages_despite_foreign_ones_in_the_current_folder(form: str, tmp_path: Path) -> None:
    """The option ``-m`` puts the current folder at the front of the module path."""
    path = create_foreign_packages(tmp_path / "ros", form)
    command = [sys.executable, "-m", "imu_monitor", "check", DEMO]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        command, cwd=path, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
    )
    check_success(done)


def test_child_process_of_the_daemon_runs_the_same_program(tmp_path: Path) -> None:
    path = create_foreign_packages(tmp_path / "ros", "packages")
    environment = os.environ | {"PYTHONPATH": str(path)}
    command = [*reconcile_on_request.COMMAND, "--help"]
    done = subprocess.run(
        command, cwd=path, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
    )
    check_success(done)
    assert "--model" in done.stdout


def test_doctor_reports_foreign_packages(run: Run, tmp_path: Path) -> None:
    path = create_foreign_packages(tmp_path / "ros", "packages")
    done = run("doctor", "--json", "-", environment={"PYTHONPATH": f"{path}{os.pathsep}{ROOT}"})
    for name in ("monitor", "drivers"):
        assert f"{path / name / '__init__.py'}: is found before the program's own package {name}" in done.stdout
    assert "are the program's own" in run("doctor", "--json", "-").stdout


@pytest.mark.parametrize("missing", ["monitor", "drivers", "config"])
def test_missing_or_foreign_package_folder_is_named(missing: str, tmp_path: Path) -> None:
    """Another distribution can overwrite a folder, because pip does not prevent it."""
    for name in ("monitor", "drivers", "config"):
        (tmp_path / name).mkdir()
        if name != missing:
            file = tmp_path / name / imu_monitor.REQUIRED[name]
            file.parent.mkdir(exist_ok=True)
            file.touch()
    shutil.copytree(ROOT / "imu_monitor", tmp_path / "imu_monitor")
    command = [sys.executable, "-m", "imu_monitor", "check", DEMO]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    assert f"{tmp_path / missing}: is missing or belongs to another package" in check_one_line_error(done, 1)


def test_module_path_keeps_its_order(tmp_path: Path) -> None:
    """If the folder of the program came first, a module in this folder could replace a standard module."""
    code = (
        "import sys, imu_monitor; before = list(sys.path); imu_monitor.bind_own_packages(); assert sys.path == before"
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, check=True)


# --- variables

ENVIRONMENTS: Final[dict[str, dict[str, str | None]]] = {
    "no HOME": {"HOME": None},
    "HOME does not exist": {"HOME": "/nonexistent/home"},
    "empty HOME": {"HOME": ""},
    "no LANG": {"LANG": None, "LC_ALL": None, "LC_CTYPE": None},
    "odd LANG": {"LANG": "xx_YY.KOI9", "LC_ALL": "xx_YY.KOI9"},
    "C locale without UTF-8": {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"},
    "ASCII streams": {"PYTHONIOENCODING": "ascii:strict"},
    "warnings are errors": {"PYTHONWARNINGS": "error"},
    "all warnings": {"PYTHONWARNINGS": "always", "PYTHONDEVMODE": None},
    "no assertions": {"PYTHONOPTIMIZE": "2"},
    "safe path": {"PYTHONSAFEPATH": "1"},
    "TMPDIR does not exist": {"TMPDIR": "/nonexistent/tmp"},
    "one column": {"COLUMNS": "1"},
    "no columns": {"COLUMNS": "0", "LINES": "0"},
    "absurd columns": {"COLUMNS": "99999999999999999999"},
    "columns as text": {"COLUMNS": "wide"},
    "dumb terminal": {"TERM": "dumb"},
    "no terminal": {"TERM": None},
    "Numba's cache cannot be written": {"NUMBA_CACHE_DIR": "/proc/1/nowhere"},
    "absurd threads": {"OMP_NUM_THREADS": "-1", "OPENBLAS_NUM_THREADS": "many"},
    "no PATH": {"PATH": ""},
}
DEFAULT_ENVIRONMENTS: Final = ("C locale without UTF-8", "warnings are errors", "no columns")


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name in DEFAULT_ENVIRONMENTS else ON_DEMAND) for name in ENVIRONMENTS],
)
def test_analyze_with_unusual_variables(name: str, run: Run, recording: Path) -> None:
    """The table of ``analyze`` contains non-ASCII letters, and standard error stays empty."""
    done = run("analyze", str(recording), environment=ENVIRONMENTS[name], timeout=TIMEOUT_S)
    check_success(done)
    assert "2000" in re.sub(r"\s", "", done.stdout)


@pytest.mark.attack
@pytest.mark.parametrize("name", ENVIRONMENTS)
@pytest.mark.parametrize("arguments", [("check", DEMO), ("doctor",), ("--help",), ("analyze", "absent.csv")])
def test_other_commands_with_unusual_variables(name: str, arguments: tuple[str, ...], run: Run) -> None:
    done = run(*arguments, environment=ENVIRONMENTS[name])
    assert done.returncode in (0, 1, 2)
    assert "Traceback" not in done.stderr
    assert done.stderr.count("\n") == (1 if done.returncode == 2 else 0), done.stderr


@ON_DEMAND
def test_read_only_home(run: Run, recording: Path, tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir(mode=0o500)
    check_success(run("analyze", str(recording), environment={"HOME": str(home)}))


# --- folders and streams


def test_removed_current_folder(script: Path, recording: Path, tmp_path: Path) -> None:
    for arguments, status in ((("analyze", str(recording)), 0), (("simulate", "x", "--seconds", "1", "--out", "y"), 1)):
        folder = tmp_path / "gone"
        folder.mkdir()
        command = " ".join(f"'{word}'" for word in (sys.executable, str(script), *arguments))
        done = subprocess.run(
            ["sh", "-c", f"rmdir ../gone && exec {command}"],
            cwd=folder, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, timeout=TIMEOUT_S,
            check=False,
        )  # fmt: skip
        assert done.returncode == status, done.stderr
        if status:
            assert "the current folder has been removed" in check_one_line_error(done, status)


@ON_DEMAND
@pytest.mark.skipif(not REGULAR_USER, reason="nothing is forbidden to root")
def test_unreadable_current_folder(run: Run, recording: Path, tmp_path: Path) -> None:
    folder = tmp_path / "closed"
    folder.mkdir(mode=0o100)
    check_success(run("analyze", str(recording), cwd=folder))


@ON_DEMAND
def test_path_with_spaces_and_non_ascii_letters(run: Run, recording: Path, tmp_path: Path) -> None:
    folder = tmp_path / "Prüfstand Nr. 1 – 測定"
    folder.mkdir()
    shutil.copy(recording, folder / "Aufnahme 1.npz")
    check_success(run("analyze", "Aufnahme 1.npz", "--json", "Ergebnis.json", cwd=folder))
    assert (folder / "Ergebnis.json").stat().st_size > 0


@ON_DEMAND
def test_file_name_that_is_not_valid_utf8(run: Run, recording: Path, tmp_path: Path) -> None:
    path = os.fsencode(tmp_path) + b"/a\xff.npz"
    shutil.copy(os.fsencode(recording), path)
    check_success(run("analyze", os.fsdecode(path)))
    check_one_line_error(run("analyze", os.fsdecode(path[:-4] + b"b.npz")), 2)


CLOSED_STREAMS: Final = {"input": "<&-", "output": ">&-", "errors": "2>&-", "all": "<&- >&- 2>&-"}


@pytest.mark.parametrize(
    "streams", ["all", *(pytest.param(one, marks=ON_DEMAND) for one in CLOSED_STREAMS if one != "all")]
)
@pytest.mark.parametrize("missing_file", [False, True])
def test_closed_streams(streams: str, missing_file: bool, script: Path, recording: Path, tmp_path: Path) -> None:
    """A closed output is an error only if there is something to print. Files are always complete."""
    arguments = [str(recording), "--json", "result.json"] if not missing_file else ["absent.npz"]
    command = " ".join(f"'{word}'" for word in (sys.executable, str(script), "analyze", *arguments))
    done = subprocess.run(
        ["sh", "-c", f"exec {command} {CLOSED_STREAMS[streams]}"],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, timeout=TIMEOUT_S,
        check=False,
    )  # fmt: skip
    printed = streams in ("output", "all") and not missing_file
    assert done.returncode == (2 if missing_file else 1 if printed else 0), done.stderr
    if streams in ("errors", "all"):
        assert done.stderr == ""
    elif missing_file or printed:
        check_one_line_error(done, done.returncode)
    else:
        assert done.stderr == ""
    if not missing_file:
        text = (tmp_path / "result.json").read_text()
        assert text.startswith("{")
        assert text.endswith("}\n")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_full_disk_of_standard_output_is_reported(run: Run, recording: Path) -> None:
    for arguments in (("check", DEMO), ("analyze", str(recording))):
        with open("/dev/full", "w", encoding="ascii") as full:
            done = run(*arguments, capture_output=False, stdout=full, stderr=subprocess.PIPE)
        assert "No space left on device" in check_one_line_error(done, 1)


@ON_DEMAND
def test_closed_pipe_of_standard_output_causes_no_message(script: Path, recording: Path, tmp_path: Path) -> None:
    command = " ".join(f"'{word}'" for word in (sys.executable, str(script), "analyze", str(recording)))
    done = subprocess.run(
        ["sh", "-c", f"{command} | true"],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, timeout=TIMEOUT_S,
        check=False, preexec_fn=lambda: signal.signal(signal.SIGPIPE, signal.SIG_DFL),
    )  # fmt: skip
    assert done.stderr == ""
