"""Tests that every decoder in the folder ``drivers/decoders`` has to pass."""

import itertools
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.data_types import (
    NO_TICK,
    ArrivalTimedFormat,
    Chunk,
    CounterTimedFormat,
    Floats,
    SampleBlock,
    SenderTimedFormat,
    concatenate_blocks,
    make_block,
)
from drivers.decoders.base import Decoder
from tests.contracts.decoder_examples import DECODER_NAMES, EXAMPLES, Example

SAMPLE_COUNT = 16
STEP_NS = 10_000_000
FEW_EXAMPLES = settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
STREAM_EXAMPLES = [example for example in EXAMPLES if example.carrier == "bytes"]
CHECKED_EXAMPLES = [example for example in STREAM_EXAMPLES if example.checksum]
PACKET_EXAMPLES = [example for example in EXAMPLES if example.carrier in ("frames", "messages")]
FRAME_EXAMPLES = [example for example in PACKET_EXAMPLES if example.carrier == "frames"]

every_decoder = pytest.mark.parametrize("example", EXAMPLES, ids=str)
every_stream = pytest.mark.parametrize("example", STREAM_EXAMPLES, ids=str)
every_checked_stream = pytest.mark.parametrize("example", CHECKED_EXAMPLES, ids=str)
every_packet = pytest.mark.parametrize("example", PACKET_EXAMPLES, ids=str)
every_frame = pytest.mark.parametrize("example", FRAME_EXAMPLES, ids=str)


@pytest.fixture
def decoder(example: Example, tmp_path: Path) -> Decoder:
    return example.build(tmp_path)


