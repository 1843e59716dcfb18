"""Run all benchmarks with short settings in a few minutes: ``python -m tests.experiments.benchmarks``."""

import subprocess
import sys
from typing import Final

RUNS: Final = (
    ("bench_window", "--rounds", "7"),
    ("bench_batch", "--samples", "300000", "--rounds", "3"),
    ("bench_paper", "--budget", "0.05", "--rounds", "1", "--windows", "10000"),
    ("bench_memory", "--rate", "200", "--window", "600"),
    ("bench_simulate", "--rounds", "3", "--memory", "2e6"),
    ("bench_bag", "--hours", "0.2"),
    ("bench_reconcile", "--rows", "100000"),
    ("bench_decoders",),
    ("bench_imports", "--rounds", "3"),
    ("bench_latency", "--seconds", "10"),
    ("bench_devices", "--seconds", "10"),
)


def main() -> None:
    """Run each benchmark in a separate process."""
    failed = []
    for name, *arguments in RUNS:
        command = [sys.executable, "-m", f"tests.experiments.benchmarks.{name}", *arguments]
        if subprocess.run(command, check=False).returncode:
            failed.append(name)
    if failed:
        raise SystemExit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
