"""One target, so many inputs, in this process: what ``__main__`` starts for each target.

With atheris the modules of ``drivers`` and ``monitor`` are imported with counters at every branch, and inputs that
reach a new one are kept and changed further. Modules that Numba compiles, and those that libraries bring, are left as
they are. A finding ends nothing: the first input of each kind is kept, and the run goes on.
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

from tests.experiments.fuzz.limits import ROOT, Finding, limited, tried
from tests.experiments.fuzz.mutations import inputs
from tests.experiments.fuzz.target import Target, targets

STUCK_S: Final = 300
"""Of real time: an input that keeps one call of a C library busy for so long ends the run."""
RESIDENT_MB: Final = 2500


@dataclass
class Run:
    """How far a run has come."""

    name: str
    inputs: int = 0
    started_s: float = field(default_factory=time.monotonic)
    deadline_s: float = float("inf")
    findings: dict[tuple[str, str], Finding] = field(default_factory=dict)
    counts: dict[tuple[str, str], int] = field(default_factory=dict)

    def one(self, target: Target, data: bytes) -> None:
        """Try an input."""
        self.inputs += 1
        found = tried(target, data)
        if found is not None:
            self.counts[found.key] = self.counts.get(found.key, 0) + 1
            kept = self.findings.get(found.key)
            if kept is None or len(found.data) < len(kept.data):
                self.findings[found.key] = found

    def save(self, folder: Path) -> None:
        """Leave numbers and findings in the folder."""
        found = []
        for i, (key, one) in enumerate(self.findings.items()):
            (folder / f"finding-{i}").write_bytes(one.data)
            found.append({"what": one.what, "where": one.where, "count": self.counts[key], "file": f"finding-{i}"})
        seconds = time.monotonic() - self.started_s
        (folder / "run.json").write_text(
            json.dumps({"target": self.name, "inputs": self.inputs, "seconds": seconds, "findings": found})
        )


def random_run(name: str, n: int, seed: int, seconds: float, folder: Path) -> None:
    """Without coverage."""
    target = targets()[name]
    run = Run(name)
    with limited():
        for data in inputs(target, n, seed):
            run.one(target, data)
            if time.monotonic() - run.started_s > seconds:
                break
    run.save(folder)


def guided_run(name: str, n: int, seed: int, seconds: float, folder: Path) -> None:
    """With coverage; the process ends in here, with libFuzzer's figures on standard error."""
    import atheris

    with atheris.instrument_imports(include=["drivers", "monitor"], exclude=compiled()):
        target = targets()[name]
    corpus = folder / "corpus"
    corpus.mkdir(exist_ok=True)
    for i, data in enumerate(target.seeds()):
        (corpus / f"seed-{i}").write_bytes(data[: target.size])
    arguments = [
        f"-runs={n}", f"-seed={seed or 1}", f"-max_len={target.size}", f"-max_total_time={int(seconds)}",
        f"-timeout={STUCK_S}", f"-rss_limit_mb={RESIDENT_MB}", "-print_final_stats=1", "-verbosity=1", "-reload=0",
        f"-artifact_prefix={folder}/ended-by-",
    ]  # fmt: skip
    if target.words:
        words = folder / "words"
        words.write_text("".join(f'"{_escaped(word)}"\n' for word in target.words))
        arguments.append(f"-dict={words}")
    run = Run(name)
    with limited():
        saved_s = time.monotonic()

        def one(data: bytes) -> None:
            nonlocal saved_s
            run.one(target, data)
            if time.monotonic() - saved_s > 1.0:  # the process ends without a word
                saved_s = time.monotonic()
                run.save(folder)
            if run.inputs >= n:
                run.save(folder)

        atheris.Setup([sys.argv[0], *arguments, str(corpus)], one)
        atheris.Fuzz()


def remember_readers() -> None:
    """python-can looks through all installed packages for further readers with each log: here once."""
    from can.io import player

    player.read_entry_points = cache(player.read_entry_points)  # type: ignore[attr-defined]


def compiled() -> list[str]:
    """Modules with kernels: Numba reads their bytecode."""
    files = [file for room in ("drivers", "monitor") for file in (ROOT / room).rglob("*.py")]
    found = [file for file in files if "monitor.common.compiled import" in file.read_text("utf-8")]
    names = [".".join(file.relative_to(ROOT).with_suffix("").parts) for file in found]
    return [*names, "monitor.common.compiled"]


def _escaped(word: bytes) -> str:
    return "".join(chr(b) if b < 128 and chr(b).isalnum() else f"\\x{b:02X}" for b in word)


RUNS: Final[dict[str, Callable[[str, int, int, float, Path], Any]]] = {"guided": guided_run, "random": random_run}

if __name__ == "__main__":
    remember_readers()
    _, how, what, many, begin, limit, place = sys.argv
    RUNS[how](what, int(many), int(begin), float(limit), Path(place) if place else Path(tempfile.mkdtemp()))
