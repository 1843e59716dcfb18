"""Hostile environments: foreign packages of the program's names, no home, odd locales, closed streams, no folder.

The program runs as its console script does: a script of two lines in a folder of its own, found over ``PATH``. In each
environment it does its work or says in one line why it cannot.
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

ROOT: Final = Path(imu_monitor.__file__).resolve().parent
SCRIPT: Final = "import sys\nfrom imu_monitor import main\nsys.exit(main())\n"
DEMO: Final = str(CONFIG_FOLDER / "demo.toml")
FOREIGN: Final = 'raise RuntimeError("a foreign package was imported")\n'
TIMEOUT_S: Final = 600.0
"""Bound that only a program that hangs reaches, on a loaded machine too."""
pytestmark = pytest.mark.timeout(900)
REGULAR_USER: Final = os.geteuid() != 0

Run = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture
def script(tmp_path: Path) -> Path:
    """What pip writes for ``imu-monitor = "imu_monitor:main"``."""
    path = tmp_path / "bin" / "imu-monitor"
    path.parent.mkdir()
    path.write_text(SCRIPT)
    return path


@pytest.fixture
def run(script: Path, tmp_path: Path) -> Run:
    def call(*arguments: str, environment: Mapping[str, str | None] | None = None, **more: Any) -> Any:
        changed = os.environ | {"PYTHONPATH": str(ROOT)} | (environment or {})
        given = {name: value for name, value in changed.items() if value is not None}
        more = {"cwd": tmp_path, "capture_output": True, "text": True, "timeout": TIMEOUT_S} | more
        return subprocess.run([sys.executable, str(script), *arguments], env=given, check=False, **more)

    return call


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "r.npz"
    rng = np.random.default_rng(1)
    np.savez(path, fs=100.0, **{axis: 1e-3 * rng.standard_normal(2000) for axis in AXES})  # type: ignore[arg-type]
    return path


def well(done: "subprocess.CompletedProcess[str]") -> None:
    """Nothing on standard error, and status 0."""
    assert (done.returncode, done.stderr) == (0, "")


def one_line(done: "subprocess.CompletedProcess[str]", status: int) -> str:
    assert done.returncode == status, done.stderr
    assert done.stderr.startswith("imu-monitor: ")
    assert done.stderr.count("\n") == 1, done.stderr
    return done.stderr


# --- foreign packages

ON_DEMAND: Final = pytest.mark.attack
"""A process takes about a second: few are started by default."""
FORMS: Final = (
    "packages",
    "sitecustomize",
    pytest.param("modules", marks=ON_DEMAND),
    pytest.param("namespaces", marks=ON_DEMAND),
)


def foreign(folder: Path, form: str) -> Path:
    """A folder with other packages named as those of the program."""
    folder.mkdir()
    for name in ("monitor", "drivers", "config"):
        if form in ("packages", "namespaces"):
            (folder / name).mkdir()
            (folder / name / "errors.py").write_text(FOREIGN)
        if form == "packages":
            (folder / name / "__init__.py").write_text(FOREIGN)
        elif form == "modules":
            (folder / f"{name}.py").write_text(FOREIGN)
        elif form == "sitecustomize":
            (folder / f"{name}.py").write_text("OWN = False\n")
    if form == "sitecustomize":
        (folder / "sitecustomize.py").write_text("import monitor, drivers, config\n")
    return folder


@pytest.mark.parametrize("form", FORMS)
def test_foreign_packages_come_first_on_the_module_path(form: str, run: Run, tmp_path: Path) -> None:
    path = foreign(tmp_path / "ros", form)
    done = run("check", DEMO, environment={"PYTHONPATH": f"{path}{os.pathsep}{ROOT}"})
    well(done)
    assert "1 device, no mistakes" in done.stdout


@pytest.mark.parametrize(
    "form", ["modules", *(pytest.param(one, marks=ON_DEMAND) for one in ("packages", "namespaces"))]
)
def test_foreign_packages_in_the_current_folder(form: str, tmp_path: Path) -> None:
    """``-m`` puts the current folder first."""
    path = foreign(tmp_path / "ros", form)
    command = [sys.executable, "-m", "imu_monitor", "check", DEMO]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        command, cwd=path, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
    )
    well(done)


def test_a_child_of_the_daemon_runs_the_same_program(tmp_path: Path) -> None:
    path = foreign(tmp_path / "ros", "packages")
    environment = os.environ | {"PYTHONPATH": str(path)}
    command = [*reconcile_on_request.COMMAND, "--help"]
    done = subprocess.run(
        command, cwd=path, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
    )
    well(done)
    assert "--model" in done.stdout


def test_doctor_reports_foreign_packages(run: Run, tmp_path: Path) -> None:
    path = foreign(tmp_path / "ros", "packages")
    done = run("doctor", "--json", "-", environment={"PYTHONPATH": f"{path}{os.pathsep}{ROOT}"})
    for name in ("monitor", "drivers"):
        assert f"{path / name / '__init__.py'}: is found before the program's own package {name}" in done.stdout
    assert "are the program's own" in run("doctor", "--json", "-").stdout


@pytest.mark.parametrize("lost", ["monitor", "drivers", "config"])
def test_a_folder_that_is_not_its_own_is_named(lost: str, tmp_path: Path) -> None:
    """As where another distribution has overwritten it, which pip does not refuse."""
    for name in ("monitor", "drivers", "config"):
        (tmp_path / name).mkdir()
        if name != lost:
            file = tmp_path / name / imu_monitor.REQUIRED[name]
            file.parent.mkdir(exist_ok=True)
            file.touch()
    shutil.copy(imu_monitor.__file__, tmp_path)
    command = [sys.executable, str(tmp_path / "imu_monitor.py"), "check", DEMO]
    done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    assert f"{tmp_path / lost}: is missing or belongs to another package" in one_line(done, 1)


def test_the_order_of_the_module_path_stays(tmp_path: Path) -> None:
    """With the program's folder in front, a module beside it could take the place of one of the standard library."""
    code = (
        "import sys, imu_monitor; before = list(sys.path); imu_monitor.bind_own_packages(); assert sys.path == before"
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, check=True)


