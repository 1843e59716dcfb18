"""All that fuzzing found, tried again; a moment of fuzzing of every target; and that the harness sees what is wrong."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import psutil
import pytest

import drivers.decoders
from drivers import module_lookup
from drivers.data_types import Chunk
from drivers.decoders.base import FrameBuffer, Frames
from drivers.recordings import FORMATS
from tests.experiments.fuzz import limits
from tests.experiments.fuzz.limits import limited, tried
from tests.experiments.fuzz.mutations import inputs
from tests.experiments.fuzz.target import Target, targets

CASES = Path(__file__).resolve().parents[1] / "cases" / "fuzz"
TARGETS = targets()
FOUND = sorted(file for file in CASES.rglob("*") if file.is_file())
A_MOMENT = 60
"""Inputs of each target."""


@pytest.fixture(autouse=True)
def _within_limits() -> Iterator[None]:
    with limited():
        yield


def test_every_reader_has_a_target() -> None:
    decoders = {
        f"{kind}-{name}" for kind in ("decoder", "wire") for name in module_lookup.list_modules(drivers.decoders)
    }
    formats = {f"recording-{suffix[1:].replace('.', '-')}" for suffix in FORMATS}
    assert decoders | formats <= TARGETS.keys()


@pytest.mark.parametrize("case", FOUND, ids=lambda case: f"{case.parent.name}-{case.name}")
def test_what_was_found_is_mended(case: Path) -> None:
    assert tried(TARGETS[case.parent.name], case.read_bytes()) is None


@pytest.mark.parametrize("name", TARGETS)
def test_a_moment_of_each_target(name: str) -> None:
    found = [one for data in inputs(TARGETS[name], A_MOMENT, seed=1) if (one := tried(TARGETS[name], data)) is not None]
    assert not found, found[0]


# --- the harness itself


def finding(check: object) -> str:
    found = tried(Target("made", check, tuple, 100), b"some")  # type: ignore[arg-type]
    assert found is not None
    return found.what.partition(":")[0]


def test_an_exception_a_warning_and_an_assertion_are_findings() -> None:
    import numpy as np

    def warns(data: bytes) -> None:
        np.array([1e300]) * np.array([1e300])

    def asserts(data: bytes) -> None:
        assert not data

    assert finding(lambda data: data[4]) == "IndexError"
    assert finding(warns) == "RuntimeWarning"
    assert finding(asserts) == "AssertionError"


def test_what_does_not_end_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "SECONDS", 0.2)

    def for_ever(data: bytes) -> None:
        while True:
            pass

    assert finding(for_ever) == "TooSlow"


def test_memory_that_is_only_claimed_and_memory_that_is_used() -> None:
    kept = []

    def claims(data: bytes) -> None:
        kept.append(bytearray(40_000_000_000))

    # what counts is the largest size so far, and earlier tests may have been large
    spare = limits._resident() - psutil.Process().memory_info().rss

    def uses(data: bytes) -> None:
        kept.append(b"x" * (max(spare, 0) + limits.RESIDENT_BYTES + 50_000_000))

    assert finding(claims) == "MemoryError"
    assert finding(uses) == "TooLarge"
    kept.clear()


def test_a_sample_of_a_frame_whose_check_fails_would_be_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    from drivers.decoders import stim300, xsens_mtdata2

    monkeypatch.setattr(stim300, "has_valid_crc", lambda frame: True)
    monkeypatch.setattr(xsens_mtdata2, "sum", lambda data: 0, raising=False)
    for name in ("wire-stim300", "wire-xsens_mtdata2"):
        found = [tried(TARGETS[name], data) for data in inputs(TARGETS[name], 300, seed=1)]
        assert any(one is not None and "no valid frame" in one.what for one in found), name


def test_another_cut_that_gives_other_samples_would_be_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    feed = FrameBuffer.feed

    def forgetful(self: FrameBuffer, chunks: Sequence[Chunk]) -> Frames:
        frames = feed(self, chunks)
        self._buffer_offset += len(self._buffer)
        self._buffer = b""
        return frames

    monkeypatch.setattr(FrameBuffer, "feed", forgetful)
    name = "decoder-witmotion"
    found = [tried(TARGETS[name], data) for data in inputs(TARGETS[name], 100, seed=1)]
    assert any(one is not None and "cut" in one.what for one in found)
