"""Tests of the Epson decoder: layout, scales of the models, widths, fields, flags and settings.

No burst of a device is public. The bursts are synthetic: DEFAULT follows table 6.14 of the data sheet of the M-G362.
"""

import numpy as np
import pytest

from drivers.data_types import NO_TICK, ArrivalTimedFormat, Chunk, CounterTimedFormat, SampleBlock, make_block
from drivers.decoders.binary_frames.epson_uart import FIELDS, MODELS, Settings, build, encode_burst
from drivers.errors import ConfigError
from drivers.units import DEGREE, G0
from tests.support.settings import read_settings

DEFAULT = bytes.fromhex("80 FE 00 0A 4A 00 0A FF EC 00 05 00 00 00 00 1F 40 00 00 00 64 27 E9 0D")


def decode_one(burst: bytes, **settings: object) -> SampleBlock:
    (block,) = build(Settings(**settings)).feed([Chunk(burst, 77)])
    assert len(block) == 1
    return block


def test_burst_of_16_bits_is_decoded() -> None:
    got = decode_one(DEFAULT, model="g364pdca")
    np.testing.assert_allclose(got.values[0, :3], np.array([10, -20, 5]) * 0.00375 * DEGREE, rtol=1e-14)
    np.testing.assert_allclose(got.values[0, 3:], [0.0, 0.0, G0], rtol=1e-14)
    assert got.temperature_c[0] == pytest.approx(25.0, abs=1e-12)
    assert got.ticks.tolist() == [100]
    assert build(Settings(model="g364pdca")).timing == CounterTimedFormat(1 << 16)


def test_burst_of_32_bits_has_a_finer_resolution() -> None:
    content = bytes.fromhex("FE00 0A4A0000 000A8000 FFEC0000 00050000 00000000 00000000 1F400001 0000 0064")
    got = decode_one(encode_burst(content), model="g364pdca", bits=32)
    np.testing.assert_allclose(got.values[0, :3], np.array([10.5, -20, 5]) * 0.00375 * DEGREE, rtol=1e-14)
    assert got.values[0, 5] == pytest.approx((8000 + 2**-16) * 0.125e-3 * G0, rel=1e-14)
    assert got.temperature_c[0] == pytest.approx(25.0, abs=1e-12)


@pytest.mark.parametrize(
    ("model", "range_", "gyro_deg_s", "accel_mg", "temperature_c"),
    [
        ("g320", "8g", 0.008, 0.2, 25.0 + 2534 * 0.0037918),
        ("g354", "8g", 0.016, 0.2, 25.0 + 2534 * 0.0037918),
        ("g364pdc0", "8g", 0.0075, 0.125, 25.0 + 2534 * 0.0037918),
        ("g365pdf1", "8g", 1 / 66, 0.4, 25.0 + 2534 * 0.0037918),
        ("g366pdg0", "8g", 1 / 66, 0.25, 25.0 + 100 / 256),
        ("g366pdg0", "16g", 1 / 66, 0.5, 25.0 + 100 / 256),
        ("g370pdt0", "16g", 1 / 150, 0.5, 25.0 + 100 / 256),
        ("g570pr20", "8g", 1 / 66, 0.5, 25.0 + 100 / 256),
    ],
)
def test_model_sets_the_scales(
    model: str, range_: str, gyro_deg_s: float, accel_mg: float, temperature_c: float
) -> None:
    burst = encode_burst(bytes.fromhex("FE00 0064 03E8 0000 0000 0000 0000 07D0 0000 0001"))
    got = decode_one(burst, model=model, accelerometer_range=range_)
    assert got.values[0, 0] == pytest.approx(1000 * gyro_deg_s * DEGREE, rel=1e-14)
    assert got.values[0, 5] == pytest.approx(2.0 * accel_mg * G0, rel=1e-14)
    assert got.temperature_c[0] == pytest.approx(temperature_c, abs=1e-12)


