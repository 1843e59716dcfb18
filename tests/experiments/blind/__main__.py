"""The blind harness from the command line; what it is: ``tests/experiments/blind/__init__.py``.

python -m tests.experiments.blind --set singles --level plain --seeds 4 --jobs 2 --out plain.jsonl   # run and print
python -m tests.experiments.blind --set all --sizes 0.25 1 --seeds 8 --out power.jsonl               # power curves
python -m tests.experiments.blind --report plain.jsonl faint.jsonl                                   # print again
python -m tests.experiments.blind --set singles --level faint --only outliers --write cases  # only make the files
"""

import argparse
import os
import sys
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):  # before numpy: threads of two programs fight for the cores
    os.environ.setdefault(_name, "1")

from tests.experiments.blind import run, tables  # noqa: E402
from tests.experiments.blind.score import Outcome  # noqa: E402


def main() -> None:
    """Read the arguments, then run, write or print."""
    options = _options()
    if options.report:
        print(tables.report([one for file in options.report for one in run.outcomes(file)]))
        return
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    sizes = None if options.sizes is None else (options.sizes[0], options.sizes[1])
    todo = run.jobs(options.set, options.level, seeds, 3600.0 * options.hours, options.only, options.baseline, sizes)
    if options.write:
        _write(todo, options.write)
        return
    done = run.run_all(todo, options.out, options.jobs, options.in_process, options.keep)
    for count, outcome in enumerate(done, 1):
        print(f"{count:4d} {_line(outcome)}", file=sys.stderr, flush=True)
    print(tables.report(run.outcomes(options.out)))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m tests.experiments.blind", description="Hidden effects through reconcile."
    )
    parser.add_argument("--set", choices=("singles", "pairs", "nulls", "foreign", "off", "all"), default="singles")
    parser.add_argument("--level", choices=("plain", "faint"), default="plain")
    parser.add_argument("--baseline", choices=("exact", "off"), default="exact", help="off: N, B, K 5 %% off")
    parser.add_argument("--seeds", type=int, default=4, help="how many of each case")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument(
        "--sizes", type=float, nargs=2, metavar=("LO", "HI"), help="draw multiples of the level's size from this range"
    )
    parser.add_argument("--hours", type=float, default=1.0, help="length of recordings")
    parser.add_argument("--only", nargs="+", default=(), metavar="CASE", help="these cases of the set")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--in-process", action="store_true", help="call the command without starting a program")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep recordings, models, reports and truths")
    parser.add_argument("--out", type=Path, metavar="FILE.jsonl", help="results, continued where they end")
    parser.add_argument("--report", type=Path, nargs="+", metavar="FILE.jsonl", help="print results, run nothing")
    parser.add_argument("--write", type=Path, metavar="DIR", help="make recordings, models and truths, run nothing")
    options = parser.parse_args()
    if not (options.out or options.report or options.write):
        parser.error("one of --out, --report and --write is needed")
    return options


def _write(todo: list[run.Job], folder: Path) -> None:
    """Each case a folder; its truth beside the folder, not in it."""
    for job in todo:
        case = job.case()
        case.write(folder / job.folder)
        (folder / f"{job.folder}.truth.json").write_text(case.truth_json())
        print(folder / job.folder)


def _line(outcome: Outcome) -> str:
    mark = "right" if outcome.right else "WRONG"
    said = (
        ", ".join(f"{name.axis} {name.effect}{'' if name.right else ' (false)'}" for name in outcome.names) or "no name"
    )
    missed = "".join(f"; missed {name.axis} {name.effect}" for name in outcome.missed)
    where = f"{outcome.case} {outcome.level} {outcome.seed}"
    return f"{mark} {where}: {outcome.verdict or outcome.exit_status}: {said}{missed}; {outcome.seconds:.1f} s"


if __name__ == "__main__":
    main()
