"""Tests of FrameBuffer and BlockBuilder with a simple format: 0xAA, three bytes, their sum."""

import doctest
import itertools
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.data_types import Chunk
from drivers.decoders import base
from drivers.decoders.base import HINT_FRAMES, NEED_MORE, REJECT, BlockBuilder, FrameBuffer, RawFrames


def match_frame(buffer: bytes, at: int) -> int:
    if len(buffer) - at < 5:
        return NEED_MORE
    return 5 if sum(buffer[at + 1 : at + 4]) & 0xFF == buffer[at + 4] else REJECT


def make_frame(i: int) -> bytes:
    body = bytes([i, 2 * i & 0xFF, 7])
    return b"\xaa" + body + bytes([sum(body) & 0xFF])


def find_frames(data: bytes, cuts: tuple[int, ...] = ()) -> tuple[list[bytes], list[int]]:
    """Feed bytes that are divided at ``cuts``. Return the frames and the number of bad frames before each of them."""
    buffer = FrameBuffer(b"\xaa", match_frame, 5)
    edges = [0, *sorted(cuts), len(data)]
    parts = [buffer.feed([Chunk(data[a:b], b)]) for a, b in itertools.pairwise(edges)]
    return [frame for part in parts for frame in part.data], [n for part in parts for n in part.bad_before.tolist()]


FRAMES = [make_frame(i) for i in range(40)]


def test_consecutive_frames_are_found() -> None:
    assert find_frames(b"".join(FRAMES)) == (FRAMES, [0] * 40)


@given(st.lists(st.integers(0, 230)), st.lists(st.binary(max_size=12), min_size=4, max_size=4))
def test_result_does_not_depend_on_the_division_into_chunks(cuts: list[int], noise: list[bytes]) -> None:
    data = b"".join(n + b"".join(FRAMES[10 * i : 10 * i + 10]) for i, n in enumerate(noise))
    cuts = [c for c in cuts if c < len(data)]
    assert find_frames(data, tuple(cuts)) == find_frames(data)
    assert find_frames(data, tuple(range(len(data)))) == find_frames(data)


@given(st.lists(st.integers(0, 230)), st.lists(st.binary(max_size=12), min_size=4, max_size=4))
def test_first_bytes_do_not_change_the_result(cuts: list[int], noise: list[bytes]) -> None:
    def match(buffer: bytes, at: int) -> int:
        return match_frame(buffer, at) if buffer[at] == 0xAA else REJECT

    data = b"".join(n + b"".join(FRAMES[10 * i : 10 * i + 10]) for i, n in enumerate(noise))
    edges = [0, *sorted(c for c in cuts if c < len(data)), len(data)]
    chunks = [Chunk(data[a:b], b) for a, b in itertools.pairwise(edges)]
    slow, fast = FrameBuffer(b"", match, 5), FrameBuffer(b"", match, 5, first_bytes=b"\xaa")
    for chunk in chunks:
        expected, found = slow.feed([chunk]), fast.feed([chunk])
        assert found.data == expected.data
        assert found.bad_before.tolist() == expected.bad_before.tolist()
        assert found.adjacent.tolist() == expected.adjacent.tolist()


@pytest.mark.parametrize("at", range(5))
def test_damaged_byte_loses_only_its_frame(at: int) -> None:
    data = bytearray(b"".join(FRAMES))
    data[5 * 7 + at] ^= 0x55
    found, bad = find_frames(bytes(data))
    assert found == FRAMES[:7] + FRAMES[8:]
    assert bad == [0] * 7 + [1] + [0] * 31


def test_gap_counts_as_the_number_of_frames_that_fit_in_it() -> None:
    found, bad = find_frames(FRAMES[0] + b"\x00" * 15 + FRAMES[1])
    assert found == FRAMES[:2]
    assert bad == [0, 3]


def test_truncated_frame_counts_as_one_bad_frame() -> None:
    assert find_frames(FRAMES[0] + FRAMES[1][:2] + FRAMES[2]) == ([FRAMES[0], FRAMES[2]], [0, 1])


def test_frame_after_a_false_sync_byte_is_found() -> None:
    assert find_frames(b"\xaa" + FRAMES[3]) == ([FRAMES[3]], [0])


def test_bytes_before_the_first_frame_are_not_counted() -> None:
    assert find_frames(b"\xaa\x01" * 50 + b"\x00" * 33 + FRAMES[3]) == ([FRAMES[3]], [0])


def test_reset_discards_an_incomplete_frame_and_the_gap() -> None:
    buffer = FrameBuffer(b"\xaa", match_frame, 5)
    buffer.feed([Chunk(FRAMES[0] + b"\x00" * 50 + FRAMES[1][:3], 1)])
    buffer.forget_stream_state()
    after = buffer.feed([Chunk(FRAMES[1][3:] + FRAMES[2], 2)])
    assert after.data == [FRAMES[2]]
    assert after.bad_before.tolist() == [0]


def test_arrival_time_is_that_of_the_chunk_with_the_last_byte() -> None:
    buffer = FrameBuffer(b"\xaa", match_frame, 5)
    data = b"".join(FRAMES[:4])
    first = buffer.feed([Chunk(data[:5], 10), Chunk(data[5:9], 20), Chunk(b"", 25), Chunk(data[9:15], 30)])
    second = buffer.feed([Chunk(data[15:17], 40), Chunk(data[17:], 50)])
    assert first.t_ns.tolist() == [10, 30, 30]
    assert second.t_ns.tolist() == [50]


