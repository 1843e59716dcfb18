"""Run the program on the files of cases and write the scored reports to a result file, one line for each case.

The program gets a folder with a recording and a model, and never the truth. A run can be continued: cases that the
result file already contains are not run again.
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
MIN_SIGNAL_STATUS: Final = 128


@dataclass(frozen=True)
class Job:
    """Parameters of one case to run."""

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
        """Unique name of the case in a result file."""
        sizes = "" if self.sizes is None else f" x{self.sizes[0]:g}-{self.sizes[1]:g}"
        return (
            f"{self.name} {self.level} {self.seed} {self.seconds:g}s {self.rate:g}Hz {self.axes} {self.baseline}{sizes}"
        )

    @property
    def folder(self) -> str:
        """Name of the folder of the case."""
        return self.key.replace(" ", "_").replace(":", "_")

    def case(self) -> cases.Case:
        """Make the case."""
        return cases.make_case(
            self.name,
            self.level,
            self.seed,
            seconds=self.seconds,
            rate=self.rate,
            axes=self.axes,
            baseline=self.baseline,
            sizes=self.sizes,
        )


def make_jobs(
    which: str,
    level: str,
    seeds: Sequence[int],
    seconds: float,
    only: Sequence[str] = (),
    baseline: str = "exact",
    sizes: tuple[float, float] | None = None,
) -> list[Job]:
    """Return the cases of a set.

    The set ``off`` contains the single effects with the baseline "off", and ``all`` contains the other four sets. The
    set ``nulls`` contains recordings of six axes with a sixth of the length, and of one axis with the whole length.

    Raises
    ------
    ValueError
        If there is no such set.
    """
    if which == "all":
        return [
            job
            for name in ("singles", "pairs", "nulls", "foreign")
            for job in make_jobs(name, level, seeds, seconds, only, baseline, sizes)
        ]
    if which == "off":
        which, baseline = "singles", "off"
    names = {"singles": cases.SINGLES, "pairs": cases.PAIRS, "foreign": cases.FOREIGN, "nulls": ("null",)}
    if which not in names:
        raise ValueError(f"no set {which!r}: {', '.join(names)}, off or all")
    if which in ("foreign", "nulls"):
        level, sizes = "plain", None  # these sets have a single level
    jobs = [
        Job(name, level, seed, seconds, baseline=baseline, sizes=sizes)
        for seed in seeds
        for name in names[which]
        if not only or name in only
    ]
    if which == "nulls":
        return [null for job in jobs for null in (replace(job, seconds=seconds / 6.0), replace(job, axes=1))]
    return jobs


def run_job(job: Job, in_process: bool = False, keep: Path | None = None) -> Outcome:
    """Make a case, run the program on its files, and score the report.

    Parameters
    ----------
    job
        Parameters of the case.
    in_process
        True to call the command in this process, False to start a separate process.
    keep
        Folder in which recording, model, report and truth are kept, with a folder for each case.
    """
    case = job.case()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) if keep is None else keep / job.folder
        recording, model = case.write(folder)
        out = folder / "out"
        arguments = ["reconcile", str(recording), "--model", str(model), "--out", str(out), "--seed", str(job.seed)]
        begin = time.perf_counter()
        status, output = (_run_in_process if in_process else _run_in_subprocess)(arguments)
        seconds = time.perf_counter() - begin
        report = out / "report.json"
        parsed = json.loads(report.read_text()) if report.exists() else None
        if keep is not None:
            (keep / f"{job.folder}.truth.json").write_text(case.truth_json())
            (folder / "output.txt").write_text(output)
    if status >= MIN_SIGNAL_STATUS:  # ended by a signal, so the program has no result and the run shall stop
        raise KeyboardInterrupt(f"{job.key}: exit status {status}")
    if parsed is None and status == 0:
        raise RuntimeError(f"{job.key}: exit status 0 without a report: {output}")
    if status in (1, 2):
        print(f"{job.key}: exit status {status}: {output.strip()[-500:]}", file=sys.stderr)
    return score(case.truth, parsed, status, seconds)


def _run_in_subprocess(arguments: list[str]) -> tuple[int, str]:
    done = subprocess.run(
        [sys.executable, "-m", "imu_monitor", *arguments],
        capture_output=True,
        text=True,
        timeout=TIME_LIMIT_S,
        check=False,
    )
    return done.returncode, done.stdout + done.stderr


def _run_in_process(arguments: list[str]) -> tuple[int, str]:
    """Call ``main`` of the program in this process, which saves the start of Python, and return status and output."""
    from monitor.cli import main

    output, before = io.StringIO(), sys.argv
    sys.argv = ["imu-monitor", *arguments]
    try:
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
            main()
    except SystemExit as stop:
        return int(stop.code or 0), output.getvalue()
    finally:
        sys.argv = before
    return 0, output.getvalue()


def run_all(
    todo: Sequence[Job], file: Path, processes: int, in_process: bool = False, keep: Path | None = None
) -> Iterator[Outcome]:
    """Run the cases that ``file`` does not contain yet, and append a line for each result."""
    known = {line["key"] for line in read_lines(file)}
    remaining = [job for job in todo if job.key not in known]
    with file.open("a") as results:
        for job, outcome in _outcomes(remaining, processes, in_process, keep):
            results.write(json.dumps({"key": job.key, **outcome.json()}) + "\n")
            results.flush()
            yield outcome


def _outcomes(
    remaining: Sequence[Job], processes: int, in_process: bool, keep: Path | None
) -> Iterator[tuple[Job, Outcome]]:
    if processes == 1:
        for job in remaining:
            yield job, run_job(job, in_process, keep)
        return
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        running = {pool.submit(run_job, job, in_process, keep): job for job in remaining}
        for done in as_completed(running):
            yield running[done], done.result()


def read_lines(file: Path) -> list[dict[str, Any]]:
    """Return the lines of a result file, or no lines if the file does not exist."""
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


def read_outcomes(file: Path) -> list[Outcome]:
    """Return the scored cases of a result file."""
    return [Outcome.from_json({k: v for k, v in line.items() if k != "key"}) for line in read_lines(file)]
