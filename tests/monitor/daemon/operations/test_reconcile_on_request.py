"""``command/reconcile`` with another program in the place of the command: what it is given, and what becomes of it."""

import json
import os
import sys
import textwrap
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import imu_monitor
from drivers.data_types import make_block
from drivers.recordings import load_samples
from monitor.daemon.operations.reconcile_on_request import (
    COMMAND,
    NICENESS_INCREASE,
    Reconciler,
    WindowCopyForReconcile,
    describe_reconcile_result,
)
from monitor.estimation.estimator import Estimator
from monitor.publishing.zenoh.publisher import Command
from tests.support.waiting import FOREVER_S, PATIENCE_S, wait_for

N = 400
VALUES = 1e-3 * np.random.default_rng(1).standard_normal((N, 6))
VALUES[50:60] = np.nan
VALUES[:, 4] = np.nan
WARM = np.linspace(20.0, 21.0, N)
LARGEST_NICENESS = 19
GIVEN = """
import json, os, sys, time
given = dict(zip(sys.argv[2::2], sys.argv[3::2]))
with open(sys.argv[1], "rb") as file:
    size = len(file.read())
"""


class Asked:
    """A query: its answer, once there is one."""

    def __init__(self, device: str = "bench-1") -> None:
        self.answers: list[dict[str, Any]] = []
        self.errors: list[str] = []
        self.done = threading.Event()
        self.command = Command(device, "reconcile", self._answer, self._refuse)

    def _answer(self, payload: bytes) -> None:
        self.answers.append(json.loads(payload))
        self.done.set()

    def _refuse(self, why: str) -> None:
        self.errors.append(why)
        self.done.set()

    def wait(self) -> "Asked":
        assert self.done.wait(PATIENCE_S)
        return self


def job(
    device: str = "bench-1", model: Path | None = None, folder: Path | None = None, warm: bool = True
) -> WindowCopyForReconcile:
    estimator = Estimator(100.0, N / 100.0)
    estimator.add_samples(make_block(np.arange(N) * 10_000_000, VALUES.copy()))
    temperature_c = WARM if warm else np.full(N, np.nan)
    return WindowCopyForReconcile(
        device, 1_763_700_000.0, 360_000, estimator.copy_window(), temperature_c, model, folder
    )


def program(text: str) -> tuple[str, ...]:
    return (sys.executable, "-c", GIVEN + textwrap.dedent(text))


def run(text: str, one: WindowCopyForReconcile | None = None, limit_s: float = PATIENCE_S) -> tuple[Asked, list[str]]:
    """The answer of one query, and what is said of it."""
    reconciler, asked = Reconciler(program(text), limit_s), Asked()
    reconciler.start_reconciliation(one or job(), asked.command)
    asked.wait()
    reconciler.abort_reconciliations()
    return asked, [finished.text for finished in reconciler.take_finished_reconciliations()]


def test_the_answer_is_what_the_program_says() -> None:
    result = {
        "schema": "imu-monitor/reconcile/1",
        "verdict": "partly_explained",
        "axes": {"gz": {"steps": [{"kind": "added", "effect": "sinusoidal", "confidence": 0.998}]}},
    }
    asked, told = run(f"print(json.dumps({result!r}))")
    (answer,) = asked.answers
    assert list(answer)[:4] == ["schema", "device", "t", "samples"]
    assert answer == result | {
        "device": "bench-1", "t": 1_763_700_000.0, "samples": 360_000, "exit": 0, "folder": None
    }  # fmt: skip
    assert told == ["reconcile: partly explained: gz sinusoidal added (0.998)"]
    assert asked.errors == []


def test_the_program_is_given_the_window_as_a_recording(tmp_path: Path) -> None:
    kept = tmp_path / "kept.npz"
    model = tmp_path / "my.toml"
    text = f"""
        import shutil
        shutil.copy(sys.argv[1], {str(kept)!r})
        while os.nice(0) < {min(os.nice(0) + NICENESS_INCREASE, LARGEST_NICENESS)}:  # set after the start
            time.sleep(0.01)
        seen = {{"given": given, "nice": os.nice(0)}}
        print(json.dumps({{"verdict": "agrees", **seen}}))
    """
    asked, told = run(text, job(model=model))
    (answer,) = asked.answers
    assert answer["given"] | {"--out": ""} == {"--out": "", "--json": "-", "--seed": "1", "--model": str(model)}
    assert answer["nice"] == min(os.nice(0) + NICENESS_INCREASE, LARGEST_NICENESS)
    assert told == ["reconcile: agrees"]
    recording = load_samples(kept)
    assert recording.rate_hz == 100.0
    assert recording.axes == ("gx", "gy", "gz", "ax", "az")
    np.testing.assert_allclose(recording.values, VALUES, rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(recording.temperature_c, WARM)


def test_what_was_not_measured_is_no_column(tmp_path: Path) -> None:
    asked, _ = run("import numpy; print(json.dumps({'found': sorted(numpy.load(sys.argv[1]))}))", job(warm=False))
    assert asked.answers[0]["found"] == ["ax", "az", "fs", "gx", "gy", "gz"]
    assert "--model" not in asked.answers[0]


def test_no_answer_is_an_answer_too() -> None:
    asked, told = run("print(json.dumps({'verdict': None, 'why': '4 s of at least 41 s'})); sys.exit(3)")
    assert asked.answers[0]["why"] == "4 s of at least 41 s"
    assert asked.answers[0]["exit"] == 3
    assert told == ["reconcile: no answer: 4 s of at least 41 s"]


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("sys.exit('first\\nmodel.toml: gz: unknown effect')", "model.toml: gz: unknown effect"),
        ("sys.exit(1)", "reconcile ended with status 1"),
        ("os.kill(os.getpid(), 9)", "reconcile ended with status -9"),
        ("print('[1, 2')", "the result of reconcile cannot be read: "),
        ("print('[1, 2]')", "the result of reconcile cannot be read: "),
        ("pass", "the result of reconcile cannot be read: "),
    ],
)
def test_a_failure_is_an_error_in_one_line(text: str, error: str) -> None:
    asked, told = run(text)
    assert asked.answers == []
    (found,) = asked.errors
    assert found.startswith(error)
    assert "\n" not in found
    assert told == [f"reconcile failed: {found}"]


