"""Tests of the decoder for CAN databases: golden frames, signals, joining of frames, settings and recordings.

cantools is the independent reference for signals.
"""

import struct
from pathlib import Path
from typing import Any

import cantools
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.data_types import (
    ANY_SOURCE,
    AXES,
    EXTENDED_ID,
    NO_TICK,
    ArrivalTimedFormat,
    Chunk,
    CounterTimedFormat,
    SampleBlock,
    concatenate_blocks,
    make_block,
)
from drivers.decoders import dbc
from drivers.decoders.dbc.database import SHIPPED
from drivers.decoders.dbc.signal_bits import SignalCodec
from drivers.errors import ConfigError, LinkEnded
from drivers.links import replay_link
from drivers.units import DEGREE, G0
from tests.support.recordings import recordings
from tests.support.settings import read_settings

CANMOD_SIGNALS = {f"g{c}": f"ImuData.AngularRate{c.upper()}" for c in "xyz"} | {
    f"a{c}": f"ImuData.Acceleration{c.upper()}" for c in "xyz"
}
SAE_SIGNALS = {
    "gx": "AngularRateInformation.RollRate",
    "gy": "AngularRateInformation.PitchRate",
    "gz": "AngularRateInformation.YawRate",
    "ax": "AccelerationSensor.LongitudinalAcceleration",
    "ay": "AccelerationSensor.LateralAcceleration",
    "az": "AccelerationSensor.VerticalAcceleration",
}
XSENS_SIGNALS = {f"g{c}": f"RateOfTurn.Rate{c.upper()}" for c in "xyz"} | {
    f"a{c}": f"Acceleration.Acceleration{c.upper()}" for c in "xyz"
}
BOSCH_SIGNALS = {
    "gz": "Mm7Frame1.YawRate",
    "ay": "Mm7Frame1.AccelerationY",
    "gx": "Mm7Frame2.RollRate",
    "ax": "Mm7Frame2.AccelerationX",
    "gy": "Mm7Frame3.PitchRate",
    "az": "Mm7Frame3.AccelerationZ",
}
TPDO_SIGNALS = {f"g{c}": f"Tpdo2.Rate{c.upper()}" for c in "xyz"} | {
    f"a{c}": f"Tpdo1.Acceleration{c.upper()}" for c in "xyz"
}
OXTS_SIGNALS = {f"g{c}": f"RateVehicle.AngRate{c.upper()}" for c in "xyz"} | {
    f"a{c}": f"AccelVehicle.Accel{c.upper()}" for c in "xyz"
}
RATE_ID, ACCEL_ID = 0x0CF02AE2 | EXTENDED_ID, 0x0CF02DE2 | EXTENDED_ID


def build(file: str | Path, signals: dict[str, Any], **keys: Any) -> dbc.DbcDecoder:
    decoder = dbc.build(read_settings(dbc.Settings, {"file": str(file), "signals": signals, **keys}))
    assert isinstance(decoder, dbc.DbcDecoder)
    return decoder


def make_chunk(address: int, data: str | bytes, t_ns: int = 0) -> Chunk:
    return Chunk(bytes.fromhex(data) if isinstance(data, str) else data, t_ns, address)


# --- golden frames (SAE J1939 devices, Xsens, Bosch) ---------------------------------------------


def test_honeywell_frames_are_decoded() -> None:
    decoder = build("j1939_imu", SAE_SIGNALS)
    got = decoder.feed([make_chunk(RATE_ID, "007D007D007D0005", 5), make_chunk(ACCEL_ID, "007D007DD5800005", 7)])
    assert got[0].values[0] == pytest.approx([0, 0, 0, 0, 0, 9.81], abs=1e-9)
    assert got[0].t_ns.tolist() == [7]


def test_axis_order_differs_between_sae_and_xyz_devices() -> None:
    frame = make_chunk(0x0CF02A80 | EXTENDED_ID, "C07DE07B00820005")
    sae = build("j1939_imu", {a: SAE_SIGNALS[a] for a in ("gx", "gy", "gz")})
    assert sae.feed([frame])[0].values[0, :3] / DEGREE == pytest.approx([-2.25, 1.5, 10.0])
    xyz = build("j1939_imu_xyz", {f"g{c}": f"AngularRateInformation.Rate{c.upper()}" for c in "xyz"})
    assert xyz.feed([frame])[0].values[0, :3] / DEGREE == pytest.approx([1.5, -2.25, 10.0])


def test_not_available_values_become_nan() -> None:
    decoder = build("j1939_imu", {a: SAE_SIGNALS[a] for a in ("gx", "gy", "gz")})
    largest = 0xFDFF / 128 - 250
    got = concatenate_blocks(
        decoder.feed([make_chunk(RATE_ID, "FFFF007D00FE0005"), make_chunk(RATE_ID, "FFFDFFFD00000005")])
    )
    assert got.values[0, :3] / DEGREE == pytest.approx([0.0, np.nan, np.nan], nan_ok=True)
    assert got.values[1, :3] / DEGREE == pytest.approx([largest, largest, -250.0])
    assert decoder.feed([make_chunk(RATE_ID, "FFFFFFFFFFFFFFFF")]) == []
    assert decoder.bad == 1
    as_numbers = build("j1939_imu", {"gy": SAE_SIGNALS["gy"]}, not_available=False)
    raw = as_numbers.feed([make_chunk(RATE_ID, "FFFF007D00FE0005")])[0].values[0, 1]
    assert raw / DEGREE == pytest.approx(0xFFFF / 128 - 250)


