"""Cases through the program, as a user would: files in, ``report.json`` out. What came of it is a line of a result
file.

The truth never goes where the program could read it: the folder that it sees holds a recording and a model. A result
file can be continued: cases that stand in it are not run again.
"""

import contextlib
import io
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final

from tests.experiments.blind import cases
from tests.experiments.blind.score import Outcome, score

TIME_LIMIT_S: Final = 900.0
STOPPED: Final = 128


@dataclass(frozen=True)
class Job:
    """One case to run."""

    name: str
    level: str
    seed: int
    seconds: float
    rate: float = 100.0
    axes: int = 6
    baseline: str = "exact"
    sizes: tuple[float, float] | None = None

    @property
    def key(self) -> str:
        """What tells it from others in a result file."""
        sizes = "" if self.sizes is None else f" x{self.sizes[0]:g}-{self.sizes[1]:g}"
        return (
            f"{self.name} {self.level} {self.seed} {self.seconds:g}s {self.rate:g}Hz {self.axes} {self.baseline}{sizes}"
        )

    @property
    def folder(self) -> str:
        """Its name on disk."""
        return self.key.replace(" ", "_").replace(":", "_")

    def case(self) -> cases.Case:
        """Made from it."""
        return cases.case(
            self.name,
            self.level,
            self.seed,
            seconds=self.seconds,
            rate=self.rate,
            axes=self.axes,
            baseline=self.baseline,
            sizes=self.sizes,
        )


def jobs(
    which: str,
    level: str,
    seeds: Sequence[int],
    seconds: float,
    only: Sequence[str] = (),
    baseline: str = "exact",
    sizes: tuple[float, float] | None = None,
) -> list[Job]:
    """The cases of a set; ``off`` is short for singles with a baseline that is off, ``all`` for the other four sets.

    ``nulls`` are of two sorts: six axes of a sixth of the length, and one axis of the whole.

    Raises:
        ValueError: no such set
    """
    if which == "all":
        return [
            job
            for each in ("singles", "pairs", "nulls", "foreign")
            for job in jobs(each, level, seeds, seconds, only, baseline, sizes)
        ]
    if which == "off":
        which, baseline = "singles", "off"
    names = {"singles": cases.SINGLES, "pairs": cases.PAIRS, "foreign": cases.FOREIGN, "nulls": ("null",)}
    if which not in names:
        raise ValueError(f"no set {which!r}: {', '.join(names)}, off or all")
    if which in ("foreign", "nulls"):
        level, sizes = "plain", None  # they have but one
    made = [
        Job(name, level, seed, seconds, baseline=baseline, sizes=sizes)
        for seed in seeds
        for name in names[which]
        if not only or name in only
    ]
    if which == "nulls":
        return [null for job in made for null in (replace(job, seconds=seconds / 6.0), replace(job, axes=1))]
    return made


def run(job: Job, in_process: bool = False, keep: Path | None = None) -> Outcome:
    """Make the case, run the program on it, score what it says.

    Args:
        job: which
        in_process: call the command here instead of in a process of its own
        keep: a folder where recording, model and report stay, each case in a folder of its own, truths beside them
    """
    case = job.case()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) if keep is None else keep / job.folder
        recording, model = case.write(folder)
        out = folder / "out"
        arguments = ["reconcile", str(recording), "--model", str(model), "--out", str(out), "--seed", str(job.seed)]
        begin = time.perf_counter()
        status, said = (_here if in_process else _apart)(arguments)
        seconds = time.perf_counter() - begin
        report = out / "report.json"
        parsed = json.loads(report.read_text()) if report.exists() else None
        if keep is not None:
            (keep / f"{job.folder}.truth.json").write_text(case.truth_json())
            (folder / "said.txt").write_text(said)
    if status >= STOPPED:  # by a signal: no result of the program, and a wish to stop
        raise KeyboardInterrupt(f"{job.key}: exit status {status}")
    if parsed is None and status == 0:
        raise RuntimeError(f"{job.key}: exit status 0 without a report: {said}")
    if status in (1, 2):
        print(f"{job.key}: exit status {status}: {said.strip()[-500:]}", file=sys.stderr)
    return score(case.truth, parsed, status, seconds)


def _apart(arguments: list[str]) -> tuple[int, str]:
    done = subprocess.run(
        [sys.executable, "-m", "monitor.cli", *arguments],
        capture_output=True,
        text=True,
        timeout=TIME_LIMIT_S,
        check=False,
    )
    return done.returncode, done.stdout + done.stderr


def _here(arguments: list[str]) -> tuple[int, str]:
    """The program's own ``main``, with what it prints kept: the start of Python and its libraries is saved."""
    from monitor.cli import main

    said, before = io.StringIO(), sys.argv
    sys.argv = ["imu-monitor", *arguments]
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            main()
    except SystemExit as stop:
        return int(stop.code or 0), said.getvalue()
    finally:
        sys.argv = before
    return 0, said.getvalue()


def run_all(
    todo: Sequence[Job], file: Path, processes: int, in_process: bool = False, keep: Path | None = None
) -> Iterator[Outcome]:
    """Run what does not stand in ``file`` yet, and append a line for each as it is done."""
    known = {line["key"] for line in lines(file)}
    left = [job for job in todo if job.key not in known]
    with file.open("a") as results:
        for job, outcome in _outcomes(left, processes, in_process, keep):
            results.write(json.dumps({"key": job.key, **outcome.json()}) + "\n")
            results.flush()
            yield outcome


def _outcomes(
    left: Sequence[Job], processes: int, in_process: bool, keep: Path | None
) -> Iterator[tuple[Job, Outcome]]:
    if processes == 1:
        for job in left:
            yield job, run(job, in_process, keep)
        return
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        running = {pool.submit(run, job, in_process, keep): job for job in left}
        for done in as_completed(running):
            yield running[done], done.result()


def lines(file: Path) -> list[dict[str, Any]]:
    """Of a result file; none where there is no file."""
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


def outcomes(file: Path) -> list[Outcome]:
    """Scored cases of a result file."""
    return [Outcome.from_json({k: v for k, v in line.items() if k != "key"}) for line in lines(file)]
