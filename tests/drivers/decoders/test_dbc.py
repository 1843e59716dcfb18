"""DBC: cantools as the independent judge of every bit, golden frames, joining, and real recordings."""

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

CANMOD = {f"g{c}": f"ImuData.AngularRate{c.upper()}" for c in "xyz"} | {
    f"a{c}": f"ImuData.Acceleration{c.upper()}" for c in "xyz"
}
SAE = {
    "gx": "AngularRateInformation.RollRate",
    "gy": "AngularRateInformation.PitchRate",
    "gz": "AngularRateInformation.YawRate",
    "ax": "AccelerationSensor.LongitudinalAcceleration",
    "ay": "AccelerationSensor.LateralAcceleration",
    "az": "AccelerationSensor.VerticalAcceleration",
}
XSENS = {f"g{c}": f"RateOfTurn.Rate{c.upper()}" for c in "xyz"} | {
    f"a{c}": f"Acceleration.Acceleration{c.upper()}" for c in "xyz"
}
BOSCH = {
    "gz": "Mm7Frame1.YawRate",
    "ay": "Mm7Frame1.AccelerationY",
    "gx": "Mm7Frame2.RollRate",
    "ax": "Mm7Frame2.AccelerationX",
    "gy": "Mm7Frame3.PitchRate",
    "az": "Mm7Frame3.AccelerationZ",
}
ARI, ACCS = 0x0CF02AE2 | EXTENDED_ID, 0x0CF02DE2 | EXTENDED_ID


def build(file: str | Path, signals: dict[str, Any], **keys: Any) -> dbc.DbcDecoder:
    made = dbc.build(read_settings(dbc.Settings, {"file": str(file), "signals": signals, **keys}))
    assert isinstance(made, dbc.DbcDecoder)
    return made


def chunk(address: int, data: str | bytes, t_ns: int = 0) -> Chunk:
    return Chunk(bytes.fromhex(data) if isinstance(data, str) else data, t_ns, address)


# --- golden frames (SAE J1939 devices, Xsens, Bosch) ---------------------------------------------


def test_honeywell_frames() -> None:
    decoder = build("j1939_imu", SAE)
    got = decoder.feed([chunk(ARI, "007D007D007D0005", 5), chunk(ACCS, "007D007DD5800005", 7)])
    assert got[0].values[0] == pytest.approx([0, 0, 0, 0, 0, 9.81], abs=1e-9)
    assert got[0].t_ns.tolist() == [7]


def test_axis_order_of_sae_and_of_xyz_devices() -> None:
    frame = chunk(0x0CF02A80 | EXTENDED_ID, "C07DE07B00820005")
    sae = build("j1939_imu", {a: SAE[a] for a in ("gx", "gy", "gz")})
    assert sae.feed([frame])[0].values[0, :3] / DEGREE == pytest.approx([-2.25, 1.5, 10.0])
    xyz = build("j1939_imu_xyz", {f"g{c}": f"AngularRateInformation.Rate{c.upper()}" for c in "xyz"})
    assert xyz.feed([frame])[0].values[0, :3] / DEGREE == pytest.approx([1.5, -2.25, 10.0])


def test_not_available_is_not_measured() -> None:
    decoder = build("j1939_imu", {a: SAE[a] for a in ("gx", "gy", "gz")})
    largest = 0xFDFF / 128 - 250
    got = concatenate_blocks(decoder.feed([chunk(ARI, "FFFF007D00FE0005"), chunk(ARI, "FFFDFFFD00000005")]))
    assert got.values[0, :3] / DEGREE == pytest.approx([0.0, np.nan, np.nan], nan_ok=True)
    assert got.values[1, :3] / DEGREE == pytest.approx([largest, largest, -250.0])
    assert decoder.feed([chunk(ARI, "FFFFFFFFFFFFFFFF")]) == []
    assert decoder.bad == 1
    as_numbers = build("j1939_imu", {"gy": SAE["gy"]}, not_available=False)
    raw = as_numbers.feed([chunk(ARI, "FFFF007D00FE0005")])[0].values[0, 1]
    assert raw / DEGREE == pytest.approx(0xFFFF / 128 - 250)


