"""FrameBuffer and Rows on a toy format: 0xAA, three bytes, their sum."""

import doctest
import itertools
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.data_types import Chunk
from drivers.decoders import base
from drivers.decoders.base import HINT_FRAMES, NEED_MORE, REJECT, BlockBuilder, FrameBuffer, Frames


def match(buffer: bytes, at: int) -> int:
    if len(buffer) - at < 5:
        return NEED_MORE
    return 5 if sum(buffer[at + 1 : at + 4]) & 0xFF == buffer[at + 4] else REJECT


def frame(i: int) -> bytes:
    body = bytes([i, 2 * i & 0xFF, 7])
    return b"\xaa" + body + bytes([sum(body) & 0xFF])


def fed(data: bytes, cuts: tuple[int, ...] = ()) -> tuple[list[bytes], list[int]]:
    buffer = FrameBuffer(b"\xaa", match, 5)
    edges = [0, *sorted(cuts), len(data)]
    parts = [buffer.feed([Chunk(data[a:b], b)]) for a, b in itertools.pairwise(edges)]
    return [f for p in parts for f in p.data], [n for p in parts for n in p.bad_before.tolist()]


FRAMES = [frame(i) for i in range(40)]


def test_frames_in_a_row() -> None:
    assert fed(b"".join(FRAMES)) == (FRAMES, [0] * 40)


@given(st.lists(st.integers(0, 230)), st.lists(st.binary(max_size=12), min_size=4, max_size=4))
def test_any_cut_gives_the_same(cuts: list[int], noise: list[bytes]) -> None:
    data = b"".join(n + b"".join(FRAMES[10 * i : 10 * i + 10]) for i, n in enumerate(noise))
    cuts = [c for c in cuts if c < len(data)]
    assert fed(data, tuple(cuts)) == fed(data)
    assert fed(data, tuple(range(len(data)))) == fed(data)


@pytest.mark.parametrize("at", range(5))
def test_a_damaged_byte_costs_its_frame(at: int) -> None:
    data = bytearray(b"".join(FRAMES))
    data[5 * 7 + at] ^= 0x55
    found, bad = fed(bytes(data))
    assert found == FRAMES[:7] + FRAMES[8:]
    assert bad == [0] * 7 + [1] + [0] * 31


def test_a_hole_counts_the_frames_that_fit_in_it() -> None:
    found, bad = fed(FRAMES[0] + b"\x00" * 15 + FRAMES[1])
    assert found == FRAMES[:2]
    assert bad == [0, 3]


def test_a_truncated_frame_counts_as_one() -> None:
    assert fed(FRAMES[0] + FRAMES[1][:2] + FRAMES[2]) == ([FRAMES[0], FRAMES[2]], [0, 1])


def test_a_frame_hidden_behind_a_false_sync_is_found() -> None:
    assert fed(b"\xaa" + FRAMES[3]) == ([FRAMES[3]], [0])


def test_what_comes_before_the_first_frame_is_not_counted() -> None:
    assert fed(b"\xaa\x01" * 50 + b"\x00" * 33 + FRAMES[3]) == ([FRAMES[3]], [0])


def test_reset_forgets_half_a_frame_and_the_hole() -> None:
    buffer = FrameBuffer(b"\xaa", match, 5)
    buffer.feed([Chunk(FRAMES[0] + b"\x00" * 50 + FRAMES[1][:3], 1)])
    buffer.forget_stream_state()
    after = buffer.feed([Chunk(FRAMES[1][3:] + FRAMES[2], 2)])
    assert after.data == [FRAMES[2]]
    assert after.bad_before.tolist() == [0]


def test_arrival_is_that_of_the_chunk_with_the_last_byte() -> None:
    buffer = FrameBuffer(b"\xaa", match, 5)
    data = b"".join(FRAMES[:4])
    first = buffer.feed([Chunk(data[:5], 10), Chunk(data[5:9], 20), Chunk(b"", 25), Chunk(data[9:15], 30)])
    second = buffer.feed([Chunk(data[15:17], 40), Chunk(data[17:], 50)])
    assert first.t_ns.tolist() == [10, 30, 30]
    assert second.t_ns.tolist() == [50]


def test_memory_stays_bounded_on_garbage() -> None:
    buffer = FrameBuffer(b"\xaa", match, 64)
    noise = np.random.default_rng(1).integers(0, 256, 20_000, np.uint8).tobytes() + b"\xaa" * 1000
    buffer.feed([Chunk(noise, 0)])
    tracemalloc.start()
    for t in range(20):
        buffer.feed([Chunk(noise[i : i + 100], t) for i in range(0, len(noise), 100)])
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 20_000
    for t in range(20_000):  # empty reads leave nothing behind
        buffer.feed([Chunk(b"", t)])
    assert len(buffer._arrivals) <= 2


