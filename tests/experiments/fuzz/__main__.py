"""Run each fuzz target in its own process: ``python -m tests.experiments.fuzz [TARGET …] --inputs N --seed S``.

The program prints a line for each target with the number of inputs, the inputs per second, the reached edges between
branches of drivers and monitor, and the findings. The inputs of findings are written to ``--out``. The exit status is 1
if there is a finding.
"""

import argparse
import importlib.util
import json
import re
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from tests.experiments.fuzz.target import load_targets

COVERED = re.compile(r"cov: (\d+) ft: (\d+)")


def main() -> int:
    """Run the requested targets."""
    arguments = _arguments()
    known = load_targets()
    unknown = [name for name in arguments.targets if name not in known]
    if unknown:
        print(f"no target {', '.join(unknown)}; there are {', '.join(known)}", file=sys.stderr)
        return 2
    if arguments.list:
        print("\n".join(known))
        return 0
    names = arguments.targets or list(known)
    out = Path(arguments.out or tempfile.mkdtemp(prefix="fuzz-"))
    print(f"{'target':28} {'inputs':>10} {'a second':>9} {'edges':>6}  findings", flush=True)
    with ThreadPoolExecutor(arguments.jobs) as pool:
        runs = list(pool.map(lambda name: _run(name, arguments, out), names))
    total = sum(run["inputs"] for run in runs)
    found = sum(len(run["findings"]) for run in runs)
    print(f"{'all':28} {total:10,} {'':9} {'':6}  {found}; inputs are in {out}")
    (out / "runs.json").write_text(json.dumps(runs, indent=1))
    return 1 if found else 0


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.experiments.fuzz")
    parser.add_argument("targets", nargs="*", metavar="TARGET", help="targets to run (default: all)")
    parser.add_argument("--inputs", type=int, default=100_000, help="inputs of each target")
    parser.add_argument("--seconds", type=float, default=3600.0, help="time limit of each target")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1, help="number of parallel processes")
    parser.add_argument(
        "--out", help="folder for findings and inputs that reach new code (default: a temporary folder)"
    )
    parser.add_argument("--list", action="store_true", help="print the targets")
    guided = importlib.util.find_spec("atheris") is not None
    parser.add_argument("--engine", choices=("guided", "random"), default="guided" if guided else "random")
    return parser.parse_args()


def _run(name: str, arguments: argparse.Namespace, out: Path) -> dict[str, Any]:
    folder = out / name
    folder.mkdir(parents=True, exist_ok=True)
    words = [arguments.engine, name, arguments.inputs, arguments.seed, arguments.seconds, folder]
    with (folder / "log").open("w") as log:
        command = [sys.executable, "-m", "tests.experiments.fuzz.run", *map(str, words)]
        ended = subprocess.run(command, stdout=log, stderr=log, check=False)
    log_text = (folder / "log").read_text(errors="replace")
    file = folder / "run.json"
    run: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {"target": name, "inputs": 0, "seconds": 1}
    run.setdefault("findings", [])
    covered = COVERED.findall(log_text)
    run["edges"] = int(covered[-1][0]) if covered else None
    if ended.returncode:
        run["findings"].append({"error": f"the process ended with {ended.returncode}", "location": str(folder / "log")})
    rate = run["inputs"] / max(run["seconds"], 1e-9)
    found = len(run["findings"])
    print(f"{name:28} {run['inputs']:10,} {rate:9,.0f} {run['edges'] or '':>6}  {found or ''}", flush=True)
    for finding in run["findings"]:
        print(f"    {finding['location']}: {finding['error']}", flush=True)
    return run


if __name__ == "__main__":
    sys.exit(main())