def test_memory_stays_bounded_on_garbage() -> None:
    buffer = FrameBuffer(b"\xaa", match_frame, 64)
    noise = np.random.default_rng(1).integers(0, 256, 20_000, np.uint8).tobytes() + b"\xaa" * 1000
    buffer.feed([Chunk(noise, 0)])
    tracemalloc.start()
    for t in range(20):
        buffer.feed([Chunk(noise[i : i + 100], t) for i in range(0, len(noise), 100)])
    allocated_bytes, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert allocated_bytes < 20_000
    for t in range(20_000):  # empty reads store nothing
        buffer.feed([Chunk(b"", t)])
    assert len(buffer._arrivals) <= 2


def test_recent_problem_gives_a_hint_until_frames_are_found() -> None:
    buffer = FrameBuffer(b"\xaa", match_frame, 5)
    assert buffer.recent_problem == ""
    buffer.feed([Chunk(b"\x11" * base.MAX_BYTES_WITHOUT_FRAME, 0)])
    assert "baud rate" in buffer.recent_problem
    buffer.feed([Chunk(FRAMES[0], 0)])
    assert buffer.recent_problem == ""
    buffer.feed([Chunk(FRAMES[0][:-1] + b"\x99" + FRAMES[1], 0)])
    assert "fail their check" in buffer.recent_problem
    buffer.feed([Chunk(FRAMES[0] * HINT_FRAMES, 0)])
    assert buffer.recent_problem == ""


def test_deselected_frames_count_as_bad_before_the_next_selected_frame() -> None:
    frames = RawFrames([b"0", b"1", b"2", b"3"], np.arange(4), np.array([1, 2, 4, 8]), np.zeros(4, np.bool_))
    kept = frames.select_frames([1, 2])
    assert (kept.data, kept.t_ns.tolist(), kept.bad_before.tolist(), kept.bad_after) == (
        [b"1", b"2"],
        [1, 2],
        [3, 4],
        8,
    )
    none = frames.select_frames([])
    assert (none.data, none.t_ns.size, none.bad_before.size, none.bad_after) == ([], 0, 0, 15)
    again = frames.select_frames([1, 2]).select_frames([0])
    assert (again.bad_before.sum(), again.bad_after) == (kept.bad_before[0], kept.bad_before[1] + kept.bad_after)


def make_rows(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    return np.arange(n), np.arange(6.0 * n).reshape(n, 6), np.full(n, 20.0), np.arange(n)


def test_rows_without_bad_frames_form_one_block() -> None:
    blocks = BlockBuilder().build_plausible_blocks(*make_rows(5), np.zeros(5, np.int64))
    assert [len(b) for b in blocks] == [5]
    assert blocks[0].lost == 0


def test_rows_are_divided_into_blocks_at_bad_frames() -> None:
    builder = BlockBuilder()
    blocks = builder.build_plausible_blocks(*make_rows(5), np.array([1, 0, 2, 0, 0]), bad_after=4)
    assert [(len(b), b.lost) for b in blocks] == [(2, 1), (3, 2)]
    assert builder.bad == 7
    next_blocks = builder.build_plausible_blocks(*make_rows(1), np.array([1]))
    assert [(len(b), b.lost) for b in next_blocks] == [(1, 5)]
    assert builder.bad == 8


def test_implausible_rows_count_as_lost() -> None:
    t_ns, values, temperature, ticks = make_rows(6)
    values[0, 0], values[2, 4], values[3], values[5, 5] = 1001.0, -np.inf, np.nan, 10_001.0
    builder = BlockBuilder()
    blocks = builder.build_plausible_blocks(t_ns, values, temperature, ticks, np.array([0, 0, 0, 0, 3, 0]))
    assert [(b.ticks.tolist(), b.lost) for b in blocks] == [([1], 1), ([4], 5)]
    assert builder.bad == 7
    assert [b.lost for b in builder.build_plausible_blocks(*make_rows(1), np.array([0]))] == [1]


def test_bad_frames_without_a_plausible_row_count_before_the_next_block() -> None:
    t_ns, _, temperature, ticks = make_rows(2)
    builder = BlockBuilder()
    assert builder.build_plausible_blocks(t_ns, np.full((2, 6), np.inf), temperature, ticks, np.array([1, 0])) == []
    empty = np.empty(0, np.int64)
    assert builder.build_plausible_blocks(empty, np.empty((0, 6)), np.empty(0), empty, empty, 2) == []
    assert [b.lost for b in builder.build_plausible_blocks(*make_rows(2), np.array([0, 0]))] == [5]
    assert builder.bad == 5
    builder.build_plausible_blocks(empty, np.empty((0, 6)), np.empty(0), empty, empty, 2)
    builder.forget_missing_samples()
    assert [b.lost for b in builder.build_plausible_blocks(*make_rows(2), np.array([0, 0]))] == [0]


def test_rows_with_missing_axes_are_kept_and_an_impossible_temperature_becomes_nan() -> None:
    t_ns, values, temperature, ticks = make_rows(3)
    values[:, :3] = np.nan
    temperature[1] = 4000.0
    blocks = BlockBuilder().build_plausible_blocks(t_ns, values, temperature, ticks, np.zeros(3, np.int64))
    assert [len(b) for b in blocks] == [3]
    assert np.isnan(blocks[0].temperature_c).tolist() == [False, True, False]


def test_quantize_rounds_and_saturates() -> None:
    values = np.array([0.26, -0.24, 1e9, -1e9, np.nan])
    assert base.quantize(values, 0.5, 16).tolist() == [1, 0, 32767, -32768, 0]


@given(st.binary(max_size=200))
def test_xor_checksum_equals_the_xor_of_all_bytes(data: bytes) -> None:
    expected = 0
    for byte in data:
        expected ^= byte
    assert base.xor_checksum(data) == expected


def test_docstring_examples_are_correct() -> None:
    assert doctest.testmod(base).failed == 0
