"""Tests of the warning filters of pytest: which warnings fail a run of the tests, and which fail only ``.ci/run``."""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
OF_OTHERS = {
    "deprecation_inside_a_package": "package.warn(DeprecationWarning)",
    "warning_inside_a_package": "package.warn(UserWarning)",
    "deprecation_of_a_function_that_is_called": "package.warn(DeprecationWarning, stacklevel=2)",
    "future_change_of_a_function_that_is_called": "own.call(package.warn, FutureWarning, stacklevel=2)",
    "object_that_was_not_closed": "package.warn(ResourceWarning)",
}
OWN = {
    "warning_of_a_test": "warnings.warn('own')",
    "warning_of_a_module": "own.call(warnings.warn, 'own')",
    "warning_about_the_call_of_a_package": "own.call(package.warn, RuntimeWarning, stacklevel=2)",
    "failed_thread": "start_thread(lambda: 1 / 0)",
}
PACKAGE = """
import warnings
def warn(category, stacklevel=1): warnings.warn("changed", category, stacklevel=stacklevel)
"""
HEAD = """
import threading, warnings
import package
from monitor import own
def start_thread(target):
    thread = threading.Thread(target=target)
    thread.start()
    thread.join()
"""


def run_tests_with_warnings(folder: Path, *options: str) -> set[str]:
    """Run a test for each warning with the settings of this project, and return the names of those that fail."""
    settings = (ROOT / "pyproject.toml").read_text("utf-8")
    table = settings[settings.index("[tool.pytest.ini_options]") : settings.index("[tool.importlinter]")]
    tests = "".join(f"def test_{name}(): {code}\n" for name, code in (OF_OTHERS | OWN).items())
    files = {
        "pyproject.toml": table,
        "package.py": PACKAGE,
        "monitor/__init__.py": "",
        "monitor/own.py": "def call(function, *args, **options): function(*args, **options)",
        "tests/test_warnings.py": HEAD + tests,
    }
    for name, text in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    command = [sys.executable, "-m", "pytest", "-n", "0", "-p", "no:randomly", *options, "tests"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    failed = set(re.findall(r"^FAILED .*::test_(\w+)", done.stdout, re.M))
    assert f"{len(failed)} failed" in done.stdout, done.stdout + done.stderr
    return failed


def test_only_warnings_that_this_project_causes_fail_a_run(tmp_path: Path) -> None:
    assert run_tests_with_warnings(tmp_path) == set(OWN)


def test_every_warning_fails_a_run_of_continuous_integration(tmp_path: Path) -> None:
    (options,) = set(re.findall(r"-W \w+", (ROOT / ".ci" / "run").read_text("utf-8")))
    assert run_tests_with_warnings(tmp_path, *options.split()) == set(OF_OTHERS | OWN)