def test_hints() -> None:
    buffer = FrameBuffer(b"\xaa", match, 5)
    assert buffer.recent_problem == ""
    buffer.feed([Chunk(b"\x11" * base.MAX_BYTES_WITHOUT_FRAME, 0)])
    assert "baud rate" in buffer.recent_problem
    buffer.feed([Chunk(FRAMES[0], 0)])
    assert buffer.recent_problem == ""
    buffer.feed([Chunk(FRAMES[0][:-1] + b"\x99" + FRAMES[1], 0)])
    assert "fail their check" in buffer.recent_problem
    buffer.feed([Chunk(FRAMES[0] * HINT_FRAMES, 0)])
    assert buffer.recent_problem == ""


def test_keep_carries_rejected_frames_to_the_next_kept_one() -> None:
    frames = Frames([b"0", b"1", b"2", b"3"], np.arange(4), np.array([1, 2, 4, 8]), np.zeros(4, np.bool_))
    kept = frames.select_frames([1, 2])
    assert (kept.data, kept.t_ns.tolist(), kept.bad_before.tolist(), kept.bad_after) == (
        [b"1", b"2"],
        [1, 2],
        [3, 4],
        8,
    )
    none = frames.select_frames([])
    assert (none.data, none.t_ns.size, none.bad_before.size, none.bad_after) == ([], 0, 0, 15)


def rows(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    return np.arange(n), np.arange(6.0 * n).reshape(n, 6), np.full(n, 20.0), np.arange(n)


def test_rows_without_loss_make_one_block() -> None:
    out = BlockBuilder().build_plausible_blocks(*rows(5), np.zeros(5, np.int64))
    assert [len(b) for b in out] == [5]
    assert out[0].lost == 0


def test_rows_are_cut_where_frames_were_bad() -> None:
    collected = BlockBuilder()
    out = collected.build_plausible_blocks(*rows(5), np.array([1, 0, 2, 0, 0]), bad_after=4)
    assert [(len(b), b.lost) for b in out] == [(2, 1), (3, 2)]
    assert collected.bad == 7
    following = collected.build_plausible_blocks(*rows(1), np.array([1]))
    assert [(len(b), b.lost) for b in following] == [(1, 5)]
    assert collected.bad == 8


def test_implausible_rows_leave_an_empty_place() -> None:
    t_ns, values, temperature, ticks = rows(6)
    values[0, 0], values[2, 4], values[3], values[5, 5] = 1001.0, -np.inf, np.nan, 10_001.0
    collected = BlockBuilder()
    out = collected.build_plausible_blocks(t_ns, values, temperature, ticks, np.array([0, 0, 0, 0, 3, 0]))
    assert [(b.ticks.tolist(), b.lost) for b in out] == [([1], 1), ([4], 5)]
    assert collected.bad == 7
    assert [b.lost for b in collected.build_plausible_blocks(*rows(1), np.array([0]))] == [1]


def test_rows_all_bad_and_rows_none_carry_over() -> None:
    t_ns, _, temperature, ticks = rows(2)
    collected = BlockBuilder()
    assert collected.build_plausible_blocks(t_ns, np.full((2, 6), np.inf), temperature, ticks, np.array([1, 0])) == []
    empty = np.empty(0, np.int64)
    assert collected.build_plausible_blocks(empty, np.empty((0, 6)), np.empty(0), empty, empty, 2) == []
    assert [b.lost for b in collected.build_plausible_blocks(*rows(2), np.array([0, 0]))] == [5]
    assert collected.bad == 5
    collected.build_plausible_blocks(empty, np.empty((0, 6)), np.empty(0), empty, empty, 2)
    collected.forget_missing_samples()
    assert [b.lost for b in collected.build_plausible_blocks(*rows(2), np.array([0, 0]))] == [0]


def test_some_axes_not_measured_pass_and_an_impossible_temperature_does_not() -> None:
    t_ns, values, temperature, ticks = rows(3)
    values[:, :3] = np.nan
    temperature[1] = 4000.0
    out = BlockBuilder().build_plausible_blocks(t_ns, values, temperature, ticks, np.zeros(3, np.int64))
    assert [len(b) for b in out] == [3]
    assert np.isnan(out[0].temperature_c).tolist() == [False, True, False]


def test_quantize_saturates_and_rounds() -> None:
    values = np.array([0.26, -0.24, 1e9, -1e9, np.nan])
    assert base.quantize(values, 0.5, 16).tolist() == [1, 0, 32767, -32768, 0]


@given(st.binary(max_size=200))
def test_xor_agrees_with_one_byte_after_the_other(data: bytes) -> None:
    expected = 0
    for byte in data:
        expected ^= byte
    assert base.xor_checksum(data) == expected


def test_the_examples_run() -> None:
    assert doctest.testmod(base).failed == 0
