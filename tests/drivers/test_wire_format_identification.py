"""Tests of identifying the wire format in captured bytes."""

from pathlib import Path

import numpy as np
import pytest

from drivers.data_types import NO_TICK, CounterTimedFormat, make_block
from drivers.wire_format_identification import MIN_SAMPLES, TEXT_DECODER, identify_wire_format
from tests.contracts.decoder_examples import EXAMPLES, Example

STREAMS = [example for example in EXAMPLES if example.carrier == "bytes"]
RATE_HZ = 100.0
BAUD_RATES = (9600, 38400, 115200, 230400, 460800, 921600)
WRONG_BAUD_RATIOS = sorted({a / b for a in BAUD_RATES for b in BAUD_RATES if 1 / 5 < a / b < 5 and a != b})
"""Ratios of the sender's baud rate to the reader's."""


def encode_capture(example: Example, folder: Path, samples: int = 60) -> bytes:
    """Return the bytes of a sensor at rest that sends 100 samples per second."""
    decoder = example.build(folder)
    rng = np.random.default_rng(7)
    values = np.concatenate([rng.normal(0.0, 0.01, (samples, 3)), rng.normal(0.0, 0.05, (samples, 3))], axis=1)
    values[:, 5] += 9.81
    t_ns = np.arange(samples, dtype=np.int64) * 10_000_000
    ticks = np.full(samples, NO_TICK, np.int64)
    if isinstance(decoder.timing, CounterTimedFormat):
        step = 1 if decoder.timing.tick_s is None else round(1.0 / (RATE_HZ * decoder.timing.tick_s))
        ticks = np.arange(samples, dtype=np.int64) * step % decoder.timing.modulus
    block = make_block(t_ns, values, np.full(samples, 25.0), ticks)
    return b"".join(chunk.data for chunk in decoder.encode(block))


def read_at_wrong_baud_rate(data: bytes, baud_ratio: float) -> bytes:
    """Return the bytes that a UART reads at another baud rate. Each byte has a start bit, 8 bits and a stop bit.

    ``baud_ratio`` is the sender's baud rate divided by the reader's.
    """
    bits = np.unpackbits(np.frombuffer(data, np.uint8)[:, None], axis=1, bitorder="little")
    sent = np.hstack([np.zeros((len(bits), 1), np.uint8), bits, np.ones((len(bits), 1), np.uint8)]).ravel()
    sent = np.concatenate([sent, np.ones(64, np.uint8)])
    times = np.arange(0.0, sent.size, baud_ratio / 16)  # the reader samples 16 times a bit
    line = sent[times.astype(np.int64)].tobytes()
    read = []
    at = line.find(0)
    while 0 <= at < len(line) - 160:
        if line[at + 152]:  # the stop bit
            read.append(line[at + 24 : at + 152 : 16])  # the centres of the bits
        at = line.find(0, at + 156)
    return np.packbits(np.frombuffer(b"".join(read), np.uint8), bitorder="little").tobytes()


@pytest.mark.parametrize("example", STREAMS, ids=str)
def test_capture_of_every_decoder_is_identified(example: Example, tmp_path: Path) -> None:
    data = encode_capture(example, tmp_path)
    found = identify_wire_format(b"\x00\xff noise" + data[len(data) // 7 :])
    assert found is not None
    assert found.decoder == example.name
    assert found.samples >= 40
    if not example.settings:
        assert found.rate_hz in (None, pytest.approx(RATE_HZ, rel=0.01))


@pytest.mark.parametrize("example", STREAMS, ids=str)
def test_capture_at_a_wrong_baud_rate_is_never_identified(example: Example, tmp_path: Path) -> None:
    data = encode_capture(example, tmp_path)
    for ratio in WRONG_BAUD_RATIOS:
        assert identify_wire_format(read_at_wrong_baud_rate(data, ratio)) is None


def test_simulated_uart_reads_the_sent_bytes_at_the_right_baud_rate() -> None:
    data = bytes(range(256))
    assert read_at_wrong_baud_rate(data, 1.0)[:255] == data[:255]


@pytest.mark.parametrize("captures", [20, pytest.param(1000, marks=pytest.mark.long)])
def test_noise_is_not_identified(captures: int) -> None:
    rng = np.random.default_rng(captures)
    for i in range(captures):
        data = rng.bytes(4096)
        if i % 2:  # printable noise, as of a terminal or a boot log
            data = bytes(32 + byte % 96 for byte in data).replace(b"~", b"\n")
        assert identify_wire_format(data) is None


@pytest.mark.parametrize(("line", "columns"), [("0.01,-0.02, 9.81", 3), ("1\t2\t3\t4\t5\t6", 6), ("17 1e-3 2 nan", 4)])
def test_lines_of_numbers_are_identified_as_text(line: str, columns: int) -> None:
    found = identify_wire_format((line + "\r\n").encode() * 20)
    assert found is not None
    assert (found.decoder, found.options, found.text_line) == (TEXT_DECODER, {"columns": ["?"] * columns}, line)


def test_labels_of_text_lines_name_the_columns() -> None:
    found = identify_wire_format(b"gx:0.01,gy:-0.02,az:9.81,light:3\r\n" * 20)
    assert found is not None
    assert (found.decoder, found.options) == (TEXT_DECODER, {"columns": ["gx", "gy", "az", "?"]})


@pytest.mark.parametrize("text", ["starting\nready\n" * 20, "1,2\n" * 20, "1,2,3\n" * MIN_SAMPLES])
def test_other_text_is_not_identified(text: str) -> None:
    assert identify_wire_format(text.encode()) is None