def test_a_program_that_is_not_there_is_an_error() -> None:
    reconciler, asked = Reconciler(("/nowhere/imu-monitor",)), Asked()
    reconciler.start_reconciliation(job(), asked.command)
    assert "No such file" in asked.wait().errors[0]


def test_too_long_is_ended_with_all_that_it_started(tmp_path: Path) -> None:
    text = f"""
        import subprocess
        grandchild = subprocess.Popen([sys.executable, "-c", "import time; time.sleep({FOREVER_S})"])
        open({str(tmp_path / "part")!r}, "w").write(str(grandchild.pid))
        os.rename({str(tmp_path / "part")!r}, {str(tmp_path / "pid")!r})
        grandchild.wait()
    """
    for limit_s in (1.5, 6.0, 24.0, 96.0):  # a loaded machine may need longer to start the grandchild
        asked, _ = run(text, limit_s=limit_s)
        assert asked.errors == [f"reconcile was killed after {limit_s:g} s"]
        if (tmp_path / "pid").exists():
            break
    pid = int((tmp_path / "pid").read_text())
    wait_for(lambda: gone(pid), "the end of the grandchild")


def gone(pid: int) -> bool:
    """Return True if the process has ended, whether or not its parent has noticed."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


def test_one_at_a_time_for_each_device(tmp_path: Path) -> None:
    go = tmp_path / "go"
    text = f"""
        while not os.path.exists({str(go)!r}):
            time.sleep(0.01)
        print(json.dumps({{"verdict": "agrees"}}))
    """
    reconciler = Reconciler(program(text))
    first, second, other, later = Asked(), Asked(), Asked("bench-2"), Asked()
    reconciler.start_reconciliation(job(), first.command)
    reconciler.start_reconciliation(job(), second.command)
    reconciler.start_reconciliation(job("bench-2"), other.command)
    assert second.wait().errors == ["busy: a reconciliation of this device is already running"]
    assert not first.done.is_set()
    go.touch()
    assert first.wait().answers[0]["device"] == "bench-1"
    assert other.wait().answers[0]["device"] == "bench-2"
    reconciler._running["bench-1"].join(PATIENCE_S)  # the thread ends after it has answered
    reconciler.start_reconciliation(job(), later.command)
    assert later.wait().errors == []
    reconciler.abort_reconciliations()


def test_closing_ends_what_runs_and_says_so() -> None:
    reconciler, asked = Reconciler(program(f"time.sleep({FOREVER_S})")), Asked()
    reconciler.start_reconciliation(job(), asked.command)
    wait_for(lambda: reconciler._children, "the program to be started")
    reconciler.abort_reconciliations()
    assert asked.wait().errors == ["the service is stopping"]


def test_reports_are_kept_only_where_the_configuration_says(tmp_path: Path) -> None:
    text = """
        os.makedirs(given["--out"], exist_ok=True)
        open(os.path.join(given["--out"], "report.html"), "w").write("x")
        print(json.dumps({"verdict": "agrees", "out": given["--out"], "file": sys.argv[1]}))
    """
    asked, _ = run(text, job(folder=tmp_path / "reports"))
    folder = tmp_path / "reports" / "bench-1-20251121T044000Z"
    assert asked.answers[0]["folder"] == asked.answers[0]["out"] == str(folder)
    assert (folder / "report.html").read_text() == "x"
    assert not Path(asked.answers[0]["file"]).exists()
    asked, _ = run(text)
    assert asked.answers[0]["folder"] is None
    assert not Path(asked.answers[0]["out"]).exists()
    assert not Path(asked.answers[0]["file"]).exists()


def test_the_program_is_this_one() -> None:
    assert COMMAND[0] == sys.executable
    assert COMMAND[1:] == ("-P", str(Path(imu_monitor.__file__)), "reconcile")


def test_a_verdict_without_steps_and_a_step_without_confidence() -> None:
    step = {"kind": "retuned", "effect": "angle_random_walk", "confidence": None}
    assert describe_reconcile_result({"verdict": "explained", "axes": {"gz": {"steps": [step]}}}) == (
        "reconcile: explained: gz angle_random_walk retuned"
    )
    assert (
        describe_reconcile_result({"verdict": "unexplained", "axes": {"gz": {"steps": []}}}) == "reconcile: unexplained"
    )