def test_shipped_database_decodes_slope_message() -> None:
    database = cantools.database.load_file(SHIPPED / "j1939_imu.dbc")
    got = database.decode_message("SlopeSensorInformation2", bytes.fromhex("00A07D00C07C000A"))
    assert (got["PitchAngle"], got["RollAngle"], got["Latency"]) == pytest.approx((1.25, -0.5, 5.0))


def test_xsens_frames_are_decoded() -> None:
    signals = {**XSENS_SIGNALS, "temperature": "Temperature.SensorTemperature"}
    decoder = build("xsens_mti", signals, counter="SampleTime.SampleTimeFine", tick=1e-4)
    assert decoder.timing == CounterTimedFormat(1 << 32, 1e-4)
    got = decoder.feed(
        [
            make_chunk(0x51, "1980"),
            make_chunk(0x5, "0000 04D2"),
            make_chunk(0x32, "0033 FF9A 001A"),
            make_chunk(0x34, "0080 FFC0 09CF"),
        ]
    )
    expected = [0.099609375, -0.19921875, 0.05078125, 0.5, -0.25, 9.80859375]
    assert got[0].values[0].tolist() == expected
    assert got[0].ticks.tolist() == [1234]
    assert got[0].temperature_c.tolist() == [25.5]


def test_bosch_frames_are_decoded() -> None:
    decoder = build("bosch_mm7", BOSCH_SIGNALS)
    got = decoder.feed(
        [
            make_chunk(0x174, "D0870000A69E0000"),
            make_chunk(0x178, "0080000000800000"),
            make_chunk(0x17C, "0080000000800000"),
        ]
    )
    rates, forces = got[0].values[0, :3] / DEGREE, got[0].values[0, 3:] / G0
    assert rates == pytest.approx([0.0, 0.0, 10.0], abs=1e-9)
    assert forces == pytest.approx([-2.7e-5, 1.0000635, -2.7e-5], abs=1e-6)


@pytest.mark.parametrize(
    ("file", "signals", "frames", "gyro_deg_s", "accel_m_s2", "temperature_c"),
    [
        # 1000 counts of 7/800 deg/s, 1 g = 4096 counts
        (
            "sick_tmm61",
            {**TPDO_SIGNALS, "temperature": "Tpdo1.Temperature"},
            {0x181: "0000 00F0 0010 E7", 0x281: "E803 18FC 0000"},
            [8.75, -8.75, 0.0],
            [0.0, -G0, G0],
            -25.0,
        ),
        (
            "dis_qg65d",
            {**TPDO_SIGNALS, "temperature": "Tpdo1.Temperature"},
            {0x181: "0000 18FC E803 FB00", 0x281: "6400 9CFF 0100"},
            [1.0, -1.0, 0.01],
            [0.0, -G0, G0],
            25.1,
        ),
        (
            "oxts_rt",
            OXTS_SIGNALS,
            {0x605: "6400 0000 2BFC", 0x608: "6400 9CFF 0100"},
            [1, -1, 0.01],
            [1, 0, -9.81],
            None,
        ),
    ],
)
def test_documented_layouts_are_decoded_as_by_cantools(
    file: str,
    signals: dict[str, str],
    frames: dict[int, str],
    gyro_deg_s: list[float],
    accel_m_s2: list[float],
    temperature_c: float | None,
) -> None:
    got = concatenate_blocks(build(file, signals).feed([make_chunk(a, data) for a, data in frames.items()]))
    assert got.values[0, :3] / DEGREE == pytest.approx(gyro_deg_s)
    assert got.values[0, 3:] == pytest.approx(accel_m_s2)
    assert got.temperature_c[0] == pytest.approx(np.nan if temperature_c is None else temperature_c, nan_ok=True)
    database = cantools.database.load_file(SHIPPED / f"{file}.dbc")
    decoded = {
        f"{database.get_message_by_frame_id(a).name}.{name}": value
        for a, data in frames.items()
        for name, value in database.decode_message(a, bytes.fromhex(data)).items()
    }
    assert [decoded[signals[axis]] for axis in AXES[:3]] == pytest.approx(gyro_deg_s)


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.dbc")), ids=lambda p: p.stem)
def test_shipped_databases_pass_the_strict_check(path: Path) -> None:
    """No signals overlap, and each signal lies inside its message."""
    assert cantools.database.load_file(path, strict=True).messages


# --- signals, compared with cantools -----------------------------------------------------------------

SIGNAL_TYPES = st.tuples(st.integers(1, 64), st.booleans(), st.booleans())


def format_one_signal_dbc(start: int, length: int, big: bool, signed: bool, scale: float, kind: int = 0) -> str:
    sign = "-" if signed else "+"
    text = f'VERSION ""\n\nBU_: X\n\nBO_ 100 M: 8 X\n SG_ S : {start}|{length}@{0 if big else 1}{sign} '
    text += f'({scale!r},-3) [0|0] "m/s^2" X\n\n'
    return text + (f"SIG_VALTYPE_ 100 S : {kind};\n" if kind else "")