# --- variables

ENVIRONMENTS: Final[dict[str, dict[str, str | None]]] = {
    "no HOME": {"HOME": None},
    "HOME that is absent": {"HOME": "/nonexistent/home"},
    "empty HOME": {"HOME": ""},
    "no LANG": {"LANG": None, "LC_ALL": None, "LC_CTYPE": None},
    "odd LANG": {"LANG": "xx_YY.KOI9", "LC_ALL": "xx_YY.KOI9"},
    "C locale without UTF-8": {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"},
    "ASCII streams": {"PYTHONIOENCODING": "ascii:strict"},
    "warnings are errors": {"PYTHONWARNINGS": "error"},
    "all warnings": {"PYTHONWARNINGS": "always", "PYTHONDEVMODE": None},
    "no assertions": {"PYTHONOPTIMIZE": "2"},
    "safe path": {"PYTHONSAFEPATH": "1"},
    "TMPDIR that is absent": {"TMPDIR": "/nonexistent/tmp"},
    "one column": {"COLUMNS": "1"},
    "no columns": {"COLUMNS": "0", "LINES": "0"},
    "absurd columns": {"COLUMNS": "99999999999999999999"},
    "columns in words": {"COLUMNS": "wide"},
    "dumb terminal": {"TERM": "dumb"},
    "no terminal": {"TERM": None},
    "Numba's cache cannot be written": {"NUMBA_CACHE_DIR": "/proc/1/nowhere"},
    "absurd threads": {"OMP_NUM_THREADS": "-1", "OPENBLAS_NUM_THREADS": "many"},
    "no PATH": {"PATH": ""},
}
BY_DEFAULT: Final = ("C locale without UTF-8", "warnings are errors", "no columns")


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name in BY_DEFAULT else ON_DEMAND) for name in ENVIRONMENTS],
)
def test_variables(name: str, run: Run, recording: Path) -> None:
    """The table of ``analyze`` has letters that ASCII lacks, and nothing goes to standard error."""
    done = run("analyze", str(recording), environment=ENVIRONMENTS[name], timeout=TIMEOUT_S)
    well(done)
    assert "2000" in re.sub(r"\s", "", done.stdout)


@pytest.mark.attack
@pytest.mark.parametrize("name", ENVIRONMENTS)
@pytest.mark.parametrize("arguments", [("check", DEMO), ("doctor",), ("--help",), ("analyze", "absent.csv")])
def test_variables_of_other_commands(name: str, arguments: tuple[str, ...], run: Run) -> None:
    done = run(*arguments, environment=ENVIRONMENTS[name])
    assert done.returncode in (0, 1, 2)
    assert "Traceback" not in done.stderr
    assert done.stderr.count("\n") == (1 if done.returncode == 2 else 0), done.stderr


