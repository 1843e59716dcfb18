"""Duration of short commands, and the heavy libraries that each command loads.

    python -m tests.experiments.benchmarks.bench_imports [--rounds 5]

Each command runs in a separate process. The times are the elapsed time and the processor time of the whole process. The
modules are counted at the end of the command.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np

from tests.experiments.benchmarks.machine import Load, console, create_table, describe_machine

ROOT: Final = Path(__file__).parents[3]
COMMANDS: Final = {
    "(python alone)": None,
    "--help": ["--help"],
    "check config/serial.toml": ["check", "config/serial.toml"],
    "check config/demo.toml": ["check", "config/demo.toml"],
    "check --print-defaults": ["check", "--print-defaults"],
}
HEAVY: Final = ("numpy", "scipy", "numba", "zenoh", "rerun", "can", "cantools", "serial", "rich", "typer", "matplotlib")
RUN: Final = """
import json, sys
if len(sys.argv) > 2:
    from monitor.cli import main
    path = sys.argv.pop(1)
    try:
        main()
    except SystemExit as end:
        if end.code:
            raise
else:
    path = sys.argv[1]
with open(path, "w") as file:
    json.dump(sorted(sys.modules), file)
"""


def run_command(arguments: list[str] | None, modules: Path) -> tuple[float, float]:
    """Run a command once and return elapsed time and processor time in seconds."""
    before, start = os.times(), time.perf_counter()
    command = [sys.executable, "-c", RUN, str(modules), *(arguments or [])]
    subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
    after = os.times()
    cpu_s = after.children_user + after.children_system - before.children_user - before.children_system
    return time.perf_counter() - start, cpu_s


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    rounds = parser.parse_args().rounds
    console.print(describe_machine())
    table = create_table(
        f"imu-monitor, whole process; median (best) of {rounds}", "command", "wall", "processor", "modules", "of them"
    )
    load = Load()
    with TemporaryDirectory() as folder:
        modules = Path(folder) / "modules.json"
        for name, arguments in COMMANDS.items():
            took = np.array([run_command(arguments, modules) for _ in range(rounds)])
            median, best = np.median(took, axis=0), took.min(axis=0)
            loaded = json.loads(modules.read_text())
            heavy = ", ".join(library for library in HEAVY if library in loaded)
            times = [f"{m:.2f} ({b:.2f}) s" for m, b in zip(median, best, strict=True)]
            table.add_row(name, *times, f"{len(loaded)}", heavy)
    console.print(table)
    console.print(load.describe())


if __name__ == "__main__":
    main()