def test_slope_of_the_shipped_database() -> None:
    database = cantools.database.load_file(SHIPPED / "j1939_imu.dbc")
    got = database.decode_message("SlopeSensorInformation2", bytes.fromhex("00A07D00C07C000A"))
    assert (got["PitchAngle"], got["RollAngle"], got["Latency"]) == pytest.approx((1.25, -0.5, 5.0))


def test_xsens_frames() -> None:
    signals = {**XSENS, "temperature": "Temperature.SensorTemperature"}
    decoder = build("xsens_mti", signals, counter="SampleTime.SampleTimeFine", tick=1e-4)
    assert decoder.timing == CounterTimedFormat(1 << 32, 1e-4)
    got = decoder.feed(
        [
            chunk(0x51, "1980"),
            chunk(0x5, "0000 04D2"),
            chunk(0x32, "0033 FF9A 001A"),
            chunk(0x34, "0080 FFC0 09CF"),
        ]
    )
    expected = [0.099609375, -0.19921875, 0.05078125, 0.5, -0.25, 9.80859375]
    assert got[0].values[0].tolist() == expected
    assert got[0].ticks.tolist() == [1234]
    assert got[0].temperature_c.tolist() == [25.5]


def test_bosch_frames() -> None:
    decoder = build("bosch_mm7", BOSCH)
    got = decoder.feed(
        [
            chunk(0x174, "D0870000A69E0000"),
            chunk(0x178, "0080000000800000"),
            chunk(0x17C, "0080000000800000"),
        ]
    )
    rates, forces = got[0].values[0, :3] / DEGREE, got[0].values[0, 3:] / G0
    assert rates == pytest.approx([0.0, 0.0, 10.0], abs=1e-9)
    assert forces == pytest.approx([-2.7e-5, 1.0000635, -2.7e-5], abs=1e-6)


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.dbc")), ids=lambda p: p.stem)
def test_shipped_databases_are_strictly_right(path: Path) -> None:
    """No overlaps, nothing outside its message."""
    assert cantools.database.load_file(path, strict=True).messages


# --- every bit, against cantools -----------------------------------------------------------------

KINDS = st.tuples(st.integers(1, 64), st.booleans(), st.booleans())


def one_signal_dbc(start: int, length: int, big: bool, signed: bool, scale: float, kind: int = 0) -> str:
    sign = "-" if signed else "+"
    text = f'VERSION ""\n\nBU_: X\n\nBO_ 100 M: 8 X\n SG_ S : {start}|{length}@{0 if big else 1}{sign} '
    text += f'({scale!r},-3) [0|0] "m/s^2" X\n\n'
    return text + (f"SIG_VALTYPE_ 100 S : {kind};\n" if kind else "")


