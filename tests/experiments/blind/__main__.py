"""Command line of the blind trials, which ``tests/experiments/blind/__init__.py`` describes.

python -m tests.experiments.blind --set singles --level plain --seeds 4 --jobs 2 --out plain.jsonl   # run and print
python -m tests.experiments.blind --set all --sizes 0.25 1 --seeds 8 --out power.jsonl               # power curves
python -m tests.experiments.blind --report plain.jsonl faint.jsonl                                   # print results
python -m tests.experiments.blind --set singles --level faint --only outliers --write cases  # write the files only
"""

import argparse
import os
import sys
from pathlib import Path

# set before NumPy is imported, so that programs do not compete for the cores
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from tests.experiments.blind import run, tables  # noqa: E402
from tests.experiments.blind.score import Outcome  # noqa: E402


def main() -> None:
    """Run the cases, write their files or print stored results, as the arguments say."""
    options = _options()
    if options.report:
        print(tables.format_report([outcome for file in options.report for outcome in run.read_outcomes(file)]))
        return
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    sizes = None if options.sizes is None else (options.sizes[0], options.sizes[1])
    todo = run.make_jobs(
        options.set, options.level, seeds, 3600.0 * options.hours, options.only, options.baseline, sizes
    )
    if options.write:
        _write(todo, options.write)
        return
    done = run.run_all(todo, options.out, options.jobs, options.in_process, options.keep)
    for count, outcome in enumerate(done, 1):
        print(f"{count:4d} {_line(outcome)}", file=sys.stderr, flush=True)
    print(tables.format_report(run.read_outcomes(options.out)))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m tests.experiments.blind", description="Run reconcile on recordings with hidden effects."
    )
    parser.add_argument("--set", choices=("singles", "pairs", "nulls", "foreign", "off", "all"), default="singles")
    parser.add_argument("--level", choices=("plain", "faint"), default="plain")
    parser.add_argument(
        "--baseline", choices=("exact", "off"), default="exact", help="off: N, B, K have errors of 5 %%"
    )
    parser.add_argument("--seeds", type=int, default=4, help="number of recordings of each case")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--sizes", type=float, nargs=2, metavar=("LO", "HI"), help="range of the factor on the size")
    parser.add_argument("--hours", type=float, default=1.0, help="length of recordings")
    parser.add_argument("--only", nargs="+", default=(), metavar="CASE", help="only these cases of the set")
    parser.add_argument("--jobs", type=int, default=1, help="number of processes")
    parser.add_argument("--in-process", action="store_true", help="call the command in this process")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="folder for recordings, models, reports and truths")
    parser.add_argument("--out", type=Path, metavar="FILE.jsonl", help="result file, which a later run continues")
    parser.add_argument("--report", type=Path, nargs="+", metavar="FILE.jsonl", help="print stored results only")
    parser.add_argument("--write", type=Path, metavar="DIR", help="write recordings, models and truths only")
    options = parser.parse_args()
    if not (options.out or options.report or options.write):
        parser.error("one of --out, --report and --write is needed")
    return options


def _write(todo: list[run.Job], folder: Path) -> None:
    """Write each case to a folder, and its truth to a file beside the folder."""
    for job in todo:
        case = job.case()
        case.write(folder / job.folder)
        (folder / f"{job.folder}.truth.json").write_text(case.truth_json())
        print(folder / job.folder)


def _line(outcome: Outcome) -> str:
    mark = "right" if outcome.right else "WRONG"
    names = (
        ", ".join(f"{name.axis} {name.effect}{'' if name.right else ' (false)'}" for name in outcome.names) or "no name"
    )
    missed = "".join(f"; missed {name.axis} {name.effect}" for name in outcome.missed)
    where = f"{outcome.case} {outcome.level} {outcome.seed}"
    return f"{mark} {where}: {outcome.verdict or outcome.exit_status}: {names}{missed}; {outcome.seconds:.1f} s"


if __name__ == "__main__":
    main()
