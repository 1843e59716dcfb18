"""Run one fuzz target in this process. ``__main__`` starts this program for each target.

With atheris, the modules of ``drivers`` and ``monitor`` are imported with counters at every branch, and inputs that
reach a new branch are stored and mutated further. Modules that Numba compiles and modules of libraries have no
counters. A run continues after a finding, and stores the shortest input of each finding.
"""

import json
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Final

from tests.experiments.fuzz.limits import ROOT, Finding, enforce_limits, try_input
from tests.experiments.fuzz.mutations import generate_inputs
from tests.experiments.fuzz.target import Target, load_targets

HANG_LIMIT_S: Final = 300
"""Elapsed time after which an input that does not return from a C library ends the run."""
RESIDENT_MB: Final = 2500


@dataclass
class Run:
    """State of a run."""

    name: str
    inputs: int = 0
    started_s: float = field(default_factory=time.monotonic)
    deadline_s: float = float("inf")
    findings: dict[tuple[str, str], Finding] = field(default_factory=dict)
    counts: dict[tuple[str, str], int] = field(default_factory=dict)

    def add_input(self, target: Target, data: bytes) -> None:
        """Try an input and store its finding."""
        self.inputs += 1
        found = try_input(target, data)
        if found is not None:
            self.counts[found.key] = self.counts.get(found.key, 0) + 1
            previous = self.findings.get(found.key)
            if previous is None or len(found.data) < len(previous.data):
                self.findings[found.key] = found

    def save(self, folder: Path) -> None:
        """Write counts and findings to the folder."""
        found = []
        for i, (key, finding) in enumerate(self.findings.items()):
            (folder / f"finding-{i}").write_bytes(finding.data)
            found.append(
                {
                    "error": finding.error,
                    "location": finding.location,
                    "count": self.counts[key],
                    "file": f"finding-{i}",
                }
            )
        seconds = time.monotonic() - self.started_s
        (folder / "run.json").write_text(
            json.dumps({"target": self.name, "inputs": self.inputs, "seconds": seconds, "findings": found})
        )


def run_random(name: str, n: int, seed: int, seconds: float, folder: Path) -> None:
    """Run a target with random inputs."""
    target = load_targets()[name]
    run = Run(name)
    with enforce_limits():
        for data in generate_inputs(target, n, seed):
            run.add_input(target, data)
            if time.monotonic() - run.started_s > seconds:
                break
    run.save(folder)


def run_guided(name: str, n: int, seed: int, seconds: float, folder: Path) -> None:
    """Run a target guided by coverage. libFuzzer prints its statistics and ends the process."""
    import atheris

    with atheris.instrument_imports(include=["drivers", "monitor"], exclude=list_compiled_modules()):
        target = load_targets()[name]
    corpus = folder / "corpus"
    corpus.mkdir(exist_ok=True)
    for i, data in enumerate(target.seeds()):
        (corpus / f"seed-{i}").write_bytes(data[: target.size])
    arguments = [
        f"-runs={n}", f"-seed={seed or 1}", f"-max_len={target.size}", f"-max_total_time={int(seconds)}",
        f"-timeout={HANG_LIMIT_S}", f"-rss_limit_mb={RESIDENT_MB}", "-print_final_stats=1", "-verbosity=1", "-reload=0",
        f"-artifact_prefix={folder}/ended-by-",
    ]  # fmt: skip
    if target.words:
        words = folder / "words"
        words.write_text("".join(f'"{_escaped(word)}"\n' for word in target.words))
        arguments.append(f"-dict={words}")
    run = Run(name)
    with enforce_limits():
        saved_s = time.monotonic()

        def try_and_save(data: bytes) -> None:
            nonlocal saved_s
            run.add_input(target, data)
            if time.monotonic() - saved_s > 1.0:  # atheris ends the process without notice
                saved_s = time.monotonic()
                run.save(folder)
            if run.inputs >= n:
                run.save(folder)

        atheris.Setup([sys.argv[0], *arguments, str(corpus)], try_and_save)
        atheris.Fuzz()


def cache_can_readers() -> None:
    """Cache the readers of python-can, which searches all installed packages for each log."""
    from can.io import player

    player.read_entry_points = cache(player.read_entry_points)  # type: ignore[attr-defined]


def list_compiled_modules() -> list[str]:
    """Return the modules with kernels, whose bytecode Numba reads."""
    files = [file for package in ("drivers", "monitor") for file in (ROOT / package).rglob("*.py")]
    found = [file for file in files if "monitor.common.compiled import" in file.read_text("utf-8")]
    names = [".".join(file.relative_to(ROOT).with_suffix("").parts) for file in found]
    return [*names, "monitor.common.compiled"]


def _escaped(word: bytes) -> str:
    return "".join(chr(b) if b < 128 and chr(b).isalnum() else f"\\x{b:02X}" for b in word)


RUNS: Final[dict[str, Callable[[str, int, int, float, Path], Any]]] = {"guided": run_guided, "random": run_random}

if __name__ == "__main__":
    cache_can_readers()
    _, engine, name, count, seed, limit_s, out = sys.argv
    RUNS[engine](name, int(count), int(seed), float(limit_s), Path(out) if out else Path(tempfile.mkdtemp()))
