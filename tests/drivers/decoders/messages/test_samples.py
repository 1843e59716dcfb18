"""Tests of the counts of the samples decoder. ``test_sample_message`` tests the message itself."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from drivers.data_types import Chunk, SenderTimedFormat, concatenate_blocks, make_block
from drivers.decoders.base import HINT_FRAMES
from drivers.decoders.messages import samples
from drivers.zenoh.sample_message import encode_samples


def make_message(count: int, n: int = 10, lost: int = 0, bad_rows: tuple[int, ...] = ()) -> Chunk:
    values = np.arange(6 * n, dtype=np.float64).reshape(n, 6) / 100
    values[list(bad_rows)] = np.inf
    return Chunk(encode_samples("d", count, make_block(np.arange(n) * 10_000_000, values, lost=lost)), 0)


def test_decoder_takes_messages_with_sender_times() -> None:
    decoder = samples.build(samples.Settings())
    assert decoder.timing == SenderTimedFormat()
    assert decoder.carrier == "messages"


def test_lost_messages_are_counted_by_their_samples() -> None:
    decoder = samples.build(samples.Settings())
    blocks = decoder.feed([make_message(510), make_message(520), make_message(550), make_message(560, lost=3)])
    assert [b.lost for b in blocks] == [0, 0, 20, 3]
    assert decoder.bad == 0


def test_restart_of_the_publisher_is_no_loss() -> None:
    decoder = samples.build(samples.Settings())
    blocks = decoder.feed([make_message(1000), make_message(10), make_message(20), make_message(40)])
    assert [b.lost for b in blocks] == [0, 0, 0, 10]


def test_reopening_the_link_is_no_loss() -> None:
    decoder = samples.build(samples.Settings())
    decoder.feed([make_message(10)])
    decoder.forget_stream_state()
    assert [b.lost for b in decoder.feed([make_message(500)])] == [0]


def test_impossible_rows_count_as_lost() -> None:
    decoder = samples.build(samples.Settings())
    blocks = decoder.feed(
        [make_message(10, bad_rows=(0, 4)), make_message(20, bad_rows=tuple(range(10)), lost=7), make_message(30)]
    )
    assert [(len(b), b.lost) for b in blocks] == [(3, 1), (5, 1), (10, 17)]
    assert decoder.bad == 12


def test_a_rejected_message_is_counted_and_explained() -> None:
    decoder = samples.build(samples.Settings())
    blocks = decoder.feed([make_message(10), Chunk(b"no message", 0), make_message(30)])
    assert [b.lost for b in blocks] == [0, 10]
    assert decoder.bad == 1
    assert "samples message" in decoder.recent_problem
    for i in range(HINT_FRAMES):
        decoder.feed([make_message(40 + 10 * i)])
    assert decoder.recent_problem == ""


def test_feeding_encoded_samples_returns_them() -> None:
    decoder = samples.build(samples.Settings())
    sent = make_block(np.arange(50) ** 2 * 1_000_000, np.random.default_rng(0).normal(size=(50, 6)))
    chunks = [c for i in range(0, 50, 7) for c in decoder.encode(sent[i : i + 7])]
    got = concatenate_blocks(decoder.feed(chunks))
    np.testing.assert_array_equal(got.values, sent.values)
    assert np.abs(got.t_ns - sent.t_ns).max() <= 500
    assert got.lost == 0


@given(st.lists(st.binary(max_size=100), max_size=5))
def test_noise_raises_no_error(noise: list[bytes]) -> None:
    decoder = samples.build(samples.Settings())
    assert decoder.feed([Chunk(data, 0) for data in noise]) == []
    assert decoder.bad == len(noise)


def test_messages_in_other_units_or_of_two_sensors_are_rejected() -> None:
    values = np.random.default_rng(1).normal(size=(1300, 6)) * 0.01 + [0.01, 0.0, 0.0, 0.0, 0.0, 9.81]
    mixed = np.where(np.arange(1300)[:, np.newaxis] % 2, values, values * [1, 1, 1, 0.5, -1, -1] + [0, 0, 0, 3, 0, 0])
    expected = {
        "": values,
        'measures 999.9 m/s² instead of gravity (9.81 m/s²): the sender has to convert "mg" to m/s²': values
        * np.repeat([1.0, 1000 / 9.81], 3),
        "the samples of 2 sensors alternate (ax = ": mixed,
    }
    for problem, sent in expected.items():
        decoder = samples.build(samples.Settings())
        for at in range(0, 1300, 10):
            block = make_block((at + np.arange(10)) * 20_000_000, sent[at : at + 10])
            decoded = decoder.feed([Chunk(encode_samples("d", at + 10, block), 0)])
        assert problem in decoder.recent_problem
        assert bool(decoded) == (not problem)
