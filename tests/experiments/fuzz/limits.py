"""One input under limits: processor time, memory, no warning; what breaks one, or the target's own rules, is a finding.

Time is counted as the processor's, so that a busy machine makes nothing slow. Memory is limited twice: the address
space of the process, so that a length of gigabytes that a file only declares ends in MemoryError, and the growth of
what is resident with one input.
"""

import resource
import signal
import sys
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Final

from tests.experiments.fuzz.target import Target

SECONDS: Final = 5.0
"""Of the processor for one input; inputs are a few kilobytes."""
RESIDENT_BYTES: Final = 200_000_000
"""One input may make the process grow by so much."""
ADDRESS_BYTES: Final = 3_000_000_000
"""Above what the process has mapped already."""
ROOT: Final = Path(__file__).resolve().parents[3]


class TooSlow(Exception):
    """An input took more than SECONDS."""


class TooLarge(Exception):
    """An input took more than RESIDENT_BYTES."""


@dataclass(frozen=True)
class Finding:
    """What one input showed."""

    target: str
    data: bytes
    what: str  # the exception in one line
    where: str  # innermost line of this project outside the harness

    @property
    def key(self) -> tuple[str, str]:
        """Findings with the same key are one."""
        return self.what.partition(":")[0], self.where


@contextmanager
def limited() -> Iterator[None]:
    """Within it warnings are errors, and the address space has an end."""
    before = signal.signal(signal.SIGVTALRM, _too_slow)
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (mapped + ADDRESS_BYTES, hard))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.signal(signal.SIGVTALRM, before)


def tried(target: Target, data: bytes) -> Finding | None:
    """What this input shows; None while all is well. To be called within ``limited``."""
    resident = _resident()
    signal.setitimer(signal.ITIMER_VIRTUAL, SECONDS)
    try:
        target.check(data)
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        grown = _resident() - resident
        if grown > RESIDENT_BYTES:
            raise TooLarge(f"{grown} bytes for an input of {len(data)}")
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # noqa: BLE001 - whatever it is, a panic of a library too, it is a finding
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        return Finding(target.name, data, _line(error), _place(error))
    return None


def _too_slow(_signal: int, _frame: FrameType | None) -> None:
    raise TooSlow(f"more than {SECONDS:g} s of the processor")


def _resident() -> int:
    """Largest resident size so far, bytes."""
    size = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return size if sys.platform == "darwin" else size * 1024


def _line(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"


def _place(error: BaseException) -> str:
    """Innermost line of drivers or monitor; of the harness where there is none."""
    frames = [(Path(f.filename), f.lineno) for f in traceback.extract_tb(error.__traceback__)]
    ours = [(file, line) for file, line in frames if ROOT in file.parents]
    inner = [(file, line) for file, line in ours if "tests" not in file.relative_to(ROOT).parts]
    if isinstance(error, AssertionError):
        inner = ours
    file, line = (inner or ours or frames)[-1]
    return f"{file.relative_to(ROOT) if ROOT in file.parents else file.name}:{line}"
