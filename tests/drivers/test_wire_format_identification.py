"""Tests of identifying the wire format in captured bytes."""

from pathlib import Path

import numpy as np
import pytest

from drivers.data_types import NO_TICK, Chunk, CounterTimedFormat, Floats, make_block
from drivers.decoders.text_lines import text
from drivers.text_layout_identification import decode_readable_lines
from drivers.validation.settings_model import check_table
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


ISSUE_LINE = "A:{0:.3f},{1:.3f},{2:.3f} G:{3:.3f},{4:.3f},{5:.3f} T:{6:.1f}"
TEXT_LINES = [  # layout, gravity, columns in the order of the layout, options
    (ISSUE_LINE, 9.81, {"accel_unit": "m/s²"}),
    (ISSUE_LINE + "°C", 1.0, {"accel_unit": "g"}),
    ("t:{7} acc: {0:.3f} {1:.3f} {2:.3f} gyro: {3:.3f} {4:.3f} {5:.3f} temp: {6:.1f}", 1.0, {"accel_unit": "g"}),
    ("T={6:.1f};a={0:.3f},{1:.3f},{2:.3f};g={3:.3f},{4:.3f},{5:.3f};mag=7.0,8.0,9.0", 1000.0, {"accel_unit": "mg"}),
    ("AcX = {0:.0f} | AcY = {1:.0f} | AcZ = {2:.0f} | Tmp = {6:.2f} | GyX = {3:.2f} | GyY = {4:.2f} | GyZ = {5:.2f}",
     16384.0, {"accel_unit": "g/16384"}),
    ("Acceleration X: {0:.3f}, Y: {1:.3f}, Z: {2:.3f} m/s^2 Rotation X: {3:.3f}, Y: {4:.3f}, Z: {5:.3f} rad/s "
     "Temperature: {6:.1f} degC", 9.81, {"accel_unit": "m/s²", "gyro_unit": "rad/s"}),
    ('{{"acc":[{0:.3f}, {1:.3f}, {2:.3f}], "gyr":[{3:.3f}, {4:.3f}, {5:.3f}], "temp": {6:.1f}}}', 9.81, {}),
    ("G {3:.3f}dps {4:.3f}dps {5:.3f}dps A {0:.3f}g {1:.3f}g {2:.3f}g T {6:.1f}", 1.0, {"gyro_unit": "dps"}),
    ("A:{0:8.3f},{1:8.3f},{2:8.3f}  G:{3:8.3f},{4:8.3f},{5:8.3f} T:{6:.1f}", 9.81, {}),
    ("12:30:15 -> acc=({0:.3f}, {1:.3f}, {2:.3f}) gyro=({3:.3f}, {4:.3f}, {5:.3f}) temp={6:.1f}", 9.81, {}),
    ("accX:{0:.3f},accY:{1:.3f},accZ:{2:.3f},gyroX:{3:.3f},gyroY:{4:.3f},gyroZ:{5:.3f},temp:{6:.1f}", 9.81, {}),
]  # fmt: skip


def write_text_lines(layout: str, gravity: float) -> tuple[bytes, Floats]:
    """Return 40 lines of a sensor at rest, and the numbers ax ay az gx gy gz temperature in these lines."""
    rng = np.random.default_rng(3)
    accel = rng.normal((0.1, -0.2, 0.97), 0.005, (40, 3)) * gravity
    table = np.column_stack([accel, rng.normal(0.0, 0.05, (40, 3)), rng.normal(25.0, 0.3, 40)])
    lines = [layout.format(*row, 1000 + 10 * i) + "\r\n" for i, row in enumerate(table.tolist())]
    return "".join(lines).encode(), table


@pytest.mark.parametrize(("layout", "gravity", "options"), TEXT_LINES)
def test_identified_text_lines_are_decoded_with_the_right_axes(
    layout: str, gravity: float, options: dict[str, str]
) -> None:
    data, table = write_text_lines(layout, gravity)
    found = identify_wire_format(data)
    assert found is not None
    assert found.decoder == TEXT_DECODER
    assert {key: found.options[key] for key in options} == options
    si = {"gyro_unit": "rad/s", "accel_unit": "m/s²/1000"}
    decoder = text.build(check_table(text.Settings, {**found.options, **si}).value)
    (block,) = decoder.feed([Chunk(data, 0)])
    assert (len(block), decoder.bad) == (39, 0)
    np.testing.assert_allclose(block.values[:, :3], table[1:, 3:6], atol=0.006)
    np.testing.assert_allclose(1000.0 * block.values[:, 3:], table[1:, :3], atol=0.51 if gravity > 2000.0 else 0.001)
    np.testing.assert_allclose(block.temperature_c, table[1:, 6], atol=0.051)


@pytest.mark.parametrize(
    ("layout", "gravity", "columns"),
    [
        ("{3:.3f},{4:.3f},{5:.3f},{0:.3f},{1:.3f},{2:.3f}", 9.81, "gx gy gz ax ay az"),
        ("{7} {0:.3f} {1:.3f} {2:.3f} {3:.3f} {4:.3f} {5:.3f}", 1.0, "t ax ay az gx gy gz"),
        ("{0:.0f}\t{1:.0f}\t{2:.0f}\t{6:.2f}\t{3:.0f}\t{4:.0f}\t{5:.0f}", 16384.0, "ax ay az - gx gy gz"),
        ("{0:.3f}; {1:.3f}; {2:.3f}", 9.81, "ax ay az"),
        ("{3:.3f},{4:.3f},{5:.3f}", 9.81, "gx gy gz"),
        ("gx:{3:.3f},gy:{4:.3f},az:{2:.3f},light:3", 9.81, "gx gy az -"),
        ("roll:{3:.3f},pitch:{4:.3f},yaw:{5:.3f},{0:.3f},{1:.3f},{2:.3f}", 9.81, "- - - ax ay az"),
        ("rpy:{3:.3f},{4:.3f},{5:.3f},{0:.3f},{1:.3f},{2:.3f}", 9.81, "- - - ax ay az"),
    ],
)
def test_columns_of_numbers_are_named_by_labels_or_gravity(layout: str, gravity: float, columns: str) -> None:
    found = identify_wire_format(write_text_lines(layout, gravity)[0])
    assert found is not None
    assert (found.decoder, found.options["columns"]) == (TEXT_DECODER, columns.split())


@pytest.mark.parametrize(
    "layout",
    [
        "roll {3:.3f} pitch {4:.3f} yaw {5:.3f}",
        "ypr\t{3:.3f}\t{4:.3f}\t{5:.3f}",
        "mag: {3:.3f}, {4:.3f}, {5:.3f}",
        "mx={3:.3f} my={4:.3f} mz={5:.3f}",
        "q:{2:.3f},{3:.3f},{4:.3f},{5:.3f}",
    ],
)
def test_other_labelled_quantities_are_not_axes(layout: str) -> None:
    assert identify_wire_format(write_text_lines(layout, 1.0)[0]) is None


def test_text_at_a_wrong_baud_rate_is_not_readable() -> None:
    data, _ = write_text_lines(ISSUE_LINE, 9.81)
    assert decode_readable_lines(data)
    for ratio in WRONG_BAUD_RATIOS:
        assert decode_readable_lines(read_at_wrong_baud_rate(data, ratio)) == []


@pytest.mark.parametrize("captured", ["starting\nready\n" * 20, "1,2\n" * 20, "1,2,3\n" * MIN_SAMPLES])
def test_other_text_is_not_identified(captured: str) -> None:
    assert identify_wire_format(captured.encode()) is None
