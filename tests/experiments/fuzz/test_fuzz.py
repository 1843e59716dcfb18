"""Tests with all inputs that have caused faults, with new random inputs, and tests of the fuzzing code itself."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import psutil
import pytest

import drivers.decoders
from drivers.data_types import Chunk
from drivers.decoders.base import FrameBuffer, RawFrames
from drivers.recordings import FORMATS
from drivers.validation import module_lookup
from tests.experiments.fuzz import limits
from tests.experiments.fuzz.limits import enforce_limits, try_input
from tests.experiments.fuzz.mutations import generate_inputs
from tests.experiments.fuzz.target import Target, load_targets

CASES = Path(__file__).resolve().parents[1] / "cases" / "fuzz"
TARGETS = load_targets()
STORED_INPUTS = sorted(file for file in CASES.rglob("*") if file.is_file())
INPUTS_PER_TARGET = 60
"""Number of new inputs for each target."""


@pytest.fixture(autouse=True)
def _apply_limits() -> Iterator[None]:
    with enforce_limits():
        yield


def test_every_reader_has_a_target() -> None:
    decoders = {
        f"{kind}-{name}" for kind in ("decoder", "wire") for name in module_lookup.list_modules(drivers.decoders)
    }
    formats = {f"recording-{suffix[1:].replace('.', '-')}" for suffix in FORMATS}
    assert decoders | formats <= TARGETS.keys()


@pytest.mark.parametrize("case", STORED_INPUTS, ids=lambda case: f"{case.parent.name}-{case.name}")
def test_stored_input_causes_no_fault(case: Path) -> None:
    assert try_input(TARGETS[case.parent.name], case.read_bytes()) is None


@pytest.mark.parametrize("name", TARGETS)
def test_random_inputs_cause_no_fault(name: str) -> None:
    found = [
        finding
        for data in generate_inputs(TARGETS[name], INPUTS_PER_TARGET, seed=1)
        if (finding := try_input(TARGETS[name], data)) is not None
    ]
    assert not found, found[0]


# --- the fuzzing code itself


def find_error_type(check: object) -> str:
    found = try_input(Target("test", check, tuple, 100), b"some")  # type: ignore[arg-type]
    assert found is not None
    return found.error.partition(":")[0]


def test_exception_warning_and_failed_assertion_are_findings() -> None:
    import numpy as np

    def warns(data: bytes) -> None:
        np.array([1e300]) * np.array([1e300])

    def asserts(data: bytes) -> None:
        assert not data

    assert find_error_type(lambda data: data[4]) == "IndexError"
    assert find_error_type(warns) == "RuntimeWarning"
    assert find_error_type(asserts) == "AssertionError"


def test_endless_check_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "MAX_CPU_S", 0.2)

    def loop_forever(data: bytes) -> None:
        while True:
            pass

    assert find_error_type(loop_forever) == "TooSlow"


def test_large_allocation_and_large_growth_are_findings() -> None:
    buffers = []

    def claims(data: bytes) -> None:
        buffers.append(bytearray(40_000_000_000))

    # the limit uses the largest memory so far, which earlier tests may have increased
    spare = limits._peak_resident_bytes() - psutil.Process().memory_info().rss

    def uses(data: bytes) -> None:
        buffers.append(b"x" * (max(spare, 0) + limits.MAX_GROWTH_BYTES + 50_000_000))

    assert find_error_type(claims) == "MemoryError"
    assert find_error_type(uses) == "TooLarge"
    buffers.clear()


def test_sample_of_a_frame_with_wrong_checksum_is_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    from drivers.decoders.binary_frames import stim300, xsens_mtdata2

    monkeypatch.setattr(stim300, "has_valid_crc", lambda frame: True)
    monkeypatch.setattr(xsens_mtdata2, "sum", lambda data: 0, raising=False)
    for name in ("wire-stim300", "wire-xsens_mtdata2"):
        found = [try_input(TARGETS[name], data) for data in generate_inputs(TARGETS[name], 300, seed=1)]
        assert any(finding is not None and "no valid frame" in finding.error for finding in found), name


def test_samples_that_depend_on_the_chunks_are_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    feed = FrameBuffer.feed

    def feed_and_drop_buffer(self: FrameBuffer, chunks: Sequence[Chunk]) -> RawFrames:
        frames = feed(self, chunks)
        self._buffer_offset += len(self._buffer)
        self._buffer = b""
        return frames

    monkeypatch.setattr(FrameBuffer, "feed", feed_and_drop_buffer)
    name = "decoder-witmotion"
    found = [try_input(TARGETS[name], data) for data in generate_inputs(TARGETS[name], 100, seed=1)]
    assert any(finding is not None and "how the bytes are divided" in finding.error for finding in found)