@pytest.mark.parametrize("bits", [16, 32])
def test_all_fields_are_skipped_in_their_order(bits: int) -> None:
    """The numbers of each field are the position of the field."""
    sizes = {
        "temperature": 1,
        "gyro": 3,
        "accel": 3,
        "delta_angle": 3,
        "delta_velocity": 3,
        "quaternion": 4,
        "attitude": 3,
    }
    content = b"".join(
        (position * (1 << (bits - 16))).to_bytes(bits // 8, "big") * sizes[field]
        if field in sizes
        else (position << 1).to_bytes(2, "big")
        for position, field in enumerate(FIELDS)
    )
    got = decode_one(encode_burst(content), model="g366pdg0", bits=bits, fields=tuple(reversed(FIELDS)))
    np.testing.assert_allclose(got.values[0, :3], 2 * DEGREE / 66, rtol=1e-14)
    np.testing.assert_allclose(got.values[0, 3:], 3 * 0.25e-3 * G0, rtol=1e-14)
    assert (got.temperature_c.tolist(), got.ticks.tolist()) == ([25.0 + 1 / 256], [18])


def test_burst_with_rates_only() -> None:
    settings = Settings(model="g366pdg0", fields=("gyro",), clock="arrival")
    decoder = build(settings)
    assert decoder.timing == ArrivalTimedFormat()
    values = np.full((2, 6), np.nan)
    values[:, :3] = 0.1
    (block,) = decoder.feed(decoder.encode(make_block(np.arange(2), values)))
    np.testing.assert_allclose(block.values, values, atol=DEGREE / 132)
    assert np.isnan(block.temperature_c).all()
    assert block.ticks.tolist() == [NO_TICK, NO_TICK]


def test_reset_counter_is_not_used_for_arrival_times() -> None:
    assert decode_one(DEFAULT, model="g364pdca", clock="arrival").ticks.tolist() == [NO_TICK]


def test_error_flag_makes_the_sample_bad() -> None:
    decoder = build(Settings(model="g364pdca"))
    blocks = decoder.feed([Chunk(DEFAULT + encode_burst(b"\xfe\x01" + DEFAULT[3:-3]), 0)])
    assert [(len(block), block.lost) for block in blocks] == [(1, 0)]
    assert decoder.bad == 1
    assert "error" in decoder.recent_problem
    assert decoder.feed([Chunk(DEFAULT, 0)])[0].lost == 1
    assert decoder.recent_problem == ""


def test_missing_axis_is_encoded_as_an_error() -> None:
    values = np.zeros((3, 6))
    values[1, 2] = np.nan
    decoder = build(Settings(model="g366pdg0"))
    blocks = decoder.feed(decoder.encode(make_block(np.arange(3), values, np.zeros(3), np.arange(3))))
    assert [(len(block), block.lost) for block in blocks] == [(1, 0), (1, 1)]


@pytest.mark.parametrize("bits", [16, 32])
@pytest.mark.parametrize("model", MODELS)
def test_every_model_survives_encoding_and_decoding(model: str, bits: int) -> None:
    rng = np.random.default_rng(len(model))
    samples = make_block(np.arange(4), rng.normal(0, 1, (4, 6)), np.full(4, 31.0), np.array([65534, 65535, 0, 1]))
    decoder = build(Settings(model=model, bits=bits))
    (block,) = decoder.feed(decoder.encode(samples))
    scale = 1 << (bits - 16)
    np.testing.assert_allclose(block.values[:, :3], samples.values[:, :3], atol=0.009 * DEGREE / scale)
    np.testing.assert_allclose(block.values[:, 3:], samples.values[:, 3:], atol=0.26e-3 * G0 / scale)
    np.testing.assert_allclose(block.temperature_c, 31.0, atol=0.002)
    assert block.ticks.tolist() == [65534, 65535, 0, 1]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({}, "model"),
        ({"model": "g999"}, "g366pdg0"),
        ({"model": "g366pdg0", "fields": ["giro", "count"]}, "gyro"),
        ({"model": "g366pdg0", "fields": ["temperature", "count"]}, "neither gyro nor accel"),
        ({"model": "g366pdg0", "fields": ["gyro", "gyro", "count"]}, "twice"),
        ({"model": "g366pdg0", "fields": ["gyro"]}, "clock"),
        ({"model": "g365pdf1", "accelerometer_range": "16g"}, "no range of 16g"),
    ],
)
def test_error_for_wrong_settings_names_the_key(settings: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        build(read_settings(Settings, settings))
