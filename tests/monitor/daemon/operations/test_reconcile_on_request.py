"""Tests of ``command/reconcile`` with a replacement program: its arguments, its result and its errors."""

import json
import os
import sys
import textwrap
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import imu_monitor
from drivers.data_types import make_block
from drivers.recordings import load_samples
from monitor.daemon.operations.reconcile_on_request import (
    COMMAND,
    KEPT_REPORTS,
    NICENESS_INCREASE,
    Reconciler,
    WindowCopyForReconcile,
    describe_reconcile_result,
)
from monitor.estimation.estimator import Estimator
from monitor.publishing.zenoh.publisher import Command
from tests.support.waiting import FOREVER_S, PATIENCE_S, wait_for

SAMPLE_COUNT = 400
VALUES = 1e-3 * np.random.default_rng(1).standard_normal((SAMPLE_COUNT, 6))
VALUES[50:60] = np.nan
VALUES[:, 4] = np.nan
TEMPERATURE_C = np.linspace(20.0, 21.0, SAMPLE_COUNT)
LARGEST_NICENESS = 19
PROGRAM_START = """
import json, os, sys, time
arguments = dict(zip(sys.argv[2::2], sys.argv[3::2]))
with open(sys.argv[1], "rb") as file:
    size = len(file.read())
"""


class ReconcileQuery:
    """A query and its answer, once the answer has arrived."""

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

    def wait(self) -> "ReconcileQuery":
        assert self.done.wait(PATIENCE_S)
        return self


def make_window_copy(
    device: str = "bench-1", model: Path | None = None, folder: Path | None = None, with_temperature: bool = True
) -> WindowCopyForReconcile:
    estimator = Estimator(100.0, SAMPLE_COUNT / 100.0)
    estimator.add_samples(make_block(np.arange(SAMPLE_COUNT) * 10_000_000, VALUES.copy()))
    temperature_c = TEMPERATURE_C if with_temperature else np.full(SAMPLE_COUNT, np.nan)
    return WindowCopyForReconcile(
        device, 1_763_700_000.0, 360_000, estimator.copy_window(), temperature_c, model, folder
    )


def make_command(text: str) -> tuple[str, ...]:
    return (sys.executable, "-c", PROGRAM_START + textwrap.dedent(text))


def run_reconciliation(
    text: str, window_copy: WindowCopyForReconcile | None = None, limit_s: float = PATIENCE_S
) -> tuple[ReconcileQuery, list[str]]:
    """Return the answered query and the texts of its events."""
    reconciler, query = Reconciler(make_command(text), limit_s), ReconcileQuery()
    reconciler.start_reconciliation(window_copy or make_window_copy(), query.command)
    query.wait()
    reconciler.abort_reconciliations()
    return query, [finished.text for finished in reconciler.take_finished_reconciliations()]


def test_answer_contains_the_result_of_the_program() -> None:
    result = {
        "schema": "imu-monitor/reconcile/1",
        "verdict": "partly_explained",
        "axes": {"gz": {"steps": [{"kind": "added", "effect": "sinusoidal", "confidence": 0.998}]}},
    }
    query, event_texts = run_reconciliation(f"print(json.dumps({result!r}))")
    (answer,) = query.answers
    assert list(answer)[:4] == ["schema", "device", "t", "samples"]
    assert answer == result | {
        "device": "bench-1", "t": 1_763_700_000.0, "samples": 360_000, "exit": 0, "folder": None
    }  # fmt: skip
    assert event_texts == ["reconcile: partly explained: gz sinusoidal added (0.998)"]
    assert query.errors == []