@pytest.mark.long
@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(data=st.data(), kind=KINDS, frames=st.lists(st.binary(min_size=8, max_size=8), min_size=1, max_size=5))
def test_any_signal_decodes_as_cantools_says(
    tmp_path: Path, data: st.DataObject, kind: tuple[int, bool, bool], frames: list[bytes]
) -> None:
    length, big, signed = kind
    first = data.draw(st.integers(0, 64 - length))
    # a DBC numbers the most significant bit of Motorola signals, 7 … 0 within each byte
    start = 8 * (first // 8) + 7 - first % 8 if big else first
    path = tmp_path / "one.dbc"
    path.write_text(one_signal_dbc(start, length, big, signed, 0.5))
    message = cantools.database.load_file(path).get_message_by_name("M")
    bits = build(path, {"ax": "M.S"})._messages[0].columns[0].bits
    stacked = np.frombuffer(b"".join(frames), np.uint8).reshape(-1, 8)
    expected = [message.decode(f)["S"] for f in frames]
    np.testing.assert_allclose(bits.extract_values(stacked), expected, rtol=1e-15)
    # writing the raw numbers into other frames touches these bits and no other
    there = np.full_like(stacked, 0xA5)
    bits.insert_raw(there, bits.extract_raw(stacked))
    np.testing.assert_array_equal(bits.extract_raw(there), bits.extract_raw(stacked))
    mask = np.zeros_like(stacked)
    bits.insert_raw(mask, np.full(len(mask), (1 << length) - 1, np.uint64))
    np.testing.assert_array_equal(there & ~mask, np.full_like(there, 0xA5) & ~mask)


@pytest.mark.parametrize(("length", "kind", "code"), [(32, 1, "f"), (64, 2, "d")])
@pytest.mark.parametrize("big", [False, True])
def test_floats_on_the_wire(tmp_path: Path, length: int, kind: int, code: str, big: bool) -> None:
    path = tmp_path / "float.dbc"
    path.write_text(one_signal_dbc(7 if big else 0, length, big, True, 1.0, kind))
    decoder = build(path, {"ax": "M.S"})
    wire = struct.pack((">" if big else "<") + code, 12.75).ljust(8, b"\0")
    assert decoder.feed([chunk(100, wire)])[0].values[0, 3] == 9.75
    [sent] = decoder.encode(make_block(np.zeros(1, np.int64), np.full((1, 6), 9.75)))
    assert sent.data == wire
    nan = struct.pack((">" if big else "<") + code, np.nan).ljust(8, b"\0")
    assert decoder.feed([chunk(100, nan)]) == []


@given(st.integers(1, 64), st.booleans(), st.floats(-1e30, 1e30))
def test_what_does_not_fit_is_limited(length: int, signed: bool, value: float) -> None:
    bits = SignalCodec(0, length, False, signed, False, 1.0, 0.0, False)
    frames = np.zeros((1, 8), np.uint8)
    bits.insert_values(frames, np.array([value]))
    low = -(2 ** (length - 1)) if signed else 0
    high = low + 2**length - 1
    limited = min(max(value, low), high)
    assert bits.extract_values(frames)[0] == pytest.approx(limited, rel=1e-15, abs=0.5)


# --- there and back ------------------------------------------------------------------------------

CASES: list[tuple[str, dict[str, str], dict[str, Any], list[float]]] = [
    ("canmod_gps", CANMOD, {"valid": "ImuData.ImuValid"}, [0.25 * DEGREE] * 3 + [0.125] * 3),
    ("j1939_imu", SAE, {}, [DEGREE / 128] * 3 + [0.01] * 3),
    ("xsens_mti", XSENS, {"counter": "SampleTime.SampleTimeFine", "tick": 1e-4}, [2**-9] * 3 + [2**-8] * 3),
    ("xsens_mti", XSENS, {"counter": "GroupCounter.Counter", "join": "counter"}, [2**-9] * 3 + [2**-8] * 3),
    ("bosch_mm7", BOSCH, {}, [0.005 * DEGREE] * 3 + [0.000127465 * G0] * 3),
]


def some(n: int, seed: int = 0) -> SampleBlock:
    rng = np.random.default_rng(seed)
    values = rng.uniform(-1, 1, (n, 6)) * [2, 2, 2, 30, 30, 30]
    ticks = np.arange(100, 100 + n)
    return make_block(np.arange(n) * 10_000_000, values, rng.uniform(0, 50, n), ticks)


@pytest.mark.parametrize(("file", "signals", "keys", "lsb"), CASES)
def test_encoded_samples_come_back_to_half_a_bit(
    file: str, signals: dict[str, str], keys: dict[str, Any], lsb: list[float]
) -> None:
    decoder = build(file, signals, **keys)
    sent = some(300)
    chunks = decoder.encode(sent)
    got = concatenate_blocks(decoder.feed(chunks))
    assert (np.abs(got.values - sent.values) <= 0.5001 * np.array(lsb)).all()
    np.testing.assert_array_equal(got.t_ns, sent.t_ns)
    np.testing.assert_array_equal(got.ticks, sent.ticks if "counter" in keys else np.full(300, NO_TICK))
    assert (decoder.bad, got.lost, decoder.recent_problem) == (0, 0, "")
    # frame by frame is the same
    single = build(file, signals, **keys)
    one_by_one = concatenate_blocks([b for c in chunks for b in single.feed([c])])
    np.testing.assert_array_equal(one_by_one.values, got.values)


def test_temperature_may_be_slower_than_the_samples() -> None:
    decoder = build("xsens_mti", {**XSENS, "temperature": "Temperature.SensorTemperature"})
    temperature = np.array([np.nan, 20.0, np.nan, np.nan, 30.0])
    sent = make_block(np.arange(5), some(5).values.copy(), temperature)
    got = concatenate_blocks(decoder.feed(decoder.encode(sent)))
    np.testing.assert_array_equal(got.temperature_c, [np.nan, 20.0, 20.0, 20.0, 30.0])
    assert 0x51 in decoder.addresses


def test_signs_units_and_factors(tmp_path: Path) -> None:
    path = tmp_path / "one.dbc"
    path.write_text(one_signal_dbc(0, 16, False, True, 1.0).replace("m/s^2", "counts"))
    frame = chunk(100, struct.pack("<h6x", 103))
    entry = {"signal": "M.S", "unit": "mg", "factor": -2.0}
    got = build(path, {"az": entry}).feed([frame])[0].values[0, 5]
    assert got == pytest.approx(-2.0 * 100.0 * 1e-3 * G0)
    negative = build("canmod_gps", {"gz": "-ImuData.AngularRateZ"})
    positive = build("canmod_gps", {"gz": "ImuData.AngularRateZ"})
    wire = [chunk(9, bytes(range(8)))]
    assert negative.feed(wire)[0].values[0, 2] == -positive.feed(wire)[0].values[0, 2]


@pytest.mark.parametrize("unit", [b"\xb0/s", "°/s".encode()])
def test_degree_signs_of_either_encoding(tmp_path: Path, unit: bytes) -> None:
    path = tmp_path / "one.dbc"
    path.write_bytes(one_signal_dbc(0, 16, False, True, 1.0).encode().replace(b"m/s^2", unit))
    got = build(path, {"gz": "M.S"}).feed([chunk(100, struct.pack("<h6x", 13))])
    assert got[0].values[0, 2] == pytest.approx(10.0 * DEGREE)


# --- joining -------------------------------------------------------------------------------------


def pairs(n: int) -> list[Chunk]:
    """ARI and ACCS in turn, 10 ms a sample, ACCS 1 ms later; roll rate and vertical count up."""
    frames = []
    for i in range(n):
        frames.append(chunk(ARI, struct.pack("<4H", 32000, 32000 + i, 32000, 0), 10_000_000 * i))
        frames.append(chunk(ACCS, struct.pack("<4H", 32000, 32000, 32000 + i, 0), 10_000_000 * i + 1_000_000))
    return frames


def counts(blocks: list[SampleBlock]) -> list[tuple[int, int]]:
    """What ``pairs`` counted, as (rate, acceleration) of each sample."""
    if not blocks:
        return []
    values = concatenate_blocks(blocks).values
    rates = np.rint(values[:, 0] / DEGREE * 128).astype(int)
    return list(zip(rates.tolist(), np.rint(values[:, 5] * 100).astype(int).tolist(), strict=True))


def test_a_missing_frame_costs_its_sample_and_leaves_its_place_empty() -> None:
    decoder = build("j1939_imu", SAE)
    frames = pairs(6)
    del frames[5]  # ACCS of sample 2
    blocks = decoder.feed(frames)
    assert counts(blocks) == [(0, 0), (1, 1), (3, 3), (4, 4), (5, 5)]
    assert [(len(b), b.lost) for b in blocks] == [(2, 0), (3, 1)]
    assert decoder.bad == 1


def test_window_puts_joining_right_after_a_lost_first_frame() -> None:
    frames = pairs(6)
    del frames[4]  # ARI of sample 2: ACCS of sample 2 must not pair with ARI of sample 3
    decoder = build("j1939_imu", SAE, window=0.005)
    assert counts(decoder.feed(frames)) == [(0, 0), (1, 1), (3, 3), (4, 4), (5, 5)]
    assert decoder.bad == 1


HINT = "frames of one sample arrive 8 ms apart, more than window = 0.005 s: increase `window` in decoder_options"


def delayed(n: int, late: list[int], period_ms: int) -> list[Chunk]:
    """As ``pairs``; ACCS comes 8 ms after ARI in the late samples and 1 ms after it in the others."""
    frames = []
    for i, (rate, acceleration) in enumerate(zip(pairs(n)[::2], pairs(n)[1::2], strict=True)):
        t_ns = i * period_ms * 1_000_000
        frames.append(Chunk(rate.data, t_ns, ARI))
        frames.append(Chunk(acceleration.data, t_ns + (8_000_000 if i in late else 1_000_000), ACCS))
    return frames


def whole(n: int, without: list[int]) -> list[tuple[int, int]]:
    return [(i, i) for i in range(n) if i not in without]


@pytest.mark.parametrize(
    ("period_ms", "late"),
    [(10, [3]), (10, [3, 4, 7]), (10, [0]), (10, [9]), (20, [3]), (20, [0, 1, 2]), (20, [7, 8, 9])],
)
def test_a_late_frame_makes_its_sample_late_and_not_bad(period_ms: int, late: list[int]) -> None:
    decoder = build("j1939_imu", SAE, window=0.005)
    frames = delayed(10, late, period_ms)
    blocks = decoder.feed(frames)
    assert counts(blocks) == whole(10, late)
    assert (decoder.dropped_late_samples, decoder.bad) == (len(late), 0)
    assert sum(b.lost for b in blocks) == len([i for i in late if i < counts(blocks)[-1][0]])  # then a good one follows
    assert decoder.recent_problem == HINT
    single = build("j1939_imu", SAE, window=0.005)
    assert counts([b for frame in frames for b in single.feed([frame])]) == whole(10, late)
    assert (single.dropped_late_samples, single.bad, single.recent_problem) == (len(late), 0, HINT)


def test_samples_that_are_all_late_are_told_though_none_is_whole() -> None:
    decoder = build("j1939_imu", SAE, window=0.005)
    assert decoder.feed(delayed(10, list(range(10)), 20)) == []
    assert (decoder.dropped_late_samples, decoder.bad, decoder.recent_problem) == (10, 0, HINT)
    # joined in the middle of a sample, which is not counted
    decoder = build("j1939_imu", SAE, window=0.005)
    assert decoder.feed(delayed(10, list(range(10)), 20)[1:]) == []
    assert (decoder.dropped_late_samples, decoder.bad, decoder.recent_problem) == (9, 0, HINT)


def test_late_and_missing_frames_are_told_apart() -> None:
    frames = delayed(12, [3, 6], 10)
    del frames[21]  # ACCS of sample 10
    del frames[10]  # ARI of sample 5
    del frames[9]  # ACCS of sample 4, so that two frames in a row are missing
    decoder = build("j1939_imu", SAE, window=0.005)
    blocks = decoder.feed(frames)
    assert counts(blocks) == whole(12, [3, 4, 5, 6, 10])
    assert (decoder.dropped_late_samples, decoder.bad) == (2, 3)
    assert [(len(b), b.lost) for b in blocks] == [(3, 0), (3, 4), (1, 1)]


def test_a_late_frame_that_is_too_short_makes_its_sample_bad() -> None:
    frames = delayed(6, [3], 20)
    frames[7] = Chunk(b"", frames[7].t_ns, ACCS)
    decoder = build("j1939_imu", SAE, window=0.005)
    assert counts(decoder.feed(frames)) == whole(6, [3])
    assert (decoder.dropped_late_samples, decoder.bad) == (0, 1)


def test_a_partial_sample_is_kept_without_its_late_frame() -> None:
    decoder = build("j1939_imu", SAE, window=0.005, partial=True)
    got = concatenate_blocks(decoder.feed(delayed(6, [3], 10)))
    assert np.isnan(got.values).all(axis=1).tolist() == [False] * 6
    assert np.isnan(got.values[:, 3:]).all(axis=1).tolist() == [i == 3 for i in range(6)]
    assert (decoder.dropped_late_samples, decoder.bad, decoder.recent_problem) == (0, 0, HINT)


def test_the_hint_goes_when_no_frame_has_been_late_for_a_while() -> None:
    decoder = build("j1939_imu", SAE, window=0.005)
    decoder.feed(delayed(10, [3], 10))
    assert decoder.recent_problem == HINT
    decoder.feed([Chunk(c.data, c.t_ns + 1_000_000_000, c.address) for c in delayed(1100, [], 10)])
    assert decoder.recent_problem == ""


def test_joining_mid_stream_is_no_loss() -> None:
    decoder = build("j1939_imu", SAE, window=0.005)
    blocks = decoder.feed(pairs(4)[1:])
    assert counts(blocks) == [(1, 1), (2, 2), (3, 3)]
    assert (decoder.bad, blocks[0].lost) == (0, 0)


def test_partial_samples_keep_what_came() -> None:
    decoder = build("j1939_imu", SAE, partial=True)
    frames = pairs(4)
    del frames[3]
    got = concatenate_blocks(decoder.feed(frames))
    assert len(got) == 4
    assert np.isnan(got.values[1]).tolist() == [False] * 3 + [True] * 3
    assert decoder.bad == 0


def test_a_short_frame_is_bad() -> None:
    decoder = build("canmod_gps", CANMOD)
    good = chunk(9, "f9fb8f4aff093080")
    blocks = decoder.feed([good, chunk(9, "f9fb8f"), chunk(9, ""), good])
    assert [(len(b), b.lost) for b in blocks] == [(1, 0), (1, 2)]
    assert decoder.bad == 2
    assert "ImuData" in decoder.recent_problem


def test_not_valid_is_bad() -> None:
    decoder = build("canmod_gps", CANMOD, valid="ImuData.ImuValid")
    blocks = decoder.feed([chunk(9, "f9fb8f4aff093080"), chunk(9, "f8fb8f4aff093080")] * 2)
    assert [(len(b), b.lost) for b in blocks] == [(1, 0), (1, 1)]
    assert decoder.bad == 2
    assert "ImuValid" in decoder.recent_problem


COUNTED = """VERSION ""

BU_: X

BO_ 1 Gyro: 8 X
 SG_ Count : 56|4@1+ (1,0) [0|15] "" X
 SG_ Z : 0|16@1- (1,0) [0|0] "mdeg/s" X

BO_ 2 Accel: 8 X
 SG_ Count : 56|4@1+ (1,0) [0|15] "" X
 SG_ Z : 0|16@1- (1,0) [0|0] "mm/s^2" X
"""


def test_frames_with_equal_counts_belong_together(tmp_path: Path) -> None:
    path = tmp_path / "counted.dbc"
    path.write_text(COUNTED)
    signals = {"gz": "Gyro.Z", "az": "Accel.Z"}
    decoder = build(path, signals, counter="Count", join="counter")
    assert decoder.timing == CounterTimedFormat(16, None)
    frames = [chunk(1 + which, struct.pack("<h5xB", i, i % 16), i) for i in range(40) for which in (0, 1)]
    del frames[21]  # Accel 10
    del frames[9]  # Accel 4 … and the order of the two does not matter
    frames[30], frames[31] = frames[31], frames[30]
    blocks = decoder.feed(frames)
    got = concatenate_blocks(blocks)
    ids = np.rint(got.values[:, 2] / DEGREE * 1e3).astype(int)
    assert ids.tolist() == [i for i in range(40) if i not in (4, 10)]
    assert np.rint(got.values[:, 5] * 1e3).astype(int).tolist() == ids.tolist()
    assert (got.ticks == ids % 16).all()
    assert decoder.bad == 2


def test_a_frame_behind_the_start_of_the_next_sample_does_not_end_that_sample(tmp_path: Path) -> None:
    path = tmp_path / "counted.dbc"
    path.write_text(COUNTED)
    decoder = build(path, {"gz": "Gyro.Z", "az": "Accel.Z"}, counter="Count", join="counter")
    frames = [chunk(1 + which, struct.pack("<h5xB", i, i % 16), i) for i in range(10) for which in (0, 1)]
    frames[9], frames[10] = frames[10], frames[9]  # Accel 4 behind Gyro 5
    got = concatenate_blocks(decoder.feed(frames))
    assert got.ticks.tolist() == [0, 1, 2, 3, 5, 6, 7, 8, 9]
    assert (decoder.bad, got.lost) == (1, 1)


def test_a_frame_with_the_count_of_its_sample_is_late_after_the_window(tmp_path: Path) -> None:
    path = tmp_path / "counted.dbc"
    path.write_text(COUNTED)
    decoder = build(path, {"gz": "Gyro.Z", "az": "Accel.Z"}, counter="Count", join="counter", window=0.005)
    frames = [
        chunk(1 + which, struct.pack("<h5xB", i, i % 16), i * 10_000_000 + which * (8_000_000 if i == 4 else 1_000_000))
        for i in range(10)
        for which in (0, 1)
    ]
    got = concatenate_blocks(decoder.feed(frames))
    assert got.ticks.tolist() == [0, 1, 2, 3, 5, 6, 7, 8, 9]
    assert (decoder.dropped_late_samples, decoder.bad, got.lost, decoder.recent_problem) == (1, 0, 1, HINT)


def test_a_counter_message_starts_the_sample() -> None:
    keys: dict[str, Any] = {"counter": "SampleTime.SampleTimeFine", "tick": 1e-4}
    decoder = build("xsens_mti", XSENS, **keys)
    sent = some(6)
    chunks = decoder.encode(sent)
    assert [c.address for c in chunks[:3]] == [5, 0x32, 0x34]
    # joined behind the first time, and a time frame lost later
    got = concatenate_blocks(decoder.feed(chunks[1:9] + chunks[10:]))
    assert got.ticks.tolist() == [101, 102, 104, 105]
    assert (np.abs(got.values - sent.values[[1, 2, 4, 5]]) < 2**-8).all()
    assert decoder.bad == 1


def test_one_sender_at_a_time() -> None:
    decoder = build("j1939_imu", {"gz": SAE["gz"]})
    frame = "007D007D00820005"
    other = 0x0CF02A81 | EXTENDED_ID
    assert len(concatenate_blocks(decoder.feed([chunk(ARI, frame), chunk(other, frame), chunk(ARI, frame)]))) == 2
    assert "0x81" in decoder.recent_problem
    chosen = build("j1939_imu", {"gz": SAE["gz"]}, source=0x81)
    assert len(chosen.feed([chunk(ARI, frame), chunk(other, frame)])) == 1
    assert chosen.recent_problem == ""


def test_addresses() -> None:
    assert build("canmod_gps", CANMOD).addresses == (9,)
    wanted = (0x0CF02AFE | EXTENDED_ID | ANY_SOURCE, 0x0CF02DFE | EXTENDED_ID | ANY_SOURCE)
    assert build("j1939_imu", SAE).addresses == wanted
    exact = build("j1939_imu", SAE, j1939=False)
    assert exact.addresses == (0x0CF02AFE | EXTENDED_ID, 0x0CF02DFE | EXTENDED_ID)
    assert exact.feed([chunk(ARI, "007D007D007D0005")]) == []
    assert isinstance(exact.timing, ArrivalTimedFormat)


def test_reset_forgets_a_half_sample() -> None:
    decoder = build("j1939_imu", SAE)
    frames = pairs(2)
    decoder.feed(frames[:1])
    decoder.forget_stream_state()
    assert counts(decoder.feed([frames[3], frames[2]])) == [(1, 1)]
    assert decoder.bad == 0


@given(
    st.lists(
        st.tuples(
            st.sampled_from([ARI, ACCS, 0x0CF02A81 | EXTENDED_ID, 9, 0x18F02A00 | EXTENDED_ID])
            | st.integers(0, 2**32 - 1),
            st.binary(max_size=64),
        ),
        max_size=60,
    )
)
def test_noise_raises_nothing(frames: list[tuple[int, bytes]]) -> None:
    decoder = DECODERS[0]
    decoder.forget_stream_state()
    before = decoder.bad
    for got in decoder.feed([chunk(a, d, i) for i, (a, d) in enumerate(frames)]):
        assert len(got) >= 1
        assert np.isfinite(got.values).any(axis=1).all()
    assert decoder.bad >= before


DECODERS = [build("j1939_imu", SAE, partial=True)]


# --- what is wrong with the settings -------------------------------------------------------------


@pytest.mark.parametrize(
    ("file", "signals", "keys", "says"),
    [
        ("canmod_gsp", CANMOD, {}, 'did you mean "canmod_gps"'),
        ("/nonesuch/x.dbc", CANMOD, {}, "cannot be read"),
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
        ("canmod_gps", CANMOD, {"valid": "ImuData.Valid"}, "valid"),
        ("canmod_gps", CANMOD, {"join": "counter"}, "needs counter"),
        ("canmod_gps", CANMOD, {"counter": "ImuData.Count"}, "counter"),
        ("canmod_gps", CANMOD, {"tick": 0.0}, "tick"),
        ("canmod_gps", CANMOD, {"window": -1.0}, "window"),
        ("j1939_imu", SAE, {"source": 256}, "source"),
    ],
)
def test_wrong_settings_refuse_to_start(file: str, signals: dict[str, Any], keys: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says) as raised:
        build(file, signals, **keys)
    assert "\n" not in str(raised.value)


def test_a_file_that_is_no_database(tmp_path: Path) -> None:
    for name in ("a.dbc", "a.kcd", "a.xyz"):
        path = tmp_path / name
        path.write_bytes(b"\x00\xff this is \n none")
        with pytest.raises(ConfigError, match="no CAN database") as raised:
            build(path, CANMOD)
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
    decoder = build("canmod_gps", CANMOD, valid="ImuData.ImuValid")
    lenient = build("canmod_gps", CANMOD)
    blocks: list[SampleBlock] = []
    all_blocks: list[SampleBlock] = []
    link.open()
    ended = False
    while not ended:
        try:
            chunks = link.wait_for_chunks_or_timeout(1.0) or []
        except LinkEnded:
            ended = True
        else:
            blocks += decoder.feed(chunks)
            all_blocks += lenient.feed(chunks)
    link.close()
    every = concatenate_blocks(all_blocks)
    half_a_bit = np.repeat([0.125 * DEGREE, 0.0625], 3)
    assert every.values.shape == expected.shape
    assert (np.abs(every.values - expected) < half_a_bit).all()
    np.testing.assert_allclose(every.t_ns * 1e-9, recorded["t"], atol=1e-6)
    # each row that the sensor itself calls invalid is accounted for
    assert sum(len(b) + b.lost for b in blocks) == len(expected)
    assert decoder.bad == len(expected) - sum(len(b) for b in blocks)
