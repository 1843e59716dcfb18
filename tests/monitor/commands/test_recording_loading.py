"""Tests of recordings in the wire format of a sensor, such as CAN logs and captured bytes."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from drivers.data_types import AXES, EXTENDED_ID, Chunk, Floats, SampleBlock, make_block
from drivers.errors import ConfigError, ImuError, RecordingError
from drivers.recordings import load_samples, save_samples
from drivers.recordings.reading_options import ReadingOptions
from monitor.commands.recording_loading import DecoderChoice, LoadingOptions, load_recording
from tests.contracts.decoder_examples import CAN_SIGNALS, DEGREE, STIM300, VECTORNAV, Example
from tests.support.program import exit_status
from tests.support.recordings import recordings

RATE_HZ = 200.0
N = 4000
T0_NS = 1_763_700_000_000_000_000
DBC = Example("dbc")
TEXT = Example("text", {"columns": ("gx", "gy", "gz")})
LOGS = (".asc", ".blf", ".log", ".trc")
VALUES = np.random.default_rng(3).normal(size=(N, 6)) * 0.1 + [0.0, 0.0, 0.0, 0.0, 0.0, 9.81]


def make_samples(ticks_per_s: float = 1e9, t0_ns: int = T0_NS) -> SampleBlock:
    """Return samples at 200 Hz. The counter begins at 17 s."""
    t_s = np.arange(N) / RATE_HZ
    ticks = np.rint((17.0 + t_s) * ticks_per_s).astype(np.int64)
    return make_block(t0_ns + np.rint(t_s * 1e9).astype(np.int64), VALUES.copy(), np.full(N, 25.0), ticks)


def dbc_choice(folder: Path) -> DecoderChoice:
    return DecoderChoice("dbc", {"file": str(folder / "imu.dbc"), "signals": CAN_SIGNALS})


def write_can_log(path: Path, left_out: slice = slice(0, 0)) -> DecoderChoice:
    """Write the frames with python-can, without the frames of some samples."""
    decoder = dataclasses.replace(DBC, settings={"signals": CAN_SIGNALS}).build(path.parent)
    chunks = decoder.encode(make_samples())
    per_sample = len(chunks) // N
    del chunks[left_out.start * per_sample : left_out.stop * per_sample]
    with can.Logger(path) as log:
        for chunk in chunks:
            log(
                can.Message(
                    timestamp=chunk.t_ns * 1e-9,
                    arbitration_id=chunk.address & ~EXTENDED_ID,
                    is_extended_id=bool(chunk.address & EXTENDED_ID),
                    data=chunk.data,
                    channel=1,
                )
            )
    return dbc_choice(path.parent)


def encode(example: Example, folder: Path, ticks_per_s: float = 1e9) -> list[Chunk]:
    return example.build(folder).encode(make_samples(ticks_per_s, 0))


def write_capture(path: Path, chunks: list[Chunk]) -> DecoderChoice:
    path.write_bytes(b"".join(chunk.data for chunk in chunks))
    return DecoderChoice("vectornav_binary")


def assert_equal_values(found: Floats, expected: Floats) -> None:
    np.testing.assert_allclose(found[:, :3], expected[:, :3], atol=1.1e-3)  # resolution of the CAN signals
    np.testing.assert_allclose(found[:, 3:], expected[:, 3:], atol=2.1e-3)


class TestCanLogs:
    @pytest.mark.parametrize("suffix", LOGS)
    def test_log_gives_the_samples_that_were_sent(self, tmp_path: Path, suffix: str) -> None:
        path = tmp_path / f"drive{suffix}"
        found = load_recording(path, LoadingOptions(decoder=write_can_log(path)))
        assert found.axes == AXES
        assert_equal_values(found.values, VALUES[: len(found)])
        assert N - 1 <= len(found) <= N  # the frames after the last sample are missing
        assert found.t_s is not None
        t_s = found.t_s - found.t_s[0]
        np.testing.assert_allclose(t_s, np.arange(len(found)) / RATE_HZ, atol=1e-3)
        assert found.temperature_c[-1] == 25.0
        assert found.notes == ()

    def test_log_has_unix_times(self, tmp_path: Path) -> None:
        path = tmp_path / "drive.blf"
        found = load_recording(path, LoadingOptions(decoder=write_can_log(path)))
        assert found.t_s is not None
        assert abs(found.t_s[0] - T0_NS * 1e-9) < 1e-2

    def test_missing_samples_leave_a_gap(self, tmp_path: Path) -> None:
        path = tmp_path / "drive.blf"
        gap = slice(2000, 3000)  # five seconds
        found = load_recording(path, LoadingOptions(decoder=write_can_log(path, gap)))
        assert found.notes == ()
        assert found.t_s is not None
        assert found.t_s[-1] - found.t_s[0] == pytest.approx((N - 1) / RATE_HZ, abs=0.02)

    def test_truncated_log_is_read_up_to_the_cut(self, tmp_path: Path) -> None:
        path = tmp_path / "drive.asc"
        choice = write_can_log(path)
        whole = path.read_bytes()
        path.write_bytes(whole[: len(whole) // 2])
        found = load_recording(path, LoadingOptions(decoder=choice))
        assert 0.45 * N < len(found) < 0.55 * N
        path.write_bytes(whole[: len(whole) // 2] + b"\n   1.0 1  50 Rx d 6 00 zz")
        notes = load_recording(path, LoadingOptions(decoder=choice)).notes
        assert len(notes) == 1
        assert notes[0].startswith("The file is cut off or damaged at this point: ")

    def test_last_part_and_channel(self, tmp_path: Path) -> None:
        path = tmp_path / "drive.asc"
        choice = write_can_log(path)
        assert len(load_recording(path, LoadingOptions(last_s=1.0, decoder=choice))) == RATE_HZ
        other = dataclasses.replace(choice, options={**choice.options, "channel": "7"})
        with pytest.raises(RecordingError, match=r"drive\.asc: .*no frame of the channel 7; the channels are 1$"):
            load_recording(path, LoadingOptions(decoder=other))


class TestCaptures:
    def test_device_counter_gives_the_times(self, tmp_path: Path) -> None:
        path = tmp_path / "capture.raw"
        found = load_recording(path, LoadingOptions(decoder=write_capture(path, encode(VECTORNAV, tmp_path))))
        assert found.t_s is not None
        np.testing.assert_allclose(found.t_s, np.arange(N) / RATE_HZ, atol=1e-6)
        np.testing.assert_array_equal(found.values, VALUES.astype(np.float32))
        assert found.rate_hz is None
        assert found.notes == ()

    def test_damaged_and_repeated_frames_are_counted(self, tmp_path: Path) -> None:
        path = tmp_path / "capture.raw"
        chunks = encode(VECTORNAV, tmp_path)
        damaged = bytearray(chunks[500].data)
        damaged[20] ^= 0xFF
        chunks[500] = dataclasses.replace(chunks[500], data=bytes(damaged))
        kept = [*chunks[:1000], *chunks[3000:3500], chunks[3499], *chunks[3500:]]  # ten seconds are missing
        found = load_recording(path, LoadingOptions(decoder=write_capture(path, kept)))
        assert found.notes == ("1 frame rejected.", "1 repeated sample left out.")
        assert found.t_s is not None
        t_s = np.delete(np.arange(N), [500, *range(1000, 3000)]) / RATE_HZ
        np.testing.assert_allclose(found.t_s, t_s, atol=1e-6)

    def test_counter_that_counts_samples_and_wraps_needs_the_rate(self, tmp_path: Path) -> None:
        path = tmp_path / "capture.raw"
        counting = Example("text", {"columns": ("counter", "gx", "gy", "gz"), "counter_modulus": 256})
        chunks = encode(counting, tmp_path, RATE_HZ)
        write_capture(path, [*chunks[:1000], *chunks[1200:]])
        choice = DecoderChoice("text", {"columns": ["counter", "gx", "gy", "gz"], "counter_modulus": 256})
        with pytest.raises(ConfigError, match=r"capture\.raw: contains no times; give the sample rate with --rate HZ"):
            load_recording(path, LoadingOptions(decoder=choice))
        found = load_recording(path, LoadingOptions(RATE_HZ, decoder=choice))
        assert found.t_s is not None
        np.testing.assert_allclose(found.t_s, np.delete(np.arange(N), range(1000, 1200)) / RATE_HZ, atol=1e-6)
        assert found.notes == ()
        assert found.rate_hz == RATE_HZ

    def test_step_back_of_the_device_time_is_reported(self, tmp_path: Path) -> None:
        """The sensor was started again, so that its time is smaller than before."""
        path = tmp_path / "capture.raw"
        chunks = encode(VECTORNAV, tmp_path)
        found = load_recording(path, LoadingOptions(decoder=write_capture(path, [*chunks[1000:2000], *chunks[:1000]])))
        assert len(found) == 2000
        assert found.t_s is not None
        np.testing.assert_allclose(np.diff(found.t_s), 1.0 / RATE_HZ, atol=1e-4)
        assert len(found.notes) == 1
        assert found.notes[0].startswith("The counter jumped back by ")

    def test_clock_of_a_short_counter(self, tmp_path: Path) -> None:
        path = tmp_path / "capture.raw"
        write_capture(path, encode(STIM300, tmp_path, 2000.0))
        found = load_recording(path, LoadingOptions(decoder=DecoderChoice("stim300")))
        assert found.t_s is not None
        np.testing.assert_allclose(found.t_s, np.arange(N) / RATE_HZ, atol=1e-6)

    def test_text_without_a_counter_has_evenly_spaced_times(self, tmp_path: Path) -> None:
        path = tmp_path / "capture.txt"
        write_capture(path, encode(TEXT, tmp_path))
        choice = DecoderChoice("text", {"columns": ["gx", "gy", "gz"]})
        found = load_recording(path, LoadingOptions(50.0, decoder=choice))
        assert found.t_s is not None
        np.testing.assert_allclose(found.t_s, np.arange(N) / 50.0, atol=1e-6)
        assert found.axes == ("gx", "gy", "gz")

    def test_values_of_an_on_board_filter_are_noted(self, tmp_path: Path) -> None:
        path = tmp_path / "capture.txt"
        example = Example("vectornav_ascii", {"sentence": "VNYMR"})
        write_capture(path, encode(example, tmp_path))
        found = load_recording(path, LoadingOptions(RATE_HZ, decoder=DecoderChoice("vectornav_ascii")))
        assert any("hides bias instability B and random walk K; select $VNIMU" in note for note in found.notes)

    def test_stated_byte_rate_gives_the_times(self, tmp_path: Path) -> None:
        path = tmp_path / "capture.txt"
        chunks = encode(TEXT, tmp_path)
        size = sum(len(chunk.data) for chunk in chunks)
        choice = write_capture(path, chunks)
        choice = DecoderChoice("text", {"columns": ["gx", "gy", "gz"], "bytes_per_second": size / N * RATE_HZ})
        found = load_recording(path, LoadingOptions(decoder=choice))
        assert found.t_s is not None
        assert found.t_s[-1] - found.t_s[0] == pytest.approx(N / RATE_HZ, rel=0.02)

    def test_wrong_rate_is_reported(self, tmp_path: Path) -> None:
        path = tmp_path / "capture.raw"
        found = load_recording(path, LoadingOptions(100.0, decoder=write_capture(path, encode(VECTORNAV, tmp_path))))
        assert found.notes == ("The measured rate of 200 Hz differs from the stated rate.",)


def refusal(path: Path, **keys: Any) -> str:
    with pytest.raises(ImuError) as error:
        load_recording(path, LoadingOptions(**keys))
    line = str(error.value)
    assert line.startswith(f"{path}: ")
    return line.removeprefix(f"{path}: ")


class TestRefusals:
    def test_file_in_a_wire_format_needs_a_decoder(self, tmp_path: Path) -> None:
        write_can_log(tmp_path / "drive.blf")
        assert refusal(tmp_path / "drive.blf") == "contains CAN frames; name the decoder with --decoder: dbc"
        (tmp_path / "x.raw").write_bytes(b"abc")
        assert refusal(tmp_path / "x.raw").startswith(
            "contains captured bytes; name the decoder with --decoder: aceinna_dmu, "
        )

    @pytest.mark.parametrize("name", ["bench.txt", "bench.log"])
    def test_table_with_the_suffix_of_a_capture_is_recognized(self, tmp_path: Path, name: str) -> None:
        path = tmp_path / name
        path.write_text("# made on a bench\nt,gx,gy,gz\n0.00,1,2,3\n")
        assert load_recording(path).values[0, :3].tolist() == [1.0, 2.0, 3.0]
        path.write_text("gx 0.01 gy 0.02\n")  # labelled text of a sensor
        assert "name the decoder" in refusal(path)

    def test_folder_with_the_suffix_of_a_capture_is_refused(self, tmp_path: Path) -> None:
        (tmp_path / "bench.bin").mkdir()
        assert refusal(tmp_path / "bench.bin") == "cannot be read: is a directory, not a regular file"

    def test_wrong_decoder_and_options(self, tmp_path: Path) -> None:
        log, capture = tmp_path / "drive.blf", tmp_path / "capture.raw"
        write_can_log(log)
        write_capture(capture, encode(VECTORNAV, tmp_path)[:100])
        assert refusal(log, decoder=DecoderChoice("vectornav_binary")) == (
            "--decoder: vectornav_binary reads bytes, link replay provides frames: possible are dbc"
        )
        assert refusal(log, decoder=DecoderChoice("dbc")).startswith("--option file: missing")
        assert refusal(log, decoder=DecoderChoice("cdb")).startswith('--decoder: "cdb"')
        unknown = DecoderChoice("vectornav_binary", {"clocks": 1})
        assert refusal(capture, decoder=unknown).startswith("--option clocks: unknown")
        assert "bytes contain no sample; " in refusal(capture, decoder=DecoderChoice("stim300"))

    def test_empty_and_missing_files(self, tmp_path: Path) -> None:
        (tmp_path / "empty.raw").touch()
        choice = DecoderChoice("vectornav_binary")
        assert refusal(tmp_path / "empty.raw", decoder=choice) == "the file contains no data"
        assert refusal(tmp_path / "absent.raw", decoder=choice) == "no such file"
        (tmp_path / "text.blf").write_text("not a log")
        assert "cannot be replayed" in refusal(
            tmp_path / "text.blf",
            decoder=DecoderChoice("dbc", {"file": "xsens_mti", "signals": {"gx": "RateOfTurn.RateX"}}),
        )

    def test_recording_needs_no_decoder_and_captures_have_no_topics(self, tmp_path: Path) -> None:
        save_samples(tmp_path / "x.csv", np.arange(3.0), np.ones((3, 6)))
        assert refusal(tmp_path / "x.csv", decoder=DecoderChoice("dbc")) == (
            "contains samples, which need no decoder; leave out --decoder"
        )
        choice = write_capture(tmp_path / "x.raw", encode(VECTORNAV, tmp_path)[:100])
        assert (
            refusal(tmp_path / "x.raw", decoder=choice, reading=ReadingOptions(topic="/imu"))
            == "contains no topics; leave out --topic"
        )


class TestCommands:
    """The options are passed on by each command."""

    def options(self, folder: Path) -> list[str]:
        keys = {"file": folder / "imu.dbc"} | {f"signals.{axis}": name for axis, name in CAN_SIGNALS.items()}
        return ["--decoder", "dbc", *(part for key in keys for part in ("--option", f"{key}={keys[key]}"))]

    def test_analyze_gives_the_result_of_the_converted_recording(self, tmp_path: Path) -> None:
        path = tmp_path / "drive.blf"
        write_can_log(path)
        assert exit_status("convert", path, tmp_path / "drive.npz", *self.options(tmp_path)) == 0
        results = []
        for name, more in ((path, self.options(tmp_path)), (tmp_path / "drive.npz", [])):
            assert exit_status("analyze", name, *more, "--json", tmp_path / "result.json") == 0
            results.append(json.loads((tmp_path / "result.json").read_bytes()))
        # the log is not a table whose unit might be wrong, so only the table has a note about the large noise
        results[1]["notes"] = [note for note in results[1]["notes"] if "would fit the unit" not in note]
        assert results[0] == results[1]
        assert len(load_samples(tmp_path / "drive.npz")) >= N - 1

    @pytest.mark.parametrize(
        "command",
        [("reconcile", "--out", "r"), ("compensate", "--out", "c.npz"), ("thermal", "fit")],
        ids=" ".join,
    )
    def test_commands_read_the_log(
        self, tmp_path: Path, command: tuple[str, ...], capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:  # fmt: skip
        monkeypatch.chdir(tmp_path)
        path = tmp_path / "drive.blf"
        path.write_text("damaged")
        (tmp_path / "imu.dbc").write_text("")
        names = list(command[:2]) if command[0] == "thermal" else [command[0]]
        rest = list(command[len(names) :])
        status = exit_status(*names, path, *rest, "--decoder", "vectornav_binary")
        assert status == 2
        assert capsys.readouterr().err == (
            f"imu-monitor: {path}: --decoder: vectornav_binary reads bytes, link replay provides frames: possible are "
            "dbc\n"
        )

    @pytest.mark.parametrize(
        ("options", "line"),
        [
            (["--option", "a=1"], "--option: a=1: name the decoder with --decoder"),
            (["--decoder", "dbc", "--option", "a"], '--option: "a": expected KEY=VALUE once per key'),
            (["--decoder", "dbc", "--option", "a=1", "--option", "a=2"], '--option: "a=2": expected KEY=VALUE once'),
            (["--decoder", "dbc", "--option", "a=1", "--option", "a.b=2"], '--option: "a.b=2": expected KEY=VALUE'),
        ],
    )
    def test_wrong_options(self, options: list[str], line: str, capsys: pytest.CaptureFixture[str]) -> None:
        assert exit_status("analyze", "x.raw", *options) == 2
        assert capsys.readouterr().err.startswith(f"imu-monitor: {line}")


@pytest.mark.data
class TestRealRecordings:
    def test_captured_sentences_give_the_recorded_samples(self) -> None:
        folder = recordings() / "vn100-serial"
        found = load_recording(
            folder / "vnymr-sentences.txt.gz", LoadingOptions(40.0, decoder=DecoderChoice("vectornav_ascii"))
        )
        expected = load_samples(folder / "static-12min.npz")
        np.testing.assert_allclose(found.values, expected.values, rtol=1e-6, atol=1e-9)
        assert found.t_s is not None
        np.testing.assert_allclose(found.t_s, np.arange(len(found)) / 40.0, atol=1e-6)

    def test_can_frames_give_the_recorded_samples(self) -> None:
        folder = recordings() / "can-car"
        signals = {f"g{axis.lower()}": f"ImuData.AngularRate{axis}" for axis in "XYZ"}
        signals |= {f"a{axis.lower()}": f"ImuData.Acceleration{axis}" for axis in "XYZ"}
        choice = DecoderChoice("dbc", {"file": "canmod_gps", "signals": signals})
        found = load_recording(folder / "drive-a-frames.csv.gz", LoadingOptions(decoder=choice))
        expected = load_samples(folder / "drive-a.npz")
        assert len(found) == len(expected)
        half_a_bit = np.repeat([0.125 * DEGREE, 0.0625], 3)
        assert (np.abs(found.values - expected.values) < half_a_bit).all()
        assert found.t_s is not None
        assert expected.t_s is not None
        assert np.abs(found.t_s - expected.t_s).max() < 0.05  # the clock removes the jitter of the bus