def test_program_receives_the_window_as_a_recording(tmp_path: Path) -> None:
    kept = tmp_path / "kept.npz"
    model = tmp_path / "my.toml"
    text = f"""
        import shutil
        shutil.copy(sys.argv[1], {str(kept)!r})
        while os.nice(0) < {min(os.nice(0) + NICENESS_INCREASE, LARGEST_NICENESS)}:  # it is set after the start
            time.sleep(0.01)
        seen = {{"given": arguments, "nice": os.nice(0)}}
        print(json.dumps({{"verdict": "agrees", **seen}}))
    """
    query, event_texts = run_reconciliation(text, make_window_copy(model=model))
    (answer,) = query.answers
    assert answer["given"] | {"--out": ""} == {"--out": "", "--json": "-", "--seed": "1", "--model": str(model)}
    assert answer["nice"] == min(os.nice(0) + NICENESS_INCREASE, LARGEST_NICENESS)
    assert event_texts == ["reconcile: agrees"]
    recording = load_samples(kept)
    assert recording.rate_hz == 100.0
    assert recording.axes == ("gx", "gy", "gz", "ax", "az")
    np.testing.assert_allclose(recording.values, VALUES, rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(recording.temperature_c, TEMPERATURE_C)


def test_unmeasured_axes_are_not_in_the_recording(tmp_path: Path) -> None:
    query, _ = run_reconciliation(
        "import numpy; print(json.dumps({'found': sorted(numpy.load(sys.argv[1]))}))",
        make_window_copy(with_temperature=False),
    )
    assert query.answers[0]["found"] == ["ax", "az", "fs", "gx", "gy", "gz"]
    assert "--model" not in query.answers[0]


def test_oldest_reports_of_the_device_are_deleted(tmp_path: Path) -> None:
    started_s = 1_763_700_000
    reconciler = Reconciler(make_command("os.makedirs(arguments['--out'], exist_ok=True); print('{}')"))
    others = [tmp_path / name for name in ("bench-1-2-20200101T000000Z", "bench-1-notes", "other-20200101T000000Z")]
    for other in others:
        other.mkdir()
    folders = []
    for run in range(KEPT_REPORTS + 3):
        query = ReconcileQuery()
        window_copy = replace(make_window_copy(folder=tmp_path), unix_s=float(started_s + run))
        wait_for(lambda: not any(thread.is_alive() for thread in reconciler._running.values()))
        reconciler.start_reconciliation(window_copy, query.command)
        (answer,) = query.wait().answers
        assert answer["kept_reports"] == KEPT_REPORTS
        folders.append(Path(answer["folder"]))
    assert sorted(tmp_path.iterdir()) == sorted([*others, *folders[-KEPT_REPORTS:]])


def test_result_without_verdict_is_answered() -> None:
    query, event_texts = run_reconciliation(
        "print(json.dumps({'verdict': None, 'why': '4 s of at least 41 s'})); sys.exit(3)"
    )
    assert query.answers[0]["why"] == "4 s of at least 41 s"
    assert query.answers[0]["exit"] == 3
    assert event_texts == ["reconcile: no answer: 4 s of at least 41 s"]


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
def test_failure_is_answered_as_an_error_of_one_line(text: str, error: str) -> None:
    query, event_texts = run_reconciliation(text)
    assert query.answers == []
    (found,) = query.errors
    assert found.startswith(error)
    assert "\n" not in found
    assert event_texts == [f"reconcile failed: {found}"]


def test_missing_program_is_answered_as_an_error() -> None:
    reconciler, query = Reconciler(("/nowhere/imu-monitor",)), ReconcileQuery()
    reconciler.start_reconciliation(make_window_copy(), query.command)
    assert "No such file" in query.wait().errors[0]


def test_program_beyond_its_time_limit_is_killed_with_its_children(tmp_path: Path) -> None:
    text = f"""
        import subprocess
        grandchild = subprocess.Popen([sys.executable, "-c", "import time; time.sleep({FOREVER_S})"])
        open({str(tmp_path / "part")!r}, "w").write(str(grandchild.pid))
        os.rename({str(tmp_path / "part")!r}, {str(tmp_path / "pid")!r})
        grandchild.wait()
    """
    for limit_s in (1.5, 6.0, 24.0, 96.0):  # a loaded machine may need longer to start the grandchild
        query, _ = run_reconciliation(text, limit_s=limit_s)
        assert query.errors == [f"reconcile was killed after {limit_s:g} s"]
        if (tmp_path / "pid").exists():
            break
    pid = int((tmp_path / "pid").read_text())
    wait_for(lambda: has_ended(pid), "the end of the grandchild")


def has_ended(pid: int) -> bool:
    """Return True if the process has ended, whether or not its parent has noticed."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


def test_one_reconciliation_runs_at_a_time_for_each_device(tmp_path: Path) -> None:
    go = tmp_path / "go"
    text = f"""
        while not os.path.exists({str(go)!r}):
            time.sleep(0.01)
        print(json.dumps({{"verdict": "agrees"}}))
    """
    reconciler = Reconciler(make_command(text))
    first, second, other, later = ReconcileQuery(), ReconcileQuery(), ReconcileQuery("bench-2"), ReconcileQuery()
    reconciler.start_reconciliation(make_window_copy(), first.command)
    reconciler.start_reconciliation(make_window_copy(), second.command)
    reconciler.start_reconciliation(make_window_copy("bench-2"), other.command)
    assert second.wait().errors == ["busy: a reconciliation of this device is already running"]
    assert not first.done.is_set()
    go.touch()
    assert first.wait().answers[0]["device"] == "bench-1"
    assert other.wait().answers[0]["device"] == "bench-2"
    reconciler._running["bench-1"].join(PATIENCE_S)  # the thread ends after it has answered
    reconciler.start_reconciliation(make_window_copy(), later.command)
    assert later.wait().errors == []
    reconciler.abort_reconciliations()


def test_shutdown_ends_a_running_reconciliation_with_an_error() -> None:
    reconciler, query = Reconciler(make_command(f"time.sleep({FOREVER_S})")), ReconcileQuery()
    reconciler.start_reconciliation(make_window_copy(), query.command)
    wait_for(lambda: reconciler._children, "the program to be started")
    reconciler.abort_reconciliations()
    assert query.wait().errors == ["the service is stopping"]


def test_reports_are_kept_only_if_a_folder_is_configured(tmp_path: Path) -> None:
    text = """
        os.makedirs(arguments["--out"], exist_ok=True)
        open(os.path.join(arguments["--out"], "report.html"), "w").write("x")
        print(json.dumps({"verdict": "agrees", "out": arguments["--out"], "file": sys.argv[1]}))
    """
    query, _ = run_reconciliation(text, make_window_copy(folder=tmp_path / "reports"))
    folder = tmp_path / "reports" / "bench-1-20251121T044000Z"
    assert query.answers[0]["folder"] == query.answers[0]["out"] == str(folder)
    assert (folder / "report.html").read_text() == "x"
    assert not Path(query.answers[0]["file"]).exists()
    query, _ = run_reconciliation(text)
    assert query.answers[0]["folder"] is None
    assert not Path(query.answers[0]["out"]).exists()
    assert not Path(query.answers[0]["file"]).exists()


def test_default_command_is_this_program() -> None:
    assert COMMAND[0] == sys.executable
    assert COMMAND[1:] == ("-P", str(Path(imu_monitor.__file__)), "reconcile")


def test_description_handles_missing_steps_and_confidences() -> None:
    step = {"kind": "retuned", "effect": "angle_random_walk", "confidence": None}
    assert describe_reconcile_result({"verdict": "explained", "axes": {"gz": {"steps": [step]}}}) == (
        "reconcile: explained: gz angle_random_walk retuned"
    )
    assert (
        describe_reconcile_result({"verdict": "unexplained", "axes": {"gz": {"steps": []}}}) == "reconcile: unexplained"
    )
