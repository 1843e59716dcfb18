"""Tests of the BNO055 decoder: registers and units of the data sheet, errors, modes and damaged answers.

No public source contains an answer with the registers 0x00 to 0x3B. The answers are synthetic: they follow the register
map of the data sheet, with its identifiers and default register values.
"""

import struct

import numpy as np
import pytest

from drivers.data_types import ArrivalTimedFormat, Chunk, SampleBlock, concatenate_blocks, make_block
from drivers.decoders.base import MAX_FRAMES_WITHOUT_SAMPLE
from drivers.decoders.binary_frames.bno055 import LENGTH, MAX_ERROR_BYTES, Settings, build
from drivers.units import DEGREE, G0

ACCEL, GYRO = (-12, 3, 981), (16, -160, 1600)
OVERRUN, ACKNOWLEDGED = b"\xee\x07", b"\xee\x01"


def make_answer(
    gyro: tuple[int, ...] = GYRO,
    accel: tuple[int, ...] = ACCEL,
    temperature: int = 25,
    status: int = 6,
    error: int = 0,
    units: int = 0x80,
) -> bytes:
    """Return the answer to ``AA 01 00 3C``. The default units are the value of UNIT_SEL after power-on."""
    registers = bytearray(0x3C)
    registers[:7] = bytes.fromhex("A0 FB 32 0F 11 03 15")
    registers[0x08:0x0E] = struct.pack("<3h", *accel)
    registers[0x0E:0x14] = struct.pack("<3h", 300, -20, 7)
    registers[0x14:0x1A] = struct.pack("<3h", *gyro)
    registers[0x34] = temperature & 0xFF
    registers[0x36] = 0x0F
    registers[0x39:0x3C] = bytes([status, error, units])
    return b"\xbb\x3c" + bytes(registers)


def decode_one(answer: bytes) -> SampleBlock:
    (block,) = build(Settings()).feed([Chunk(answer, 77)])
    assert len(block) == 1
    return block


def test_default_units() -> None:
    got = decode_one(make_answer())
    np.testing.assert_allclose(got.values[0], [DEGREE, -10 * DEGREE, 100 * DEGREE, -0.12, 0.03, 9.81], rtol=1e-14)
    assert (got.temperature_c.tolist(), got.t_ns.tolist()) == ([25.0], [77])
    assert build(Settings()).timing == ArrivalTimedFormat(answers_requests=True)


def test_units_of_each_answer_are_read_from_unit_sel() -> None:
    blocks = build(Settings()).feed([Chunk(make_answer(units=0x13, temperature=-8) + make_answer(units=0x92), 0)])
    got = concatenate_blocks(blocks)
    rates = np.array(GYRO) / 900.0
    np.testing.assert_allclose(got.values[0], [*rates, *(1e-3 * G0 * np.array(ACCEL))], rtol=1e-14)
    np.testing.assert_allclose(got.values[1], [*rates, -0.12, 0.03, 9.81], rtol=1e-14)
    np.testing.assert_allclose(got.temperature_c, [(-16.0 - 32.0) / 1.8, 10.0])


def test_request_of_the_documentation_reads_the_decoded_registers() -> None:
    start, command, register, count = bytes.fromhex("AA 01 00 3C")
    assert (start, command, register, count) == (0xAA, 1, 0, LENGTH - 2)
    (chunk,) = build(Settings()).encode(make_block(np.zeros(1, np.int64), np.ones((1, 6))))
    assert chunk.data[:2] == bytes([0xBB, count])
    assert len(chunk.data) == len(make_answer()) == LENGTH


@pytest.mark.parametrize(("errors", "missed"), [(OVERRUN, 1), (OVERRUN * 2, 2), (ACKNOWLEDGED, 0), (b"\xee\x03", 0)])
def test_each_error_answer_to_a_read_request_is_one_missing_sample(errors: bytes, missed: int) -> None:
    decoder = build(Settings())
    stream = make_answer() * 3 + errors + make_answer() * 2
    blocks = decoder.feed([Chunk(stream[:200], 0), Chunk(stream[200:], 1)])
    got = concatenate_blocks(blocks)
    assert (len(got), got.lost, decoder.bad) == (5, missed, 0)
    assert decoder.recent_problem == ""


def test_damaged_answer_beside_an_error_answer_is_bad() -> None:
    decoder = build(Settings())
    damaged = b"\xbb\x3c\xa1" + make_answer()[3:]
    stream = make_answer() * 2 + OVERRUN + make_answer() + damaged + OVERRUN + make_answer()
    got = concatenate_blocks(decoder.feed([Chunk(stream, 0)]))
    assert (len(got), got.lost, decoder.bad) == (4, 3, 1)
    assert "damaged" in decoder.recent_problem


def test_sensor_that_answers_only_with_errors_is_reported() -> None:
    decoder = build(Settings())
    assert decoder.feed([Chunk(b"\xee\x04" * (MAX_ERROR_BYTES // 2), 0)]) == []
    assert "error 4" in decoder.recent_problem
    (block,) = decoder.feed([Chunk(make_answer(), 0)])
    assert (block.lost, decoder.bad, decoder.recent_problem) == (MAX_ERROR_BYTES // 2, 0, "")


def test_sensor_in_config_mode_makes_no_samples() -> None:
    decoder = build(Settings())
    idle = make_answer(gyro=(0, 0, 0), accel=(0, 0, 0), status=0)
    assert decoder.feed([Chunk(idle * (MAX_FRAMES_WITHOUT_SAMPLE + 1), 0)]) == []
    assert "AA 00 3D 01 05" in decoder.recent_problem
    (block,) = decoder.feed([Chunk(make_answer(), 0)])
    assert (block.lost, decoder.bad, decoder.recent_problem) == (0, 0, "")


def test_system_error_makes_the_sample_bad() -> None:
    decoder = build(Settings())
    assert decoder.feed([Chunk(make_answer(status=1, error=3), 0)]) == []
    assert decoder.bad == 1
    assert "system error 3" in decoder.recent_problem


@pytest.mark.parametrize(("status", "noted"), [(5, True), (6, False)])
def test_sensor_fusion_is_noted(status: int, noted: bool) -> None:
    decoder = build(Settings())
    assert decoder.on_board_filter_note == ""
    decoder.feed([Chunk(make_answer(status=status), 0)])
    assert ("hides bias instability" in decoder.on_board_filter_note) == noted


def test_truncated_answer_is_not_completed_by_the_next_one() -> None:
    decoder = build(Settings())
    stream = make_answer() + make_answer(gyro=(5, 5, 5))[:40] + make_answer() * 2
    got = concatenate_blocks(decoder.feed([Chunk(stream, 0)]))
    np.testing.assert_array_equal(got.values, np.repeat(got.values[:1], 3, axis=0))
    assert (len(got), got.lost, decoder.bad) == (3, 1, 1)


def test_answer_of_another_register_page_or_chip_is_rejected() -> None:
    other_page = bytearray(make_answer())
    other_page[2 + 7] = 1
    other_chip = b"\xbb\x3c\x24" + make_answer()[3:]
    decoder = build(Settings())
    assert decoder.feed([Chunk((bytes(other_page) + other_chip) * 20, 0)]) == []
    assert "baud rate" in decoder.recent_problem