def make_samples(decoder: Decoder, n: int = SAMPLE_COUNT, seed: int = 7) -> SampleBlock:
    """Return samples of a sensor at rest. The counter of the device wraps around in the middle."""
    rng = np.random.default_rng(seed)
    values = rng.normal(0.0, 0.5, (n, 6)) + np.array([0.0, 0.0, 0.0, 0.0, 0.0, 9.8])
    ticks = np.full(n, NO_TICK, np.int64)
    if isinstance(decoder.timing, CounterTimedFormat):
        step = 1 if decoder.timing.tick_s is None else max(round(5e-4 / decoder.timing.tick_s), 1)
        ticks = (decoder.timing.modulus - (n // 2) * step + np.arange(n) * step) % decoder.timing.modulus
    return make_block(np.arange(1, n + 1) * STEP_NS, values, rng.normal(25.0, 1.0, n), ticks)


def split_into_single_samples(samples: SampleBlock) -> list[SampleBlock]:
    return [samples[i : i + 1] for i in range(len(samples))]


def encode_each_sample(decoder: Decoder, samples: SampleBlock) -> list[list[Chunk]]:
    """Return the chunks that the device sends, one list for each sample."""
    return [list(decoder.encode(sample)) for sample in split_into_single_samples(samples)]


def join_chunks(parts: list[list[Chunk]]) -> list[Chunk]:
    """Return the chunks of all samples in one list."""
    return [chunk for part in parts for chunk in part]


def join_bytes_of_each_sample(parts: list[list[Chunk]]) -> list[bytes]:
    """Return the bytes of each sample."""
    return [b"".join(chunk.data for chunk in part) for part in parts]


def feed_chunks(decoder: Decoder, calls: list[list[Chunk]]) -> list[SampleBlock]:
    """Return all decoded blocks, after checks of their shapes, types and values."""
    blocks = []
    for chunks in calls:
        for block in decoder.feed(chunks):
            assert len(block) >= 1
            assert block.values.shape == (len(block), 6)
            assert block.values.dtype == np.float64
            assert block.temperature_c.shape == block.t_ns.shape == block.ticks.shape == (len(block),)
            assert block.t_ns.dtype == block.ticks.dtype == np.int64
            assert not any(a.flags.writeable for a in (block.values, block.t_ns, block.ticks, block.temperature_c))
            assert block.lost >= 0
            assert not np.isinf(block.values).any()
            blocks.append(block)
    return blocks


def feed_bytes(decoder: Decoder, data: bytes, cuts: list[int] | None = None) -> list[SampleBlock]:
    """Feed bytes that are divided at the positions ``cuts``."""
    edges = [0, *sorted(cut for cut in cuts or [] if cut < len(data)), len(data)]
    return feed_chunks(decoder, [[Chunk(data[a:b], 1000 + b)] for a, b in itertools.pairwise(edges)])


Rows = list[list[float | None]]


def list_rows(values: Floats) -> Rows:
    """Return the values as lists, with None for NaN, because NaN is not equal to NaN."""
    return [[None if np.isnan(value) else value for value in row] for row in values.tolist()]


def summarize(blocks: list[SampleBlock]) -> tuple[Rows, list[str], list[int], int]:
    """Return the values, temperatures, ticks and number of lost samples of all blocks.

    None of them may depend on how the bytes are divided.
    """
    if not blocks:
        return [], [], [], 0
    joined = concatenate_blocks(blocks)
    return (
        list_rows(joined.values),
        [repr(temperature) for temperature in joined.temperature_c],
        joined.ticks.tolist(),
        joined.lost,
    )


def decode_undamaged(example: Example, folder: Path, samples: SampleBlock) -> Rows:
    """Return the decoded values of undamaged data, one row for each sample."""
    decoder = example.build(folder)
    got = concatenate_blocks(feed_chunks(decoder, [join_chunks(encode_each_sample(decoder, samples))]))
    assert len(got) == len(samples)
    return list_rows(got.values)


def test_every_decoder_has_an_example() -> None:
    assert {example.name for example in EXAMPLES} == set(DECODER_NAMES)
    assert len(DECODER_NAMES) >= 6


# --- all carriers ------------------------------------------------------------------------------


@every_decoder
def test_feeding_encoded_samples_returns_them_to_half_a_bit(example: Example, decoder: Decoder) -> None:
    samples = make_samples(decoder)
    got = concatenate_blocks(feed_chunks(decoder, [list(decoder.encode(samples))]))
    first = 0 if example.gyro_step is not None else 3  # first axis that the format contains
    assert np.isnan(got.values[:, :first]).all()
    steps = np.repeat([example.gyro_step or np.nan, example.accel_step], 3)[first:]
    error = np.abs(got.values - samples.values)[:, first:].max(axis=0)
    assert (error <= 0.5 * steps * (1 + 1e-6)).all(), error / steps
    if example.temperature_step is None:
        assert np.isnan(got.temperature_c).all()
    else:
        degrees = np.abs(got.temperature_c - samples.temperature_c).max()
        assert degrees <= 0.5 * example.temperature_step * (1 + 1e-6)
    assert got.lost == decoder.bad == 0
    assert decoder.recent_problem == ""
    if isinstance(decoder.timing, CounterTimedFormat):
        assert got.ticks.tolist() == samples.ticks.tolist()
        assert np.diff(got.ticks).min() < 0, "the counter did not wrap"
    if isinstance(decoder.timing, ArrivalTimedFormat):
        assert (got.ticks == NO_TICK).all()
    if isinstance(decoder.timing, SenderTimedFormat):
        assert got.t_ns.tolist() == samples.t_ns.tolist()


@every_decoder
def test_sample_time_is_that_of_the_chunk_that_completes_the_sample(decoder: Decoder) -> None:
    samples = make_samples(decoder)
    got = concatenate_blocks(feed_chunks(decoder, [join_chunks(encode_each_sample(decoder, samples))]))
    assert got.t_ns.tolist() == samples.t_ns.tolist()


@every_decoder
def test_feeding_chunk_by_chunk_returns_the_same_samples(example: Example, decoder: Decoder, tmp_path: Path) -> None:
    parts = encode_each_sample(decoder, make_samples(decoder))
    expected = summarize(feed_chunks(decoder, [join_chunks(parts)]))
    other_decoder = example.build(tmp_path)
    assert summarize(feed_chunks(other_decoder, [[chunk] for chunk in join_chunks(parts)])) == expected
    assert other_decoder.bad == decoder.bad == 0


@every_decoder
def test_empty_input_returns_no_blocks(decoder: Decoder) -> None:
    assert decoder.feed([]) == []
    assert decoder.feed([Chunk(b"", 5)]) == []
    assert decoder.recent_problem == "" or decoder.carrier != "bytes"


# --- byte streams ------------------------------------------------------------------------------


@every_stream
def test_feeding_byte_by_byte_returns_the_same_samples(example: Example, decoder: Decoder, tmp_path: Path) -> None:
    wire = b"".join(join_bytes_of_each_sample(encode_each_sample(decoder, make_samples(decoder))))
    expected = summarize(feed_bytes(decoder, wire))
    assert summarize(feed_bytes(example.build(tmp_path), wire, list(range(1, len(wire))))) == expected


@every_stream
def test_result_does_not_depend_on_the_division_into_chunks(example: Example, decoder: Decoder, tmp_path: Path) -> None:
    undamaged = join_bytes_of_each_sample(encode_each_sample(decoder, make_samples(decoder, 40)))

    @FEW_EXAMPLES
    @given(data=st.data())
    def check_division(data: st.DataObject) -> None:
        frames = list(undamaged)
        for at in data.draw(st.lists(st.integers(1, 20), max_size=4), label="noise at"):
            frames[at] = data.draw(st.binary(max_size=60), label="noise") + frames[at]
        incomplete = frames[-1][: data.draw(st.integers(0, 5), label="bytes of an incomplete frame")]
        wire = b"".join([*frames, incomplete])
        cuts = data.draw(st.lists(st.integers(1, len(wire)), max_size=12), label="cuts")
        first, second = example.build(tmp_path), example.build(tmp_path)
        assert summarize(feed_bytes(first, wire)) == summarize(feed_bytes(second, wire, cuts))
        assert first.bad == second.bad

    check_division()


NOISE = [
    *(("random", place) for place in ("before", "inside", "between", "after")),
    ("long", "inside"),
    ("half a frame", "between"),
    ("starts of frames", "before"),
    ("zeros", "after"),
]
"""Kind and place of the noise. Each kind and each place occurs."""


def make_noise(frame: bytes) -> dict[str, bytes]:
    rng = np.random.default_rng(11)
    return {
        "random": rng.integers(0, 256, 29, np.uint8).tobytes(),
        "long": rng.integers(0, 256, 500, np.uint8).tobytes(),
        "half a frame": frame[: len(frame) // 2],
        "starts of frames": frame[:1] * 3 + frame[:2],
        "zeros": bytes(7),
    }


@every_stream
def test_noise_damages_only_the_frame_that_it_touches(example: Example, decoder: Decoder, tmp_path: Path) -> None:
    samples = make_samples(decoder, 80)
    undamaged_frames = join_bytes_of_each_sample(encode_each_sample(decoder, samples))
    expected = decode_undamaged(example, tmp_path, samples)
    for kind, place in NOISE:
        frames, at = list(undamaged_frames), 7
        noise = make_noise(frames[at])[kind]
        if place == "before":
            frames[0] = noise + frames[0]
            may_be_missing = {0}
        elif place == "inside":
            half = len(frames[at]) // 2
            frames[at] = frames[at][:half] + noise + frames[at][half:]
            may_be_missing = {at}
        elif place == "between":
            frames[at] = noise + frames[at]
            may_be_missing = {at}
        else:
            frames[-1] += noise
            may_be_missing = set()
        got = summarize(feed_bytes(example.build(tmp_path), b"".join(frames)))[0]
        undamaged = [row for i, row in enumerate(expected) if i not in may_be_missing]
        kept = [row for row in got if row in expected]
        # without a checksum, noise that looks like a number is decoded as a row that was never sent
        assert len(got) - len(kept) <= (0 if example.checksum else 1), (kind, place)
        assert kept in (undamaged, expected), (kind, place)


MASKS = (0x01, 0x04, 0x80)


@every_checked_stream
def test_one_damaged_byte_loses_exactly_its_sample(example: Example, decoder: Decoder, tmp_path: Path) -> None:
    samples = make_samples(decoder)
    frames = join_bytes_of_each_sample(encode_each_sample(decoder, samples))
    expected = decode_undamaged(example, tmp_path, samples)
    damaged_sample = SAMPLE_COUNT // 2
    start = len(frames[damaged_sample]) - len(
        frames[damaged_sample].lstrip(b"\r\n")
    )  # a text frame begins with a line end
    for at in range(start, len(frames[damaged_sample]) - example.unchecked_tail):
        mask = MASKS[at % len(MASKS)]
        damaged = bytearray(frames[damaged_sample])
        damaged[at] ^= mask
        other_decoder = example.build(tmp_path)
        blocks = feed_bytes(
            other_decoder, b"".join([*frames[:damaged_sample], bytes(damaged), *frames[damaged_sample + 1 :]])
        )
        assert summarize(blocks)[0] == expected[:damaged_sample] + expected[damaged_sample + 1 :], (
            f"byte {at} ^ {mask:#x}"
        )
        assert [(len(b), b.lost) for b in blocks] == [(damaged_sample, 0), (SAMPLE_COUNT - damaged_sample - 1, 1)]
        assert other_decoder.bad == 1
        assert other_decoder.recent_problem != ""


@every_checked_stream
def test_missing_byte_loses_one_sample(example: Example, decoder: Decoder, tmp_path: Path) -> None:
    samples = make_samples(decoder)
    frames = join_bytes_of_each_sample(encode_each_sample(decoder, samples))
    expected = decode_undamaged(example, tmp_path, samples)
    damaged_sample = SAMPLE_COUNT // 2
    frames[damaged_sample] = frames[damaged_sample][:5] + frames[damaged_sample][6:]
    assert (
        summarize(feed_bytes(decoder, b"".join(frames)))[0]
        == expected[:damaged_sample] + expected[damaged_sample + 1 :]
    )
    assert decoder.bad == 1


@every_checked_stream
def test_missing_frames_are_counted_as_lost(example: Example, decoder: Decoder) -> None:
    frames = join_bytes_of_each_sample(encode_each_sample(decoder, make_samples(decoder)))
    for k in (4, 5, 6):  # keep the line ends, so that each line keeps its length
        end = frames[k][-2:] if frames[k].endswith(b"\r\n") else b""
        frames[k] = bytes(len(frames[k]) - len(end)) + end
    got = summarize(feed_bytes(decoder, b"".join(frames)))
    assert len(got[0]) == SAMPLE_COUNT - 3
    assert got[3] == 3
    assert decoder.bad >= 3  # a sample may consist of several frames


@every_stream
def test_reset_discards_an_incomplete_frame(decoder: Decoder) -> None:
    samples = make_samples(decoder)
    parts = encode_each_sample(decoder, samples)
    first, rest = join_chunks(parts[:4]), join_bytes_of_each_sample(parts[4:])
    feed_chunks(decoder, [first])
    assert feed_bytes(decoder, rest[0][: len(rest[0]) // 2]) == []
    decoder.forget_stream_state()
    got = summarize(feed_bytes(decoder, b"".join(rest[1:])))
    assert len(got[0]) == SAMPLE_COUNT - 5
    assert got[3] == 0
    assert decoder.bad == 0


@every_stream
def test_stream_that_starts_inside_a_frame_loses_only_that_frame(
    example: Example, decoder: Decoder, tmp_path: Path
) -> None:
    samples = make_samples(decoder)
    frames = join_bytes_of_each_sample(encode_each_sample(decoder, samples))
    expected = decode_undamaged(example, tmp_path, samples)
    got = summarize(feed_bytes(decoder, b"".join(frames)[len(frames[0]) // 3 :]))
    assert got[0] == expected[1:]
    assert got[3] == decoder.bad == 0


@every_stream
def test_garbage_raises_no_error_and_uses_bounded_memory(decoder: Decoder) -> None:
    rng = np.random.default_rng(3)
    starts = join_bytes_of_each_sample(encode_each_sample(decoder, make_samples(decoder)))[0][:4]
    garbage = rng.integers(0, 256, 25_000, np.uint8).tobytes() + starts * 2500 + b"x" * 20_000
    parts = [garbage[i : i + 1000] for i in range(0, len(garbage), 1000)]
    feed_chunks(decoder, [[Chunk(part, 1)] for part in parts])
    tracemalloc.start()
    before, _ = tracemalloc.get_traced_memory()
    feed_chunks(decoder, [[Chunk(part, 1)] for part in parts])
    after, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert after - before < 30_000
    assert decoder.recent_problem != ""
    line_end = b"\r\n" if decoder.encode(make_samples(decoder, 1))[0].data.endswith(b"\r\n") else b""
    frames = join_bytes_of_each_sample(encode_each_sample(decoder, make_samples(decoder, 200)))
    got = summarize(feed_bytes(decoder, line_end + b"".join(frames)))
    assert len(got[0]) >= 130


# --- frames and messages -----------------------------------------------------------------------


@every_packet
@pytest.mark.parametrize("damage", ["cut", "empty", "garbage"])
def test_damaged_chunk_loses_only_its_sample(example: Example, decoder: Decoder, damage: str, tmp_path: Path) -> None:
    samples = make_samples(decoder)
    parts = encode_each_sample(decoder, samples)
    expected = decode_undamaged(example, tmp_path, samples)
    damaged_sample = SAMPLE_COUNT // 2
    for at, chunk in enumerate(parts[damaged_sample]):
        data = {"cut": chunk.data[: len(chunk.data) // 2], "empty": b"", "garbage": b"\xc1"}[damage]
        chunks = list(parts[damaged_sample])
        chunks[at] = replace(chunk, data=data)
        other_decoder = example.build(tmp_path)
        blocks = feed_chunks(
            other_decoder, [join_chunks([*parts[:damaged_sample], chunks, *parts[damaged_sample + 1 :]])]
        )
        got = summarize(blocks)
        if got[0] == expected:
            continue  # the damaged chunk contained only the temperature
        assert got[0] == expected[:damaged_sample] + expected[damaged_sample + 1 :]
        assert got[3] == 1
        assert other_decoder.bad == 1
        assert other_decoder.recent_problem != ""


@every_frame
def test_chunks_with_another_address_are_ignored(decoder: Decoder, tmp_path: Path) -> None:
    parts = encode_each_sample(decoder, make_samples(decoder))
    other = Chunk(b"12345678", 1, address=0x7AB)
    got = summarize(feed_chunks(decoder, [[c for chunk in join_chunks(parts) for c in (other, chunk, other)]]))
    assert len(got[0]) == SAMPLE_COUNT
    assert decoder.bad == 0


@every_packet
def test_garbage_chunks_raise_no_error(decoder: Decoder) -> None:
    rng = np.random.default_rng(5)
    addresses = [c.address for c in decoder.encode(make_samples(decoder, 1))]
    for n in rng.integers(0, 400, 2000).tolist():
        data = rng.integers(0, 256, n, np.uint8).tobytes()
        feed_chunks(decoder, [[Chunk(data, 1, address=addresses[n % len(addresses)])]])
    decoder.forget_stream_state()
    assert (
        len(summarize(feed_chunks(decoder, [join_chunks(encode_each_sample(decoder, make_samples(decoder)))]))[0])
        >= SAMPLE_COUNT - 1
    )