@ON_DEMAND
def test_a_home_that_cannot_be_written(run: Run, recording: Path, tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir(mode=0o500)
    well(run("analyze", str(recording), environment={"HOME": str(home)}))


# --- folders and streams


def test_the_current_folder_is_gone(script: Path, recording: Path, tmp_path: Path) -> None:
    for arguments, status in ((("analyze", str(recording)), 0), (("simulate", "x", "--seconds", "1", "--out", "y"), 1)):
        folder = tmp_path / "gone"
        folder.mkdir()
        words = " ".join(f"'{word}'" for word in (sys.executable, str(script), *arguments))
        done = subprocess.run(
            ["sh", "-c", f"rmdir ../gone && exec {words}"],
            cwd=folder, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, timeout=TIMEOUT_S,
            check=False,
        )  # fmt: skip
        assert done.returncode == status, done.stderr
        if status:
            assert "the current folder has been removed" in one_line(done, status)


@ON_DEMAND
@pytest.mark.skipif(not REGULAR_USER, reason="nothing is forbidden to root")
def test_the_current_folder_cannot_be_read(run: Run, recording: Path, tmp_path: Path) -> None:
    folder = tmp_path / "closed"
    folder.mkdir(mode=0o100)
    well(run("analyze", str(recording), cwd=folder))


@ON_DEMAND
def test_a_path_with_spaces_and_letters_beyond_ascii(run: Run, recording: Path, tmp_path: Path) -> None:
    folder = tmp_path / "Prüfstand Nr. 1 – 測定"
    folder.mkdir()
    shutil.copy(recording, folder / "Aufnahme 1.npz")
    well(run("analyze", "Aufnahme 1.npz", "--json", "Ergebnis.json", cwd=folder))
    assert (folder / "Ergebnis.json").stat().st_size > 0


@ON_DEMAND
def test_a_file_name_that_is_no_text(run: Run, recording: Path, tmp_path: Path) -> None:
    path = os.fsencode(tmp_path) + b"/a\xff.npz"
    shutil.copy(os.fsencode(recording), path)
    well(run("analyze", os.fsdecode(path)))
    one_line(run("analyze", os.fsdecode(path[:-4] + b"b.npz")), 2)


CLOSED: Final = {"input": "<&-", "output": ">&-", "errors": "2>&-", "all": "<&- >&- 2>&-"}


@pytest.mark.parametrize("streams", ["all", *(pytest.param(one, marks=ON_DEMAND) for one in CLOSED if one != "all")])
@pytest.mark.parametrize("wrong", [False, True])
def test_closed_streams(streams: str, wrong: bool, script: Path, recording: Path, tmp_path: Path) -> None:
    """A closed output is an error of its own where there is something to print, and files stay whole."""
    arguments = [str(recording), "--json", "result.json"] if not wrong else ["absent.npz"]
    words = " ".join(f"'{word}'" for word in (sys.executable, str(script), "analyze", *arguments))
    done = subprocess.run(
        ["sh", "-c", f"exec {words} {CLOSED[streams]}"],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, timeout=TIMEOUT_S,
        check=False,
    )  # fmt: skip
    printed = streams in ("output", "all") and not wrong
    assert done.returncode == (2 if wrong else 1 if printed else 0), done.stderr
    if streams in ("errors", "all"):
        assert done.stderr == ""
    elif wrong or printed:
        one_line(done, done.returncode)
    else:
        assert done.stderr == ""
    if not wrong:
        text = (tmp_path / "result.json").read_text()
        assert text.startswith("{")
        assert text.endswith("}\n")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_output_to_a_full_disk(run: Run, recording: Path) -> None:
    for arguments in (("check", DEMO), ("analyze", str(recording))):
        with open("/dev/full", "w", encoding="ascii") as full:
            done = run(*arguments, capture_output=False, stdout=full, stderr=subprocess.PIPE)
        assert "No space left on device" in one_line(done, 1)


@ON_DEMAND
def test_a_reader_that_leaves_hears_nothing(script: Path, recording: Path, tmp_path: Path) -> None:
    words = " ".join(f"'{word}'" for word in (sys.executable, str(script), "analyze", str(recording)))
    done = subprocess.run(
        ["sh", "-c", f"{words} | true"],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, timeout=TIMEOUT_S,
        check=False, preexec_fn=lambda: signal.signal(signal.SIGPIPE, signal.SIG_DFL),
    )  # fmt: skip
    assert done.stderr == ""
