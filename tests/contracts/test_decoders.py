"""What every decoder must do, whatever it decodes: found by listing the folder."""

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
    SampleBlock,
    SenderTimedFormat,
    concatenate_blocks,
    make_block,
)
from drivers.decoders.base import Decoder
from tests.contracts.decoder_examples import EXAMPLES, NAMES, Example

N = 16
STEP_NS = 10_000_000
QUICK = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
STREAMS = [e for e in EXAMPLES if e.carrier == "bytes"]
CHECKED = [e for e in STREAMS if e.checksum]
PACKETS = [e for e in EXAMPLES if e.carrier in ("frames", "messages")]

every_decoder = pytest.mark.parametrize("example", EXAMPLES, ids=str)
every_stream = pytest.mark.parametrize("example", STREAMS, ids=str)
every_checked_stream = pytest.mark.parametrize("example", CHECKED, ids=str)
every_packet = pytest.mark.parametrize("example", PACKETS, ids=str)
every_frame = pytest.mark.parametrize("example", [e for e in PACKETS if e.carrier == "frames"], ids=str)


@pytest.fixture
def decoder(example: Example, tmp_path: Path) -> Decoder:
    return example.build(tmp_path)


def made(decoder: Decoder, n: int = N, seed: int = 7) -> SampleBlock:
    """Samples of a resting sensor; a counter of the device wraps in the middle of them."""
    rng = np.random.default_rng(seed)
    values = rng.normal(0.0, 0.5, (n, 6)) + np.array([0.0, 0.0, 0.0, 0.0, 0.0, 9.8])
    ticks = np.full(n, NO_TICK, np.int64)
    if isinstance(decoder.timing, CounterTimedFormat):
        step = 1 if decoder.timing.tick_s is None else max(round(5e-4 / decoder.timing.tick_s), 1)
        ticks = (decoder.timing.modulus - (n // 2) * step + np.arange(n) * step) % decoder.timing.modulus
    return make_block(np.arange(1, n + 1) * STEP_NS, values, rng.normal(25.0, 1.0, n), ticks)


def one_by_one(samples: SampleBlock) -> list[SampleBlock]:
    return [samples[i : i + 1] for i in range(len(samples))]


def chunks_of(decoder: Decoder, samples: SampleBlock) -> list[list[Chunk]]:
    """What the device sends for each sample."""
    return [list(decoder.encode(one)) for one in one_by_one(samples)]


def flat(parts: list[list[Chunk]]) -> list[Chunk]:
    return [chunk for part in parts for chunk in part]


def bytes_of(parts: list[list[Chunk]]) -> list[bytes]:
    return [b"".join(chunk.data for chunk in part) for part in parts]


def feed(decoder: Decoder, calls: list[list[Chunk]]) -> list[SampleBlock]:
    """All blocks, each of them checked to be one."""
    out = []
    for chunks in calls:
        for each in decoder.feed(chunks):
            assert len(each) >= 1
            assert each.values.shape == (len(each), 6)
            assert each.values.dtype == np.float64
            assert each.temperature_c.shape == each.t_ns.shape == each.ticks.shape == (len(each),)
            assert each.t_ns.dtype == each.ticks.dtype == np.int64
            assert not any(a.flags.writeable for a in (each.values, each.t_ns, each.ticks, each.temperature_c))
            assert each.lost >= 0
            assert not np.isinf(each.values).any()
            out.append(each)
    return out


def feed_bytes(decoder: Decoder, data: bytes, cuts: list[int] | None = None) -> list[SampleBlock]:
    edges = [0, *sorted(c for c in cuts or [] if c < len(data)), len(data)]
    return feed(decoder, [[Chunk(data[a:b], 1000 + b)] for a, b in itertools.pairwise(edges)])


def seen(blocks: list[SampleBlock]) -> tuple[list[list[float]], list[str], list[int], int]:
    """Values, temperatures, ticks and all that was lost: what no cut of the bytes may change."""
    if not blocks:
        return [], [], [], 0
    all_of = concatenate_blocks(blocks)
    return all_of.values.tolist(), [repr(t) for t in all_of.temperature_c], all_of.ticks.tolist(), all_of.lost


def clean(example: Example, folder: Path, samples: SampleBlock) -> list[list[float]]:
    """The values that come back when nothing happens on the way, sample by sample."""
    decoder = example.build(folder)
    got = concatenate_blocks(feed(decoder, [flat(chunks_of(decoder, samples))]))
    assert len(got) == len(samples)
    return got.values.tolist()


def test_every_decoder_is_tried() -> None:
    assert {e.name for e in EXAMPLES} == set(NAMES)
    assert len(NAMES) >= 6


# --- all carriers ------------------------------------------------------------------------------


@every_decoder
def test_encode_then_feed_gives_back_the_samples_to_half_a_bit(example: Example, decoder: Decoder) -> None:
    samples = made(decoder)
    got = concatenate_blocks(feed(decoder, [list(decoder.encode(samples))]))
    steps = np.repeat([example.gyro_step, example.accel_step], 3)
    error = np.abs(got.values - samples.values).max(axis=0)
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
def test_samples_arrive_with_the_chunk_that_completes_them(decoder: Decoder) -> None:
    samples = made(decoder)
    got = concatenate_blocks(feed(decoder, [flat(chunks_of(decoder, samples))]))
    assert got.t_ns.tolist() == samples.t_ns.tolist()


@every_decoder
def test_one_call_or_many_make_no_difference(example: Example, decoder: Decoder, tmp_path: Path) -> None:
    parts = chunks_of(decoder, made(decoder))
    at_once = seen(feed(decoder, [flat(parts)]))
    again = example.build(tmp_path)
    assert seen(feed(again, [[chunk] for chunk in flat(parts)])) == at_once
    assert again.bad == decoder.bad == 0


@every_decoder
def test_nothing_fed_gives_nothing(decoder: Decoder) -> None:
    assert decoder.feed([]) == []
    assert decoder.feed([Chunk(b"", 5)]) == []
    assert decoder.recent_problem == "" or decoder.carrier != "bytes"


# --- byte streams ------------------------------------------------------------------------------


@every_stream
@QUICK
@given(data=st.data())
def test_any_cut_gives_the_same(data: st.DataObject, example: Example, decoder: Decoder, tmp_path: Path) -> None:
    parts = chunks_of(decoder, made(decoder))
    wire = b"".join(bytes_of(parts))
    tail = bytes_of(parts)[-1][: data.draw(st.integers(0, 5), label="tail")]
    cuts = data.draw(st.lists(st.integers(1, len(wire)), max_size=12), label="cuts")
    whole = seen(feed_bytes(example.build(tmp_path), wire))
    assert len(whole[0]) == N
    assert seen(feed_bytes(example.build(tmp_path), wire + tail, cuts)) == whole


@every_stream
def test_byte_by_byte_gives_the_same(example: Example, decoder: Decoder, tmp_path: Path) -> None:
    wire = b"".join(bytes_of(chunks_of(decoder, made(decoder))))
    whole = seen(feed_bytes(decoder, wire))
    assert seen(feed_bytes(example.build(tmp_path), wire, list(range(1, len(wire))))) == whole


@every_stream
@QUICK
@given(data=st.data())
def test_cuts_do_not_matter_in_a_damaged_stream(
    data: st.DataObject, example: Example, decoder: Decoder, tmp_path: Path
) -> None:
    frames = bytes_of(chunks_of(decoder, made(decoder, 40)))
    for at in data.draw(st.lists(st.integers(1, 20), max_size=4), label="noise at"):
        frames[at] = data.draw(st.binary(max_size=60), label="noise") + frames[at]
    wire = b"".join(frames)
    cuts = data.draw(st.lists(st.integers(1, len(wire)), max_size=12), label="cuts")
    one, other = example.build(tmp_path), example.build(tmp_path)
    assert seen(feed_bytes(one, wire)) == seen(feed_bytes(other, wire, cuts))
    assert one.bad == other.bad


def noises(frame: bytes) -> dict[str, bytes]:
    rng = np.random.default_rng(11)
    return {
        "random": rng.integers(0, 256, 29, np.uint8).tobytes(),
        "long": rng.integers(0, 256, 500, np.uint8).tobytes(),
        "half a frame": frame[: len(frame) // 2],
        "starts of frames": frame[:1] * 3 + frame[:2],
        "zeros": bytes(7),
    }


@every_stream
@pytest.mark.parametrize("kind", ["random", "long", "half a frame", "starts of frames", "zeros"])
@pytest.mark.parametrize("place", ["before", "inside", "between", "after"])
def test_noise_costs_only_the_frame_it_touches(
    example: Example, decoder: Decoder, kind: str, place: str, tmp_path: Path
) -> None:
    samples = made(decoder, 80)
    frames = bytes_of(chunks_of(decoder, samples))
    expected = clean(example, tmp_path, samples)
    noise, at = noises(frames[7])[kind], 7
    if place == "before":
        frames[0] = noise + frames[0]
        may_miss = {0}
    elif place == "inside":
        half = len(frames[at]) // 2
        frames[at] = frames[at][:half] + noise + frames[at][half:]
        may_miss = {at}
    elif place == "between":
        frames[at] = noise + frames[at]
        may_miss = {at}
    else:
        frames[-1] += noise
        may_miss = set()
    got = seen(feed_bytes(decoder, b"".join(frames)))[0]
    whole = [row for i, row in enumerate(expected) if i not in may_miss]
    if example.checksum:
        kept = [row for row in got if row in expected]
        assert kept == got, "a row that was never sent"
    else:
        # without a checksum noise that reads as a number is a number
        kept = [row for row in got if row in expected]
        assert len(got) - len(kept) <= 1
    assert kept in (whole, expected)


MASKS = (0x01, 0x04, 0x80)


@every_checked_stream
def test_one_damaged_byte_costs_exactly_its_sample(example: Example, decoder: Decoder, tmp_path: Path) -> None:
    samples = made(decoder)
    frames = bytes_of(chunks_of(decoder, samples))
    expected = clean(example, tmp_path, samples)
    k = N // 2
    start = len(frames[k]) - len(frames[k].lstrip(b"\r\n"))  # text begins with a line end
    for at in range(start, len(frames[k]) - example.unchecked_tail):
        mask = MASKS[at % len(MASKS)]
        hurt = bytearray(frames[k])
        hurt[at] ^= mask
        fresh = example.build(tmp_path)
        blocks = feed_bytes(fresh, b"".join([*frames[:k], bytes(hurt), *frames[k + 1 :]]))
        assert seen(blocks)[0] == expected[:k] + expected[k + 1 :], f"byte {at} ^ {mask:#x}"
        assert [(len(b), b.lost) for b in blocks] == [(k, 0), (N - k - 1, 1)]
        assert fresh.bad == 1
        assert fresh.recent_problem != ""


@every_checked_stream
def test_a_missing_byte_costs_one_sample(example: Example, decoder: Decoder, tmp_path: Path) -> None:
    samples = made(decoder)
    frames = bytes_of(chunks_of(decoder, samples))
    expected = clean(example, tmp_path, samples)
    k = N // 2
    frames[k] = frames[k][:5] + frames[k][6:]
    assert seen(feed_bytes(decoder, b"".join(frames)))[0] == expected[:k] + expected[k + 1 :]
    assert decoder.bad == 1


@every_checked_stream
def test_missing_frames_are_counted(example: Example, decoder: Decoder) -> None:
    frames = bytes_of(chunks_of(decoder, made(decoder)))
    for k in (4, 5, 6):  # line ends stay: a line is as long as it is
        end = frames[k][-2:] if frames[k].endswith(b"\r\n") else b""
        frames[k] = bytes(len(frames[k]) - len(end)) + end
    got = seen(feed_bytes(decoder, b"".join(frames)))
    assert len(got[0]) == N - 3
    assert got[3] == 3
    assert decoder.bad >= 3  # a sample may be more than one frame


@every_stream
def test_reset_forgets_half_a_frame(decoder: Decoder) -> None:
    samples = made(decoder)
    parts = chunks_of(decoder, samples)
    first, rest = flat(parts[:4]), bytes_of(parts[4:])
    feed(decoder, [first])
    assert feed_bytes(decoder, rest[0][: len(rest[0]) // 2]) == []
    decoder.forget_stream_state()
    got = seen(feed_bytes(decoder, b"".join(rest[1:])))
    assert len(got[0]) == N - 5
    assert got[3] == 0
    assert decoder.bad == 0


@every_stream
def test_joined_in_the_middle_of_a_frame(example: Example, decoder: Decoder, tmp_path: Path) -> None:
    samples = made(decoder)
    frames = bytes_of(chunks_of(decoder, samples))
    expected = clean(example, tmp_path, samples)
    got = seen(feed_bytes(decoder, b"".join(frames)[len(frames[0]) // 3 :]))
    assert got[0] == expected[1:]
    assert got[3] == decoder.bad == 0


@every_stream
def test_garbage_raises_nothing_and_fills_no_memory(decoder: Decoder) -> None:
    rng = np.random.default_rng(3)
    starts = bytes_of(chunks_of(decoder, made(decoder)))[0][:4]
    garbage = rng.integers(0, 256, 50_000, np.uint8).tobytes() + starts * 5000 + b"x" * 30_000
    parts = [garbage[i : i + 1000] for i in range(0, len(garbage), 1000)]
    feed(decoder, [[Chunk(p, 1)] for p in parts])
    tracemalloc.start()
    before, _ = tracemalloc.get_traced_memory()
    feed(decoder, [[Chunk(p, 1)] for p in parts])
    after, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert after - before < 30_000
    assert decoder.recent_problem != ""
    lines = b"\r\n" if decoder.encode(made(decoder, 1))[0].data.endswith(b"\r\n") else b""
    frames = bytes_of(chunks_of(decoder, made(decoder, 200)))
    got = seen(feed_bytes(decoder, lines + b"".join(frames)))
    assert len(got[0]) >= 130


# --- frames and messages -----------------------------------------------------------------------


@every_packet
@pytest.mark.parametrize("damage", ["cut", "empty", "garbage"])
def test_a_damaged_chunk_costs_only_its_sample(example: Example, decoder: Decoder, damage: str, tmp_path: Path) -> None:
    samples = made(decoder)
    parts = chunks_of(decoder, samples)
    expected = clean(example, tmp_path, samples)
    k = N // 2
    for at, chunk in enumerate(parts[k]):
        harm = {"cut": chunk.data[: len(chunk.data) // 2], "empty": b"", "garbage": b"\xc1"}[damage]
        hurt = list(parts[k])
        hurt[at] = replace(chunk, data=harm)
        fresh = example.build(tmp_path)
        blocks = feed(fresh, [flat([*parts[:k], hurt, *parts[k + 1 :]])])
        got = seen(blocks)
        if got[0] == expected:
            continue  # it held nothing but the temperature
        assert got[0] == expected[:k] + expected[k + 1 :]
        assert got[3] == 1
        assert fresh.bad == 1
        assert fresh.recent_problem != ""


@every_frame
def test_chunks_of_others_are_passed_over(decoder: Decoder, tmp_path: Path) -> None:
    parts = chunks_of(decoder, made(decoder))
    other = Chunk(b"12345678", 1, address=0x7AB)
    got = seen(feed(decoder, [[c for chunk in flat(parts) for c in (other, chunk, other)]]))
    assert len(got[0]) == N
    assert decoder.bad == 0


@every_packet
def test_garbage_chunks_raise_nothing(decoder: Decoder) -> None:
    rng = np.random.default_rng(5)
    addresses = [c.address for c in decoder.encode(made(decoder, 1))]
    for n in rng.integers(0, 400, 2000).tolist():
        data = rng.integers(0, 256, n, np.uint8).tobytes()
        feed(decoder, [[Chunk(data, 1, address=addresses[n % len(addresses)])]])
    decoder.forget_stream_state()
    assert len(seen(feed(decoder, [flat(chunks_of(decoder, made(decoder)))]))[0]) >= N - 1