@pytest.mark.long
@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(data=st.data(), kind=SIGNAL_TYPES, frames=st.lists(st.binary(min_size=8, max_size=8), min_size=1, max_size=5))
def test_signal_is_decoded_as_by_cantools(
    tmp_path: Path, data: st.DataObject, kind: tuple[int, bool, bool], frames: list[bytes]
) -> None:
    length, big, signed = kind
    first = data.draw(st.integers(0, 64 - length))
    # a DBC numbers the most significant bit of Motorola signals, 7 … 0 within each byte
    start = 8 * (first // 8) + 7 - first % 8 if big else first
    path = tmp_path / "one.dbc"
    path.write_text(format_one_signal_dbc(start, length, big, signed, 0.5))
    message = cantools.database.load_file(path).get_message_by_name("M")
    bits = build(path, {"ax": "M.S"})._messages[0].columns[0].bits
    stacked = np.frombuffer(b"".join(frames), np.uint8).reshape(-1, 8)
    expected = [message.decode(f)["S"] for f in frames]
    np.testing.assert_allclose(bits.extract_values(stacked), expected, rtol=1e-15)
    # writing the raw numbers into other frames touches these bits and no other
    other_frames = np.full_like(stacked, 0xA5)
    bits.insert_raw(other_frames, bits.extract_raw(stacked))
    np.testing.assert_array_equal(bits.extract_raw(other_frames), bits.extract_raw(stacked))
    mask = np.zeros_like(stacked)
    bits.insert_raw(mask, np.full(len(mask), (1 << length) - 1, np.uint64))
    np.testing.assert_array_equal(other_frames & ~mask, np.full_like(other_frames, 0xA5) & ~mask)


@pytest.mark.parametrize(("length", "kind", "code"), [(32, 1, "f"), (64, 2, "d")])
@pytest.mark.parametrize("big", [False, True])
def test_float_signals_are_decoded_and_encoded(tmp_path: Path, length: int, kind: int, code: str, big: bool) -> None:
    path = tmp_path / "float.dbc"
    path.write_text(format_one_signal_dbc(7 if big else 0, length, big, True, 1.0, kind))
    decoder = build(path, {"ax": "M.S"})
    wire = struct.pack((">" if big else "<") + code, 12.75).ljust(8, b"\0")
    assert decoder.feed([make_chunk(100, wire)])[0].values[0, 3] == 9.75
    [sent] = decoder.encode(make_block(np.zeros(1, np.int64), np.full((1, 6), 9.75)))
    assert sent.data == wire
    nan = struct.pack((">" if big else "<") + code, np.nan).ljust(8, b"\0")
    assert decoder.feed([make_chunk(100, nan)]) == []


@given(st.integers(1, 64), st.booleans(), st.floats(-1e30, 1e30))
def test_value_out_of_range_is_limited(length: int, signed: bool, value: float) -> None:
    bits = SignalCodec(0, length, False, signed, False, 1.0, 0.0, False)
    frames = np.zeros((1, 8), np.uint8)
    bits.insert_values(frames, np.array([value]))
    low = -(2 ** (length - 1)) if signed else 0
    high = low + 2**length - 1
    limited = min(max(value, low), high)
    assert bits.extract_values(frames)[0] == pytest.approx(limited, rel=1e-15, abs=0.5)


# --- round trips ------------------------------------------------------------------------------

CASES: list[tuple[str, dict[str, str], dict[str, Any], list[float]]] = [
    ("canmod_gps", CANMOD_SIGNALS, {"valid": "ImuData.ImuValid"}, [0.25 * DEGREE] * 3 + [0.125] * 3),
    ("j1939_imu", SAE_SIGNALS, {}, [DEGREE / 128] * 3 + [0.01] * 3),
    ("xsens_mti", XSENS_SIGNALS, {"counter": "SampleTime.SampleTimeFine", "tick": 1e-4}, [2**-9] * 3 + [2**-8] * 3),
    ("xsens_mti", XSENS_SIGNALS, {"counter": "GroupCounter.Counter", "join": "counter"}, [2**-9] * 3 + [2**-8] * 3),
    ("bosch_mm7", BOSCH_SIGNALS, {}, [0.005 * DEGREE] * 3 + [0.000127465 * G0] * 3),
    ("sick_tmm61", TPDO_SIGNALS, {}, [7 / 800 * DEGREE] * 3 + [G0 / 4096] * 3),
    ("dis_qg65d", TPDO_SIGNALS, {}, [0.01 * DEGREE] * 3 + [1e-3 * G0] * 3),
    ("oxts_rt", OXTS_SIGNALS, {}, [0.01 * DEGREE] * 3 + [0.01] * 3),
]


def make_samples(n: int, seed: int = 0) -> SampleBlock:
    rng = np.random.default_rng(seed)
    values = rng.uniform(-1, 1, (n, 6)) * [2, 2, 2, 30, 30, 30]
    ticks = np.arange(100, 100 + n)
    return make_block(np.arange(n) * 10_000_000, values, rng.uniform(0, 50, n), ticks)


@pytest.mark.parametrize(("file", "signals", "keys", "lsb"), CASES)
def test_feeding_encoded_samples_returns_them_to_half_a_bit(
    file: str, signals: dict[str, str], keys: dict[str, Any], lsb: list[float]
) -> None:
    decoder = build(file, signals, **keys)
    sent = make_samples(300)
    chunks = decoder.encode(sent)
    got = concatenate_blocks(decoder.feed(chunks))
    assert (np.abs(got.values - sent.values) <= 0.5001 * np.array(lsb)).all()
    np.testing.assert_array_equal(got.t_ns, sent.t_ns)
    np.testing.assert_array_equal(got.ticks, sent.ticks if "counter" in keys else np.full(300, NO_TICK))
    assert (decoder.bad, got.lost, decoder.recent_problem) == (0, 0, "")
    # feeding frame by frame returns the same samples
    single = build(file, signals, **keys)
    one_by_one = concatenate_blocks([b for c in chunks for b in single.feed([c])])
    np.testing.assert_array_equal(one_by_one.values, got.values)


def test_last_temperature_is_repeated_until_the_next_one() -> None:
    decoder = build("xsens_mti", {**XSENS_SIGNALS, "temperature": "Temperature.SensorTemperature"})
    temperature = np.array([np.nan, 20.0, np.nan, np.nan, 30.0])
    sent = make_block(np.arange(5), make_samples(5).values.copy(), temperature)
    got = concatenate_blocks(decoder.feed(decoder.encode(sent)))
    np.testing.assert_array_equal(got.temperature_c, [np.nan, 20.0, 20.0, 20.0, 30.0])
    assert 0x51 in decoder.accepted_addresses


def test_sign_unit_and_factor_are_applied(tmp_path: Path) -> None:
    path = tmp_path / "one.dbc"
    path.write_text(format_one_signal_dbc(0, 16, False, True, 1.0).replace("m/s^2", "counts"))
    frame = make_chunk(100, struct.pack("<h6x", 103))
    entry = {"signal": "M.S", "unit": "mg", "factor": -2.0}
    got = build(path, {"az": entry}).feed([frame])[0].values[0, 5]
    assert got == pytest.approx(-2.0 * 100.0 * 1e-3 * G0)
    negative = build("canmod_gps", {"gz": "-ImuData.AngularRateZ"})
    positive = build("canmod_gps", {"gz": "ImuData.AngularRateZ"})
    wire = [make_chunk(9, bytes(range(8)))]
    assert negative.feed(wire)[0].values[0, 2] == -positive.feed(wire)[0].values[0, 2]


@pytest.mark.parametrize("unit", [b"\xb0/s", "°/s".encode()])
def test_degree_sign_is_read_in_both_encodings(tmp_path: Path, unit: bytes) -> None:
    path = tmp_path / "one.dbc"
    path.write_bytes(format_one_signal_dbc(0, 16, False, True, 1.0).encode().replace(b"m/s^2", unit))
    got = build(path, {"gz": "M.S"}).feed([make_chunk(100, struct.pack("<h6x", 13))])
    assert got[0].values[0, 2] == pytest.approx(10.0 * DEGREE)


# --- joining frames of a sample -------------------------------------------------------------------------------------


def make_frame_pairs(n: int) -> list[Chunk]:
    """Return alternating frames of rates and accelerations, 10 ms per sample, the second 1 ms after the first.

    The raw values of the roll rate and of the vertical acceleration contain the number of the sample.
    """
    frames = []
    for i in range(n):
        frames.append(make_chunk(RATE_ID, struct.pack("<4H", 32000, 32000 + i, 32000, 0), 10_000_000 * i))
        frames.append(make_chunk(ACCEL_ID, struct.pack("<4H", 32000, 32000, 32000 + i, 0), 10_000_000 * i + 1_000_000))
    return frames


def read_sample_numbers(blocks: list[SampleBlock]) -> list[tuple[int, int]]:
    """Return the number of each sample of ``make_frame_pairs``, from its rate and from its acceleration."""
    if not blocks:
        return []
    values = concatenate_blocks(blocks).values
    rates = np.rint(values[:, 0] / DEGREE * 128).astype(int)
    return list(zip(rates.tolist(), np.rint(values[:, 5] * 100).astype(int).tolist(), strict=True))


def test_sample_with_a_missing_frame_counts_as_lost() -> None:
    decoder = build("j1939_imu", SAE_SIGNALS)
    frames = make_frame_pairs(6)
    del frames[5]  # acceleration of sample 2
    blocks = decoder.feed(frames)
    assert read_sample_numbers(blocks) == [(0, 0), (1, 1), (3, 3), (4, 4), (5, 5)]
    assert [(len(b), b.lost) for b in blocks] == [(2, 0), (3, 1)]
    assert decoder.bad == 1


def test_window_prevents_joining_frames_of_different_samples() -> None:
    frames = make_frame_pairs(6)
    del frames[4]  # rate of sample 2; its acceleration must not be joined with the rate of sample 3
    decoder = build("j1939_imu", SAE_SIGNALS, window=0.005)
    assert read_sample_numbers(decoder.feed(frames)) == [(0, 0), (1, 1), (3, 3), (4, 4), (5, 5)]
    assert decoder.bad == 1


LATE_FRAME_HINT = (
    "frames of one sample arrive 8 ms apart, more than window = 0.005 s: increase `window` in decoder_options"
)


def make_frames_with_delays(n: int, late: list[int], period_ms: int) -> list[Chunk]:
    """Return frames as ``make_frame_pairs``, with 8 ms between the two frames of the samples ``late``."""
    frames = []
    for i, (rate, acceleration) in enumerate(zip(make_frame_pairs(n)[::2], make_frame_pairs(n)[1::2], strict=True)):
        t_ns = i * period_ms * 1_000_000
        frames.append(Chunk(rate.data, t_ns, RATE_ID))
        frames.append(Chunk(acceleration.data, t_ns + (8_000_000 if i in late else 1_000_000), ACCEL_ID))
    return frames


def list_sample_numbers(n: int, without: list[int]) -> list[tuple[int, int]]:
    """Return the result of ``read_sample_numbers`` for n samples, of which some are missing."""
    return [(i, i) for i in range(n) if i not in without]


@pytest.mark.parametrize(
    ("period_ms", "late"),
    [(10, [3]), (10, [3, 4, 7]), (10, [0]), (10, [9]), (20, [3]), (20, [0, 1, 2]), (20, [7, 8, 9])],
)
def test_sample_with_a_late_frame_counts_as_late_and_not_as_bad(period_ms: int, late: list[int]) -> None:
    decoder = build("j1939_imu", SAE_SIGNALS, window=0.005)
    frames = make_frames_with_delays(10, late, period_ms)
    blocks = decoder.feed(frames)
    assert read_sample_numbers(blocks) == list_sample_numbers(10, late)
    assert (decoder.dropped_late_samples, decoder.bad) == (len(late), 0)
    # a late sample counts as lost when a good one follows
    assert sum(b.lost for b in blocks) == len([i for i in late if i < read_sample_numbers(blocks)[-1][0]])
    assert decoder.recent_problem == LATE_FRAME_HINT
    single = build("j1939_imu", SAE_SIGNALS, window=0.005)
    assert read_sample_numbers([b for frame in frames for b in single.feed([frame])]) == list_sample_numbers(10, late)
    assert (single.dropped_late_samples, single.bad, single.recent_problem) == (len(late), 0, LATE_FRAME_HINT)


def test_late_samples_are_counted_even_if_no_sample_is_complete() -> None:
    decoder = build("j1939_imu", SAE_SIGNALS, window=0.005)
    assert decoder.feed(make_frames_with_delays(10, list(range(10)), 20)) == []
    assert (decoder.dropped_late_samples, decoder.bad, decoder.recent_problem) == (10, 0, LATE_FRAME_HINT)
    # the first sample is incomplete and not counted
    decoder = build("j1939_imu", SAE_SIGNALS, window=0.005)
    assert decoder.feed(make_frames_with_delays(10, list(range(10)), 20)[1:]) == []
    assert (decoder.dropped_late_samples, decoder.bad, decoder.recent_problem) == (9, 0, LATE_FRAME_HINT)


def test_late_and_missing_frames_are_counted_separately() -> None:
    frames = make_frames_with_delays(12, [3, 6], 10)
    del frames[21]  # acceleration of sample 10
    del frames[10]  # rate of sample 5
    del frames[9]  # acceleration of sample 4, so that two consecutive frames are missing
    decoder = build("j1939_imu", SAE_SIGNALS, window=0.005)
    blocks = decoder.feed(frames)
    assert read_sample_numbers(blocks) == list_sample_numbers(12, [3, 4, 5, 6, 10])
    assert (decoder.dropped_late_samples, decoder.bad) == (2, 3)
    assert [(len(b), b.lost) for b in blocks] == [(3, 0), (3, 4), (1, 1)]


def test_late_frame_that_is_too_short_makes_its_sample_bad() -> None:
    frames = make_frames_with_delays(6, [3], 20)
    frames[7] = Chunk(b"", frames[7].t_ns, ACCEL_ID)
    decoder = build("j1939_imu", SAE_SIGNALS, window=0.005)
    assert read_sample_numbers(decoder.feed(frames)) == list_sample_numbers(6, [3])
    assert (decoder.dropped_late_samples, decoder.bad) == (0, 1)


def test_partial_sample_is_kept_without_its_late_frame() -> None:
    decoder = build("j1939_imu", SAE_SIGNALS, window=0.005, partial=True)
    got = concatenate_blocks(decoder.feed(make_frames_with_delays(6, [3], 10)))
    assert np.isnan(got.values).all(axis=1).tolist() == [False] * 6
    assert np.isnan(got.values[:, 3:]).all(axis=1).tolist() == [i == 3 for i in range(6)]
    assert (decoder.dropped_late_samples, decoder.bad, decoder.recent_problem) == (0, 0, LATE_FRAME_HINT)


def test_hint_disappears_after_a_period_without_late_frames() -> None:
    decoder = build("j1939_imu", SAE_SIGNALS, window=0.005)
    decoder.feed(make_frames_with_delays(10, [3], 10))
    assert decoder.recent_problem == LATE_FRAME_HINT
    decoder.feed(
        [Chunk(late.data, late.t_ns + 1_000_000_000, late.address) for late in make_frames_with_delays(1100, [], 10)]
    )
    assert decoder.recent_problem == ""


def test_stream_that_starts_inside_a_sample_loses_nothing() -> None:
    decoder = build("j1939_imu", SAE_SIGNALS, window=0.005)
    blocks = decoder.feed(make_frame_pairs(4)[1:])
    assert read_sample_numbers(blocks) == [(1, 1), (2, 2), (3, 3)]
    assert (decoder.bad, blocks[0].lost) == (0, 0)


def test_partial_sample_keeps_the_received_axes() -> None:
    decoder = build("j1939_imu", SAE_SIGNALS, partial=True)
    frames = make_frame_pairs(4)
    del frames[3]
    got = concatenate_blocks(decoder.feed(frames))
    assert len(got) == 4
    assert np.isnan(got.values[1]).tolist() == [False] * 3 + [True] * 3
    assert decoder.bad == 0


def test_short_frame_is_bad() -> None:
    decoder = build("canmod_gps", CANMOD_SIGNALS)
    good = make_chunk(9, "f9fb8f4aff093080")
    blocks = decoder.feed([good, make_chunk(9, "f9fb8f"), make_chunk(9, ""), good])
    assert [(len(b), b.lost) for b in blocks] == [(1, 0), (1, 2)]
    assert decoder.bad == 2
    assert "ImuData" in decoder.recent_problem


def test_sample_that_is_marked_invalid_is_bad() -> None:
    decoder = build("canmod_gps", CANMOD_SIGNALS, valid="ImuData.ImuValid")
    blocks = decoder.feed([make_chunk(9, "f9fb8f4aff093080"), make_chunk(9, "f8fb8f4aff093080")] * 2)
    assert [(len(b), b.lost) for b in blocks] == [(1, 0), (1, 1)]
    assert decoder.bad == 2
    assert "ImuValid" in decoder.recent_problem


DATABASE_WITH_COUNTERS = """VERSION ""

BU_: X

BO_ 1 Gyro: 8 X
 SG_ Count : 56|4@1+ (1,0) [0|15] "" X
 SG_ Z : 0|16@1- (1,0) [0|0] "mdeg/s" X

BO_ 2 Accel: 8 X
 SG_ Count : 56|4@1+ (1,0) [0|15] "" X
 SG_ Z : 0|16@1- (1,0) [0|0] "mm/s^2" X
"""


DATABASE_IN_SI = """VERSION ""

BU_: X

BO_ 1 Imu: 12 X
 SG_ Gx : 0|16@1- (0.001,0) [0|0] "rad/s" X
 SG_ Gy : 16|16@1- (0.001,0) [0|0] "rad/s" X
 SG_ Gz : 32|16@1- (0.001,0) [0|0] "rad/s" X
 SG_ Ax : 48|16@1- (0.001,0) [0|0] "m/s^2" X
 SG_ Ay : 64|16@1- (0.001,0) [0|0] "m/s^2" X
 SG_ Az : 80|16@1- (0.001,0) [0|0] "m/s^2" X
"""


def test_frames_that_contradict_the_unit_in_the_database_are_rejected(tmp_path: Path) -> None:
    """The database says m/s² or g, and the sensor sends m/s²."""
    path = tmp_path / "imu.dbc"
    path.write_text(DATABASE_IN_SI)
    signals: dict[str, Any] = {axis: f"Imu.{axis.title()}" for axis in AXES}
    counts = np.rint(np.random.default_rng(1).normal(size=(1250, 6)) * 20.0 + [9, 0, 0, 0, 0, 9810]).astype("<i2")
    frames = [make_chunk(1, row.tobytes(), 20_000_000 * i) for i, row in enumerate(counts)]
    right = build(path, signals)
    assert sum(len(block) for frame in frames for block in right.feed([frame])) == 1250
    assert right.recent_problem == ""
    signals |= {axis: {"signal": signals[axis], "unit": "g"} for axis in AXES[3:]}
    wrong = build(path, signals)
    assert sum(len(block) for frame in frames for block in wrong.feed([frame])) < 1100
    assert wrong.recent_problem == (
        "the accelerometer measures 96.19 m/s² instead of gravity (9.81 m/s²): "
        'set unit = "m/s²" for ax ay az in `signals`'
    )
    assert wrong.bad > 150


def test_frames_with_equal_counters_form_a_sample(tmp_path: Path) -> None:
    path = tmp_path / "counted.dbc"
    path.write_text(DATABASE_WITH_COUNTERS)
    signals = {"gz": "Gyro.Z", "az": "Accel.Z"}
    decoder = build(path, signals, counter="Count", join="counter")
    assert decoder.timing == CounterTimedFormat(16, None)
    frames = [make_chunk(1 + which, struct.pack("<h5xB", i, i % 16), i) for i in range(40) for which in (0, 1)]
    del frames[21]  # Accel 10
    del frames[9]  # Accel 4; in addition, the two frames of a sample are exchanged
    frames[30], frames[31] = frames[31], frames[30]
    blocks = decoder.feed(frames)
    got = concatenate_blocks(blocks)
    ids = np.rint(got.values[:, 2] / DEGREE * 1e3).astype(int)
    assert ids.tolist() == [i for i in range(40) if i not in (4, 10)]
    assert np.rint(got.values[:, 5] * 1e3).astype(int).tolist() == ids.tolist()
    assert (got.ticks == ids % 16).all()
    assert decoder.bad == 2


def test_frame_after_the_start_of_the_next_sample_does_not_end_that_sample(tmp_path: Path) -> None:
    path = tmp_path / "counted.dbc"
    path.write_text(DATABASE_WITH_COUNTERS)
    decoder = build(path, {"gz": "Gyro.Z", "az": "Accel.Z"}, counter="Count", join="counter")
    frames = [make_chunk(1 + which, struct.pack("<h5xB", i, i % 16), i) for i in range(10) for which in (0, 1)]
    frames[9], frames[10] = frames[10], frames[9]  # Accel 4 comes after Gyro 5
    got = concatenate_blocks(decoder.feed(frames))
    assert got.ticks.tolist() == [0, 1, 2, 3, 5, 6, 7, 8, 9]
    assert (decoder.bad, got.lost) == (1, 1)


def test_frame_with_a_matching_counter_is_late_after_the_window(tmp_path: Path) -> None:
    path = tmp_path / "counted.dbc"
    path.write_text(DATABASE_WITH_COUNTERS)
    decoder = build(path, {"gz": "Gyro.Z", "az": "Accel.Z"}, counter="Count", join="counter", window=0.005)
    frames = [
        make_chunk(
            1 + which, struct.pack("<h5xB", i, i % 16), i * 10_000_000 + which * (8_000_000 if i == 4 else 1_000_000)
        )
        for i in range(10)
        for which in (0, 1)
    ]
    got = concatenate_blocks(decoder.feed(frames))
    assert got.ticks.tolist() == [0, 1, 2, 3, 5, 6, 7, 8, 9]
    assert (decoder.dropped_late_samples, decoder.bad, got.lost, decoder.recent_problem) == (1, 0, 1, LATE_FRAME_HINT)


def test_counter_message_starts_a_sample() -> None:
    keys: dict[str, Any] = {"counter": "SampleTime.SampleTimeFine", "tick": 1e-4}
    decoder = build("xsens_mti", XSENS_SIGNALS, **keys)
    sent = make_samples(6)
    chunks = decoder.encode(sent)
    assert [c.address for c in chunks[:3]] == [5, 0x32, 0x34]
    # the stream starts after the first time frame, and another time frame is missing later
    got = concatenate_blocks(decoder.feed(chunks[1:9] + chunks[10:]))
    assert got.ticks.tolist() == [101, 102, 104, 105]
    assert (np.abs(got.values - sent.values[[1, 2, 4, 5]]) < 2**-8).all()
    assert decoder.bad == 1


def test_only_one_sender_is_decoded() -> None:
    decoder = build("j1939_imu", {"gz": SAE_SIGNALS["gz"]})
    frame = "007D007D00820005"
    other = 0x0CF02A81 | EXTENDED_ID
    assert (
        len(
            concatenate_blocks(
                decoder.feed([make_chunk(RATE_ID, frame), make_chunk(other, frame), make_chunk(RATE_ID, frame)])
            )
        )
        == 2
    )
    assert "0x81" in decoder.recent_problem
    chosen = build("j1939_imu", {"gz": SAE_SIGNALS["gz"]}, source=0x81)
    assert len(chosen.feed([make_chunk(RATE_ID, frame), make_chunk(other, frame)])) == 1
    assert chosen.recent_problem == ""


def test_decoder_lists_the_addresses_of_its_messages() -> None:
    assert build("canmod_gps", CANMOD_SIGNALS).accepted_addresses == (9,)
    wanted = (0x0CF02AFE | EXTENDED_ID | ANY_SOURCE, 0x0CF02DFE | EXTENDED_ID | ANY_SOURCE)
    assert build("j1939_imu", SAE_SIGNALS).accepted_addresses == wanted
    exact = build("j1939_imu", SAE_SIGNALS, j1939=False)
    assert exact.accepted_addresses == (0x0CF02AFE | EXTENDED_ID, 0x0CF02DFE | EXTENDED_ID)
    assert exact.feed([make_chunk(RATE_ID, "007D007D007D0005")]) == []
    assert isinstance(exact.timing, ArrivalTimedFormat)


def test_reset_discards_an_incomplete_sample() -> None:
    decoder = build("j1939_imu", SAE_SIGNALS)
    frames = make_frame_pairs(2)
    decoder.feed(frames[:1])
    decoder.forget_stream_state()
    assert read_sample_numbers(decoder.feed([frames[3], frames[2]])) == [(1, 1)]
    assert decoder.bad == 0


@given(
    st.lists(
        st.tuples(
            st.sampled_from([RATE_ID, ACCEL_ID, 0x0CF02A81 | EXTENDED_ID, 9, 0x18F02A00 | EXTENDED_ID])
            | st.integers(0, 2**32 - 1),
            st.binary(max_size=64),
        ),
        max_size=60,
    )
)
def test_noise_raises_no_error(frames: list[tuple[int, bytes]]) -> None:
    decoder = DECODERS[0]
    decoder.forget_stream_state()
    before = decoder.bad
    for got in decoder.feed([make_chunk(a, d, i) for i, (a, d) in enumerate(frames)]):
        assert len(got) >= 1
        assert np.isfinite(got.values).any(axis=1).all()
    assert decoder.bad >= before


DECODERS = [build("j1939_imu", SAE_SIGNALS, partial=True)]


# --- wrong settings -------------------------------------------------------------


@pytest.mark.parametrize(
    ("file", "signals", "keys", "problem"),
    [
        ("canmod_gsp", CANMOD_SIGNALS, {}, 'did you mean "canmod_gps"'),
        ("/nonesuch/x.dbc", CANMOD_SIGNALS, {}, "cannot be read"),
        ("canmod_gps", {"gz": "ImuDat.AngularRateZ"}, {}, 'did you mean "ImuData"'),
        ("canmod_gps", {"gz": "ImuData.AngularRatZ"}, {}, "did you mean"),
        ("canmod_gps", {"gz": "AngularRateZ"}, {}, "Message.Signal"),
        ("canmod_gps", {"gw": "ImuData.AngularRateZ"}, {}, "signals.gw: .* possible are gx, "),
        ("canmod_gps", {"gz": "ImuData.ImuValid"}, {}, "unit"),
        ("canmod_gps", {"gz": "ImuData.AccelerationZ"}, {}, "angular rate"),
        ("canmod_gps", {"gz": {"signal": "ImuData.AngularRateZ", "unit": "deg/d"}}, {}, "deg/d"),
        ("canmod_gps", {"gz": {"signal": "ImuData.AngularRateZ", "factor": 0.0}}, {}, "factor"),
        ("canmod_gps", {}, {}, "signals: empty"),
        ("xsens_mti", {"temperature": "Temperature.SensorTemperature"}, {}, "temperature"),
        ("canmod_gps", CANMOD_SIGNALS, {"valid": "ImuData.Valid"}, "valid"),
        ("canmod_gps", CANMOD_SIGNALS, {"join": "counter"}, "needs counter"),
        ("canmod_gps", CANMOD_SIGNALS, {"counter": "ImuData.Count"}, "counter"),
        ("canmod_gps", CANMOD_SIGNALS, {"tick": 0.0}, "tick"),
        ("canmod_gps", CANMOD_SIGNALS, {"window": -1.0}, "window"),
        ("j1939_imu", SAE_SIGNALS, {"source": 256}, "source"),
    ],
)
def test_wrong_settings_are_refused(file: str, signals: dict[str, Any], keys: dict[str, Any], problem: str) -> None:
    with pytest.raises(ConfigError, match=problem) as raised:
        build(file, signals, **keys)
    assert "\n" not in str(raised.value)


def test_file_that_is_no_database_is_refused(tmp_path: Path) -> None:
    for name in ("a.dbc", "a.kcd", "a.xyz"):
        path = tmp_path / name
        path.write_bytes(b"\x00\xff this is \n none")
        with pytest.raises(ConfigError, match="no CAN database") as raised:
            build(path, CANMOD_SIGNALS)
        assert "\n" not in str(raised.value)


def test_multiplexed_signals_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "mux.dbc"
    text = 'VERSION ""\n\nBU_: X\n\nBO_ 1 M: 8 X\n SG_ Page M : 0|8@1+ (1,0) [0|0] "" X\n'
    path.write_text(text + ' SG_ S m1 : 8|16@1- (1,0) [0|0] "g" X\n')
    with pytest.raises(ConfigError, match="multiplexed"):
        build(path, {"ax": "M.S"})


# --- recordings ----------------------------------------------------------------------------------


@pytest.mark.data
@pytest.mark.parametrize("name", ["can-boat/moored-5min", "can-car/drive-a", "can-car/drive-b"])
def test_recorded_frames_give_the_recorded_samples(name: str) -> None:
    folder = recordings()
    recorded = np.load(folder / f"{name}.npz")
    expected = np.column_stack([recorded[axis] for axis in AXES])
    path = str(folder / f"{name}-frames.csv.gz")
    link = replay_link.build(replay_link.Settings(path=path, speed="max"))
    decoder = build("canmod_gps", CANMOD_SIGNALS, valid="ImuData.ImuValid")
    lenient = build("canmod_gps", CANMOD_SIGNALS)
    blocks: list[SampleBlock] = []
    lenient_blocks: list[SampleBlock] = []
    link.open()
    ended = False
    while not ended:
        try:
            chunks = link.wait_for_chunks_or_timeout(1.0) or []
        except LinkEnded:
            ended = True
        else:
            blocks += decoder.feed(chunks)
            lenient_blocks += lenient.feed(chunks)
    link.close()
    all_samples = concatenate_blocks(lenient_blocks)
    half_a_bit = np.repeat([0.125 * DEGREE, 0.0625], 3)
    assert all_samples.values.shape == expected.shape
    assert (np.abs(all_samples.values - expected) < half_a_bit).all()
    np.testing.assert_allclose(all_samples.t_ns * 1e-9, recorded["t"], atol=1e-6)
    # each row that the sensor marks as invalid is counted
    assert sum(len(b) + b.lost for b in blocks) == len(expected)
    assert decoder.bad == len(expected) - sum(len(b) for b in blocks)
