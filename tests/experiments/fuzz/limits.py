"""Limits of processor time, memory and warnings for one input. An input that violates a limit or check is a finding.

The limit of time is processor time, so it does not depend on the load of the machine. Memory has two limits. The limit
of the address space turns a length of gigabytes that a file only declares into a MemoryError. The other limit is the
growth of the resident memory during one input.
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

MAX_CPU_S: Final = 5.0
"""Limit of processor time for one input of a few kilobytes, in seconds."""
MAX_GROWTH_BYTES: Final = 200_000_000
"""Limit of the growth of the resident memory during one input."""
MAX_ADDRESS_SPACE_BYTES: Final = 3_000_000_000
"""Limit of the address space beyond the memory that the process has already mapped."""
ROOT: Final = Path(__file__).resolve().parents[3]


class TooSlow(Exception):
    """An input took more processor time than MAX_CPU_S."""


class TooLarge(Exception):
    """An input increased the resident memory by more than MAX_GROWTH_BYTES."""


@dataclass(frozen=True)
class Finding:
    """Error that one input caused."""

    target: str
    data: bytes
    error: str  # the exception in one line
    location: str  # innermost line of this project outside the fuzz tests

    @property
    def key(self) -> tuple[str, str]:
        """Type of the error and location. Findings with the same key count as one."""
        return self.error.partition(":")[0], self.location


@contextmanager
def enforce_limits() -> Iterator[None]:
    """Turn warnings into errors and limit the address space within the ``with`` block."""
    before = signal.signal(signal.SIGVTALRM, _raise_too_slow)
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (mapped + MAX_ADDRESS_SPACE_BYTES, hard))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.signal(signal.SIGVTALRM, before)


def try_input(target: Target, data: bytes) -> Finding | None:
    """Return the finding that an input causes, or None. Call this within ``enforce_limits``."""
    resident = _peak_resident_bytes()
    signal.setitimer(signal.ITIMER_VIRTUAL, MAX_CPU_S)
    try:
        target.check(data)
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        grown = _peak_resident_bytes() - resident
        if grown > MAX_GROWTH_BYTES:
            raise TooLarge(f"{grown} bytes for an input of {len(data)}")
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # noqa: BLE001 - every exception is a finding, including a panic of a library
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        return Finding(target.name, data, _format_error(error), _find_location(error))
    return None


def _raise_too_slow(_signal: int, _frame: FrameType | None) -> None:
    raise TooSlow(f"more than {MAX_CPU_S:g} s of processor time")


def _peak_resident_bytes() -> int:
    """Return the largest resident memory of the process so far, in bytes."""
    if sys.platform == "darwin":
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # On Linux, both calls return the peak of the process, and this one is up to 200 times as fast.
    return resource.getrusage(resource.RUSAGE_THREAD).ru_maxrss * 1024


def _format_error(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"


def _find_location(error: BaseException) -> str:
    """Return the innermost line of drivers or monitor in the traceback, or else of the fuzz tests."""
    frames = [(Path(f.filename), f.lineno) for f in traceback.extract_tb(error.__traceback__)]
    ours = [(file, line) for file, line in frames if ROOT in file.parents]
    inner = [(file, line) for file, line in ours if "tests" not in file.relative_to(ROOT).parts]
    if isinstance(error, AssertionError):
        inner = ours
    file, line = (inner or ours or frames)[-1]
    return f"{file.relative_to(ROOT) if ROOT in file.parents else file.name}:{line}"
