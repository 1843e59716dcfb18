"""Tests of the samples message: encoding, decoding, refused messages, and the example in the documentation."""

import contextlib
import io
import re
import threading
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.data_types import AXES, SampleBlock, make_block
from drivers.errors import DecodeError
from drivers.zenoh import sample_message
from drivers.zenoh.sample_message import decode_samples, encode_samples
from tests.support.ports import free_endpoint
from tests.support.zenoh_sessions import open_router

START_NS = 1_763_700_000_123_456_789
PAGE = Path(__file__).parents[3] / "docs" / "reference" / "samples-format.md"


def make_samples(n: int, jitter_ns: int = 0) -> SampleBlock:
    rng = np.random.default_rng(3)
    t_ns = START_NS + np.arange(n) * 10_000_000 + rng.integers(0, jitter_ns + 1, n)
    return make_block(t_ns, rng.normal(size=(n, 6)), rng.normal(25, 1, n), lost=4)


def decode_msgpack(payload: bytes) -> dict[str, Any]:
    """Decode a message with a general MessagePack decoder."""
    decoded: dict[str, Any] = msgspec.msgpack.decode(payload)
    return decoded


@pytest.mark.parametrize("n", [1, 2, 500])
@pytest.mark.parametrize("jitter_ns", [0, 3_000_000])
def test_encoded_samples_are_decoded_without_changes(n: int, jitter_ns: int) -> None:
    sent = make_samples(n, jitter_ns)
    batch = decode_samples(encode_samples("bench-1", 1000, sent))
    assert (batch.device, batch.total_samples, batch.block.lost) == ("bench-1", 1000, 4)
    np.testing.assert_array_equal(batch.block.values, sent.values)
    np.testing.assert_array_equal(batch.block.temperature_c, sent.temperature_c)
    # float64 of Unix seconds resolves 0.24 µs; the grid may be off by half a microsecond
    assert np.abs(batch.block.t_ns - sent.t_ns).max() <= (250 if jitter_ns else 750)


def test_evenly_spaced_samples_are_sent_as_start_and_rate() -> None:
    even, uneven = (
        decode_msgpack(encode_samples("d", 10, make_samples(10))),
        decode_msgpack(encode_samples("d", 10, make_samples(10, 3_000_000))),
    )
    assert even["rate"] == pytest.approx(100.0)
    assert even["t0"] == pytest.approx(START_NS * 1e-9)
    assert even["t"] == pytest.approx(START_NS * 1e-9 + 0.09)
    assert isinstance(uneven["t"], bytes)
    assert "rate" not in uneven
    assert len(uneven["t"]) == 80


def test_only_measured_columns_are_sent() -> None:
    values = np.full((3, 6), np.nan)
    values[:, 2] = [1.0, np.nan, 3.0]
    sent = make_block(np.arange(3) * 1000, values)
    payload = decode_msgpack(encode_samples("d", 3, sent))
    assert payload["axes"] == ["gz"]
    assert len(payload["data"]) == 24
    got = decode_samples(encode_samples("d", 3, sent)).block
    np.testing.assert_array_equal(got.values, values)
    assert np.isnan(got.temperature_c).all()


def test_offset_converts_to_unix_time() -> None:
    sent = make_block(np.array([5_000_000_000]), np.ones((1, 6)))
    assert decode_samples(encode_samples("d", 1, sent, unix_offset_ns=START_NS)).block.t_ns[0] == pytest.approx(
        START_NS + 5e9, abs=250
    )


def make_valid_message() -> dict[str, Any]:
    return {
        "schema": "imu-monitor/samples/1",
        "device": "d",
        "t": 12.5,
        "t0": 12.0,
        "rate": 2.0,
        "samples": 2,
        "axes": ["gz", "az"],
        "data": np.array([[1.0, 2.0], [3.0, 4.0]]).astype("<f8").tobytes(),
    }


def test_documented_layout_is_decoded() -> None:
    batch = decode_samples(msgspec.msgpack.encode(make_valid_message()))
    assert batch.block.t_ns.tolist() == [12_000_000_000, 12_500_000_000]
    assert batch.block.values[:, AXES.index("gz")].tolist() == [1.0, 3.0]
    assert batch.block.values[:, AXES.index("az")].tolist() == [2.0, 4.0]


def test_unknown_keys_and_columns_are_ignored() -> None:
    later = make_valid_message() | {"axes": ["gz", "mx"], "quality": {"a": [1, 2]}}
    values = decode_samples(msgspec.msgpack.encode(later)).block.values
    assert values[:, 2].tolist() == [1.0, 3.0]
    assert np.isnan(values[:, [0, 1, 3, 4, 5]]).all()


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"schema": "imu-monitor/samples/2"}, "schema"),
        ({"axes": []}, "axes"),
        ({"axes": ["gz", "gz"]}, "axes"),
        ({"axes": ["gz"] * 65}, "axes"),
        ({"axes": ["gx", "gy", "gz"]}, "data"),
        ({"data": b""}, "data"),
        ({"data": b"123"}, "data"),
        ({"data": "text"}, "data"),
        ({"t": b"12345678"}, "t:"),
        ({"t": float("nan"), "t0": float("nan")}, "time"),
        ({"t0": 1e12}, "time"),
        ({"t": np.array([1.0, np.inf]).tobytes()}, "time"),
        ({"rate": 0.0}, "rate"),
        ({"rate": -5.0}, "rate"),
        ({"rate": float("nan")}, "rate"),
        ({"t0": None}, "t0"),
        ({"samples": -1}, "samples"),
        ({"lost": 1 << 60}, "lost"),
    ],
)
def test_invalid_message_is_refused(change: dict[str, Any], problem: str) -> None:
    with pytest.raises(DecodeError, match=problem):
        decode_samples(msgspec.msgpack.encode(make_valid_message() | change))


def test_message_with_too_many_rows_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sample_message, "MAX_ROWS", 1)
    with pytest.raises(DecodeError, match="rows"):
        decode_samples(msgspec.msgpack.encode(make_valid_message()))


@given(st.binary(max_size=200))
def test_noise_is_refused(data: bytes) -> None:
    with pytest.raises(DecodeError):
        decode_samples(data)


@given(st.integers(0, 200), st.integers(0, 255))
def test_damaged_message_is_refused_or_decoded(at: int, value: int) -> None:
    payload = bytearray(msgspec.msgpack.encode(make_valid_message()))
    payload[at % len(payload)] = value
    with contextlib.suppress(DecodeError):
        assert len(decode_samples(bytes(payload)).block) >= 1


def test_documented_example_receives_published_samples() -> None:
    program = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)[0]
    endpoint = free_endpoint()
    program = program.replace("tcp/127.0.0.1:7450", endpoint)
    # the only change is that the example ends after the first message
    program = program.replace("print(", "break_after(")
    printed = io.StringIO()

    class Done(Exception):
        pass

    def break_after(*words: object) -> None:
        print(*words, file=printed)
        raise Done

    sent = make_samples(20)
    stop = threading.Event()
    with open_router(endpoint) as opened:

        def publish() -> None:
            while not stop.wait(0.05):
                opened.put("imu/bench-1/samples", encode_samples("bench-1", 20, sent))

        publisher = threading.Thread(target=publish)
        publisher.start()
        try:
            with pytest.raises(Done):
                exec(program, {"break_after": break_after})
        finally:
            stop.set()
            publisher.join()
    assert printed.getvalue().startswith("bench-1 1763700000.31")
    assert repr(float(sent.values[-1, 2])) in printed.getvalue()
