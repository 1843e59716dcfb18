"""Recordings: every format round trip, what is missing or cut, and files that are none."""

import errno
import gzip
import io
import os
import pickle
import re
import resource
import subprocess
import sys
import tracemalloc
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from drivers.data_types import AXES, concatenate_blocks
from drivers.errors import ConfigError, ImuError, RecordingError
from drivers.recordings import (
    Recording,
    is_recording,
    iter_blocks,
    load_samples,
    memory_check,
    open_recording_writer,
    save_samples,
)
from drivers.recordings.file_formats import parquet_and_arrow_format as arrow_format
from drivers.recordings.file_formats.arrow_message_sizes import (
    check_batch_buffer_sizes,
    count_column_buffers,
    iter_batch_sizes,
)
from drivers.recordings.file_formats.csv_format import MAX_LINE_BYTES, READ_BYTES
from drivers.recordings.formats import WRITABLE_TABLES
from drivers.recordings.recording import MAX_VALUE
from drivers.recordings.writing import atomic_write_path
from tests.support.recordings import recordings

SUFFIXES = WRITABLE_TABLES
TEXTS = (".csv", ".csv.gz")
ROWS = "t,gx,az\n0.0,1.5,9.8\n0.1,2.5,9.7\n0.2,3.5,9.6\n"


def samples(n=300, seed=1):
    rng = np.random.default_rng(seed)
    return np.arange(n) / 100.0, rng.normal(size=(n, 6)), 25.0 + rng.normal(size=n)


def written(path: Path, text: str | bytes) -> Path:
    data = text.encode() if isinstance(text, str) else text
    path.write_bytes(gzip.compress(data) if path.name.endswith(".gz") else data)
    return path


def attempt(path: Path) -> Recording | None:
    """The recording, or None where it is refused in one line that begins with the file."""
    try:
        return load_samples(path, 100.0)
    except ImuError as error:
        line = str(error)
    assert line.startswith(f"{path}: ")
    assert "\n" not in line
    return None


@pytest.fixture(params=SUFFIXES)
def path(request, tmp_path):
    return tmp_path / f"bench{request.param}"


class TestRoundTrip:
    def test_every_bit_comes_back(self, path):
        t, values, temperature = samples()
        values[3, 2] = np.nan
        temperature[7] = np.nan
        values[0, 0], values[1, 0], values[2, 0] = 5e-324, -0.0, np.nextafter(0.1, 1.0)
        t = t + 1.7637e9
        save_samples(path, t, values, temperature)
        recording = load_samples(path)
        assert recording.t_s.tobytes() == t.tobytes()
        assert np.array_equal(recording.values, values, equal_nan=True)
        assert np.signbit(recording.values[1, 0])
        assert np.array_equal(recording.temperature_c, temperature, equal_nan=True)
        assert recording.axes == AXES
        assert recording.rate_hz is None
        assert recording.notes == ()

    @pytest.mark.parametrize("suffix", [".csv", ".npz", ".arrow"])
    @given(numbers=st.lists(st.floats(), min_size=1, max_size=8))
    @example(numbers=[MAX_VALUE, np.nextafter(MAX_VALUE, np.inf), -np.inf])
    def test_any_float_comes_back_and_beyond_the_limit_as_missing(self, tmp_path_factory, suffix, numbers):
        path = tmp_path_factory.mktemp("any") / f"x{suffix}"
        values = np.full((len(numbers), 6), np.nan)
        values[:, 4] = numbers
        save_samples(path, np.arange(float(len(numbers))), values, axes=["ay"])
        values[np.abs(values) > MAX_VALUE] = np.nan
        assert np.array_equal(load_samples(path).values, values, equal_nan=True)

    def test_absent_column_is_absent_not_zero(self, path):
        t, values, _ = samples()
        values[:, [0, 1, 3]] = np.nan
        save_samples(path, t, values)
        recording = load_samples(path)
        assert recording.axes == ("gz", "ay", "az")
        assert np.isnan(recording.values[:, [0, 1, 3]]).all()
        assert np.isnan(recording.temperature_c).all()

    def test_axes_asked_for_are_written_and_no_others(self, path):
        t, values, _ = samples()
        values[:, 5] = np.nan
        save_samples(path, t, values, axes=["gz", "az"])
        assert load_samples(path).axes == ("gz", "az")

    def test_times_are_passed_on_as_stored(self, path):
        t, values, _ = samples(6)
        t[:] = [10.0, 10.013, 10.009, 99.0, 4.0, 4.0]
        save_samples(path, t, values)
        assert load_samples(path).t_s.tolist() == t.tolist()

    def test_arrays_are_read_only(self, path):
        save_samples(path, *samples())
        recording = load_samples(path)
        for array in (recording.t_s, recording.values, recording.temperature_c):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 1.0

    def test_equal_samples_give_equal_bytes(self, path):
        save_samples(path, *samples())
        first = path.read_bytes()
        save_samples(path, *samples())
        assert path.read_bytes() == first

    def test_nothing_but_the_file_is_left(self, path):
        save_samples(path, *samples())
        assert list(path.parent.iterdir()) == [path]

    def test_is_recording_looks_at_the_suffix(self, path):
        assert is_recording(path)
        assert is_recording(path.with_name(path.name.upper()))
        assert not is_recording(path.with_name("notes.txt"))
        assert not is_recording(path.with_name(path.name + ".part"))


def appended(path, t, values, temperature, cuts):
    with open_recording_writer(path, AXES, temperature=True) as append:
        for rows in map(slice, (0, *cuts), (*cuts, len(t))):
            append(t[rows], values[rows], temperature[rows])


class TestPieceByPiece:
    @pytest.mark.parametrize("cuts", [(1,), (100, 101, 1900), (65_537,)])
    def test_any_cut_is_the_same_recording(self, path, cuts):
        t, values, temperature = samples(max(cuts) + 100)
        appended(path, t, values, temperature, cuts)
        recording = load_samples(path)
        assert recording.t_s.tobytes() == t.tobytes()
        assert np.array_equal(recording.values, values)
        assert np.array_equal(recording.temperature_c, temperature)
        assert recording.notes == ()

    def test_columns_that_were_not_asked_for_are_absent(self, path):
        t, values, _ = samples()
        with open_recording_writer(path, ["gz"], temperature=False) as append:
            append(t, values)
        assert load_samples(path).axes == ("gz",)

    @pytest.mark.parametrize("ended", [KeyboardInterrupt, OSError, SystemExit])
    def test_a_run_that_is_broken_off_leaves_nothing(self, path, ended):
        t, values, temperature = samples()
        with pytest.raises(ended), open_recording_writer(path, AXES, temperature=True) as append:  # noqa: PT012
            append(t, values, temperature)
            raise ended
        assert list(path.parent.iterdir()) == []

    def test_a_run_that_is_broken_off_leaves_what_was_there(self, path):
        save_samples(path, *samples())
        before = path.read_bytes()
        with pytest.raises(KeyboardInterrupt), open_recording_writer(path, AXES, temperature=True) as append:  # noqa: PT012
            append(*samples(9))
            raise KeyboardInterrupt
        assert list(path.parent.iterdir()) == [path]
        assert path.read_bytes() == before

    @pytest.mark.long
    def test_memory_does_not_grow_with_the_rows(self, path):
        """What Python and NumPy hold; Arrow's own buffers are those of one piece."""
        t, values, temperature = samples(5_000)

        def peak(times):
            tracemalloc.start()
            with open_recording_writer(path, AXES, temperature=True) as append:
                for _ in range(times):
                    append(t, values, temperature)
            high = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
            return high

        few, many = peak(2), peak(14)
        assert many < few + 1_000_000  # twelve times 320 kB more went through


class TestSaveRefuses:
    def test_unknown_suffix(self, tmp_path):
        with pytest.raises(ConfigError, match=r"x\.xls: the suffix is unknown; recordings are written as \.csv"):
            save_samples(tmp_path / "x.xls", *samples())

    def test_missing_folder(self, path):
        with pytest.raises(ConfigError, match="there is no folder"):
            save_samples(path.parent / "absent" / path.name, *samples())

    def test_folder_of_that_name_stays(self, path):
        path.mkdir()
        with pytest.raises(ConfigError, match="cannot be written"):
            save_samples(path, *samples())
        assert list(path.parent.iterdir()) == [path]

    def test_what_the_system_refuses_is_said_before_the_work(self, tmp_path):
        path = tmp_path / f"{'x' * 248}.csv"  # a name that cannot grow by .part
        with pytest.raises(ConfigError, match=r"x\.csv: cannot be written: .*too long"):
            save_samples(path, *samples())
        assert list(tmp_path.iterdir()) == []

    def test_a_full_disk_names_the_file_and_leaves_nothing(self, tmp_path):
        def fill():
            with atomic_write_path(tmp_path / "x.csv") as part:
                part.write_text("t,gz\n")
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        with pytest.raises(OSError, match=r"No space left on device: .*x\.csv"):
            fill()
        assert list(tmp_path.iterdir()) == []

    def test_arrays_that_do_not_fit(self, tmp_path):
        t, values, temperature = samples()
        for wrong in ((t[1:], values), (t, values[:, :3]), (t[:0], values[:0]), (t, values, temperature[1:])):
            with pytest.raises(RecordingError, match="expected"):
                save_samples(tmp_path / "x.csv", *wrong)
        with pytest.raises(RecordingError, match="unknown axis wx"):
            save_samples(tmp_path / "x.csv", t, values, axes=["wx"])
        with pytest.raises(RecordingError, match="no axis has a value"):
            save_samples(tmp_path / "x.csv", t, values * np.nan)
        with pytest.raises(RecordingError, match="a time is missing"):
            save_samples(tmp_path / "x.csv", t * np.nan, values)
        assert not list(tmp_path.iterdir())


class TestColumns:
    def test_any_order_and_temp_is_temperature(self, tmp_path):
        text = "az,temp,gx,t\n9.8,25.5,0.1,0\n9.7,26.5,0.2,1\n"
        recording = load_samples(written(tmp_path / "x.csv", text))
        assert recording.axes == ("gx", "az")
        assert recording.values[:, 0].tolist() == [0.1, 0.2]
        assert recording.temperature_c.tolist() == [25.5, 26.5]
        assert recording.notes == ()

    def test_others_are_left_aside_with_a_note(self, tmp_path):
        text = "t,gx,mx,label,temperature,temp\n0,1,2,a,20,30\n1,2,3,b,21,31\n"
        recording = load_samples(written(tmp_path / "x.csv", text))
        assert recording.notes == ("Other columns are not used: mx, label, temp.",)
        assert recording.temperature_c.tolist() == [20.0, 21.0]

    def test_raw_counts_are_other_columns(self, tmp_path):
        path = tmp_path / "x.npz"
        np.savez(path, t=np.arange(3.0), gx_raw=np.arange(3), az_raw=np.arange(3))
        with pytest.raises(RecordingError, match=r"no axis among its columns \(t, gx_raw, az_raw\)"):
            load_samples(path)

    def test_the_same_column_twice(self, tmp_path):
        with pytest.raises(RecordingError, match="column gx occurs twice"):
            load_samples(written(tmp_path / "x.csv", "t,gx,gx\n0,1,1\n"))

    def test_control_characters_do_not_reach_the_terminal(self, tmp_path):
        with pytest.raises(RecordingError) as error:
            load_samples(written(tmp_path / "x.csv", "\x1b[2Jq,w\n1,2\n"))
        assert "\x1b" not in str(error.value)

    def test_unequal_lengths(self, tmp_path):
        path = tmp_path / "x.npz"
        np.savez(path, t=np.arange(5.0), gx=np.arange(5.0), gy=np.arange(4.0))
        with pytest.raises(RecordingError, match=r"x\.npz: gy has 4 values but t has 5"):
            load_samples(path)

    @pytest.mark.parametrize("large", ["inf", "1e101", "1e307"])
    def test_values_too_large_to_square_become_missing(self, tmp_path, large):
        recording = load_samples(written(tmp_path / "x.csv", f"t,gx,temp\n0,{large},-{large}\n1,2,3\n"))
        assert np.isnan(recording.values[0, 0])
        assert np.isnan(recording.temperature_c[0])
        assert recording.notes == ("2 values that are infinite or beyond 1e+100 were read as missing.",)


class TestRate:
    def test_neither_t_nor_fs_asks_for_the_rate(self, tmp_path):
        path = written(tmp_path / "x.csv", "gx\n1\n2\n")
        with pytest.raises(ConfigError, match=r"x\.csv: .*--rate HZ"):
            load_samples(path)
        recording = load_samples(path, 50.0)
        assert recording.t_s is None
        assert recording.rate_hz == 50.0

    @pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), float("inf")])
    def test_a_rate_is_positive(self, tmp_path, rate):
        with pytest.raises(ConfigError, match="--rate"):
            load_samples(written(tmp_path / "x.csv", ROWS), rate)

    def test_t_stands_and_fs_is_the_stated_rate(self, tmp_path):
        path = tmp_path / "x.npz"
        np.savez(path, t=[0.0, 0.5, 0.7], fs=100, gx=np.zeros(3))
        recording = load_samples(path)
        assert recording.t_s.tolist() == [0.0, 0.5, 0.7]
        assert recording.rate_hz == 100.0

    def test_the_rate_asked_for_goes_before_fs(self, tmp_path):
        path = tmp_path / "x.npz"
        np.savez(path, fs=100.0, gx=np.zeros(3))
        recording = load_samples(path, 50.0)
        assert recording.rate_hz == 50.0
        assert recording.notes == ("The file states 100 Hz; the requested 50 Hz are used.",)

    @pytest.mark.parametrize("fs", [0.0, -5.0, np.nan, [1.0, 2.0], "fast"])
    def test_useless_fs_is_none(self, tmp_path, fs):
        path = tmp_path / "x.npz"
        np.savez(path, fs=fs, gx=np.zeros(3))
        with pytest.raises(ConfigError, match="--rate HZ"):
            load_samples(path)
        assert re.match("fs (is not one number|is not used: .* Hz is outside)", load_samples(path, 9.0).notes[0])

    def test_rows_without_time_are_left_out(self, tmp_path):
        recording = load_samples(written(tmp_path / "x.csv", "t,gx\n0,1\n,2\n2,3\n1e30,4\n4,5\n"))
        assert recording.t_s.tolist() == [0.0, 2.0, 4.0]
        assert recording.values[:, 0].tolist() == [1.0, 3.0, 5.0]
        assert recording.notes == ("2 of 5 rows have no usable time and were left out.",)

    def test_times_in_milliseconds_since_1970(self, tmp_path):
        path = written(tmp_path / "x.csv", "t,gx\n1763700000000,1\n1763700000010,2\n")
        with pytest.raises(RecordingError, match="not times in seconds"):
            load_samples(path)
        recording = load_samples(path, 100.0)
        assert recording.t_s is None
        assert "is used instead of t" in recording.notes[0]


class TestBlocks:
    def test_blocks_are_the_recording(self, tmp_path):
        t, values, temperature = samples(1000)
        save_samples(tmp_path / "x.npz", t + 1.7637e9, values, temperature)
        blocks = list(iter_blocks(load_samples(tmp_path / "x.npz"), 300))
        assert [len(b) for b in blocks] == [300, 300, 300, 100]
        whole = concatenate_blocks(blocks)
        assert np.array_equal(whole.values, values)
        assert np.array_equal(whole.temperature_c, temperature)
        # a float64 near 1.76e9 s is exact to 0.24 µs
        assert np.abs(whole.t_ns - 1_763_700_000_000_000_000 - np.arange(1000) * 10_000_000).max() < 250
        assert whole.lost == 0
        assert not blocks[0].values.flags.writeable

    def test_without_t_the_rate_makes_the_times(self, tmp_path):
        recording = load_samples(written(tmp_path / "x.csv", "gx\n" + "1\n" * 7), 3.0)
        times = concatenate_blocks(list(iter_blocks(recording, 3))).t_ns
        assert times.tolist() == [round(i * 1e9 / 3) for i in range(7)]

    def test_neither_times_nor_rate(self):
        recording = Recording(None, np.zeros((2, 6)), np.zeros(2), None, AXES, ())
        with pytest.raises(RecordingError, match="times or a rate"):
            next(iter_blocks(recording))


@pytest.mark.parametrize("suffix", TEXTS)
class TestText:
    @pytest.mark.parametrize(
        "text",
        [
            "\ufeff" + ROWS,
            ROWS.replace("\n", "\r\n"),
            ROWS.replace(",", ", "),
            ROWS.replace(",", " ,\t"),
            ROWS + "\n\n  \n",
            ROWS.replace("\n0.1", "\n\n0.1"),
            "# " + ROWS,
            "% " + ROWS,
            "# ADIS16470, 2026-11-22\n% gyro in rad/s\n\n" + ROWS,
            "\ufeff# log, with a comma\n" + ROWS,
            "# recorded with gx, az and t\n# t,gx,az\n" + ROWS.partition("\n")[2],
            "# t,gx,az in SI units\n" + ROWS,
            "\n \n" + ROWS,
            '"t","gx","az"\n' + ROWS.partition("\n")[2].replace("1.5", '"1.5"'),
            ROWS.replace("0.1,2.5,9.7", "1e-1,+2.5,97E-1"),
        ],
        ids=[
            "bom",
            "crlf",
            "spaces",
            "tabs",
            "blank-end",
            "blank",
            "hash",
            "percent",
            "comments",
            "bom-comment",
            "comment-then-hash",
            "comment-of-names",
            "blank-start",
            "quotes",
            "exponents",
        ],
    )
    def test_dialects(self, tmp_path, suffix, text):
        recording = load_samples(written(tmp_path / f"x{suffix}", text))
        assert recording.t_s.tolist() == [0.0, 0.1, 0.2]
        assert recording.values[:, 0].tolist() == [1.5, 2.5, 3.5]
        assert recording.values[:, 5].tolist() == [9.8, 9.7, 9.6]
        assert recording.notes == ()

    def test_empty_field_is_missing(self, tmp_path, suffix):
        text = "t,gx,gy,az\n0,,1,\n1,nan, ,2\n2,NaN,3,4\n"
        recording = load_samples(written(tmp_path / f"x{suffix}", text))
        nan = np.nan
        expected = [[nan, 1, nan], [nan, nan, 2], [nan, 3, 4]]
        assert np.array_equal(recording.values[:, [0, 1, 5]], expected, equal_nan=True)
        assert recording.notes == ()

    @pytest.mark.parametrize(
        ("line", "why"),
        [
            ("0.1,ERR,9.7", "line 3: gx is 'ERR'"),
            ("0.1,2.5", "line 3: 2 fields where the header has 3"),
            ("0.1,2.5,9.7,1", "line 3: 4 fields where the header has 3"),
            ("0.1,2_5,9.7", "line 3: gx is '2_5'"),
            ("0.1,2\0\0,9.7", r"line 3: gx is '2\x00\x00'"),
            ('0.1,"2.5,9.7', "line 3: 2 fields where the header has 3"),
        ],
    )
    def test_a_bad_line_costs_itself_only(self, tmp_path, suffix, line, why):
        recording = load_samples(written(tmp_path / f"x{suffix}", ROWS.replace("0.1,2.5,9.7", line)))
        assert recording.t_s.tolist() == [0.0, 0.2]
        assert recording.values[:, 0].tolist() == [1.5, 3.5]
        assert recording.notes[0] == f"1 of 3 lines are not samples and are read as missing ({why})."

    def test_without_t_a_bad_line_keeps_its_place(self, tmp_path, suffix):
        recording = load_samples(written(tmp_path / f"x{suffix}", "gx\n1\nx\n3\n"), 10.0)
        assert np.array_equal(recording.values[:, 0], [1.0, np.nan, 3.0], equal_nan=True)

    @pytest.mark.long
    def test_line_numbers_far_into_the_file(self, tmp_path, suffix):
        line = "1.25,0.0000000000000000000000000001\n"
        n = 3 * READ_BYTES // len(line)
        text = "t,gx\n" + line * n + "1.25,oops\n" + line * 5
        recording = load_samples(written(tmp_path / f"x{suffix}", text))
        assert len(recording) == n + 5
        assert f"(line {n + 2}: gx is 'oops')" in recording.notes[0]

    def test_mostly_bad_lines_are_no_recording(self, tmp_path, suffix):
        text = "t,gx\n" + "yesterday,1\n" * 9
        with pytest.raises(RecordingError, match=r"9 of 9 lines are not samples \(line 2: t is 'yesterday'"):
            load_samples(written(tmp_path / f"x{suffix}", text))

    @pytest.mark.parametrize(
        ("text", "why"),
        [
            ("t,gx\n", "no complete line of samples"),
            ("t,gx\n\n\n", "no complete line of samples"),
            ("t,gx\n0.1,2", "no complete line of samples"),
            ("t,gx", "not one complete line"),
            ("\n\n", "only comments and blank lines"),
            ("# a log\n", "only comments and blank lines"),
            ("# t,gx,az\n", "no complete line of samples"),
            ("# a log\n% of nothing\n1,2\n", "header line is missing: line 3 consists of numbers"),
            ("# a log\nstart of the log\nt,omega\n0,1\n", r"no axis among its columns \(t, omega\) in line 3"),
            ("# a\n" * 300_000, "no header line within its first 300000 lines"),
            ("0.1,2,3\n0.2,3,4\n", "header line is missing.*t,gx,gy"),
            ("a,b\n1,2\n", r"no axis among its columns \(a, b\) in line 1"),
            (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + b"\0" * 99, "no CSV text|no axis"),
            ("t,gx\n".encode("utf-16"), "no complete line of samples"),
        ],
    )
    def test_no_recording(self, tmp_path, suffix, text, why):
        with pytest.raises(RecordingError, match=rf"x{suffix}: .*({why})") as error:
            load_samples(written(tmp_path / f"x{suffix}", text))
        assert "\n" not in str(error.value)


class TestCut:
    def test_any_cut_gives_what_stands_before_it(self, path):
        t, values, temperature = samples(120)
        save_samples(path, t, values, temperature)
        whole = path.read_bytes()
        outcomes = set()
        rng = np.random.default_rng(3)
        for cut in {*range(1, 30), *range(len(whole) - 30, len(whole)), *rng.integers(1, len(whole), 120)}:
            path.write_bytes(whole[:cut])
            recording = attempt(path)
            outcomes.add("refused" if recording is None else "read")
            if recording is None:
                continue
            n = len(recording)
            right = np.isnan(recording.values) | (recording.values == values[:n])
            assert right.all()
            assert recording.t_s is None or np.array_equal(recording.t_s, t[:n])
            # a CSV cut exactly at a line's end cannot be told from a whole one
            assert recording.notes or (path.suffix == ".csv" and whole[cut - 1 : cut] == b"\n")
        assert outcomes == ({"refused"} if path.suffix == ".parquet" else {"refused", "read"})

    @pytest.mark.parametrize("suffix", [".arrow", ".arrows"])
    def test_arrow_is_read_up_to_the_last_whole_batch(self, tmp_path, suffix):
        path = tmp_path / f"x{suffix}"
        save_samples(path, *samples(200_000))
        path.write_bytes(path.read_bytes()[: path.stat().st_size * 9 // 10])
        recording = load_samples(path)
        assert len(recording) == 2 * 65536
        assert "cut off" in recording.notes[0]

    def test_last_line_may_end_inside_a_number(self, tmp_path):
        recording = load_samples(written(tmp_path / "x.csv", ROWS + "0.3,4.5,9."))
        assert len(recording) == 3
        assert "last line has no end" in recording.notes[0]

    @pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
    def test_cut_npz_keeps_whole_columns_and_the_start_of_the_cut_one(self, tmp_path, save):
        _, values, _ = samples(5000)
        path = tmp_path / "x.npz"
        save(path, fs=100.0, gx=values[:, 0], gy=values[:, 1], gz=values[:, 2].astype(np.float32))
        whole = path.read_bytes()
        path.write_bytes(whole[: whole.index(b"gy.npy") + 20_000])
        recording = load_samples(path)
        assert recording.axes == ("gx", "gy")
        assert recording.rate_hz == 100.0
        assert np.array_equal(recording.values[:, 0], values[:, 0])
        kept = np.count_nonzero(~np.isnan(recording.values[:, 1]))
        assert 2000 < kept < 3500
        assert np.array_equal(recording.values[:kept, 1], values[:kept, 1])
        assert "cut off inside gy" in recording.notes[0]

    def test_gzip_damaged_in_the_middle(self, tmp_path):
        path = tmp_path / "x.csv.gz"
        t, values, _ = samples(20_000)
        save_samples(path, t, values)
        data = bytearray(path.read_bytes())
        data[len(data) // 2 :] = b"\xff" * (len(data) - len(data) // 2)
        path.write_bytes(data)
        recording = load_samples(path)
        # what inflates before the damage is noticed may hold wrong lines; those far before it are right
        assert 4000 < len(recording) < 12_000
        assert np.array_equal(recording.values[:4000], values[:4000])
        assert "damaged" in recording.notes[0]

    def test_gzip_members_strung_together_are_one_text(self, tmp_path):
        path = tmp_path / "x.csv.gz"
        head, tail = ROWS[:20].encode(), ROWS[20:].encode()
        path.write_bytes(gzip.compress(head) + gzip.compress(tail) + b"\0" * 64)
        recording = load_samples(path)
        assert len(recording) == 3
        assert recording.notes == ()

    def test_flipped_bytes_never_end_in_a_traceback(self, path):
        save_samples(path, *samples(50))
        whole = path.read_bytes()
        rng = np.random.default_rng(11)
        for _ in range(150):
            damaged = bytearray(whole)
            for at in rng.integers(0, rng.choice([60, 400, len(whole)]), 3):
                damaged[at % len(whole)] = int(rng.integers(256))
            path.write_bytes(damaged)
            recording = attempt(path)
            assert recording is None or len(recording) > 0


class TestNoRecording:
    def test_absent_empty_and_random_files(self, path):
        with pytest.raises(RecordingError, match="No such file"):
            load_samples(path)
        path.write_bytes(b"")
        with pytest.raises(RecordingError, match="the file is empty"):
            load_samples(path)
        path.write_bytes(np.random.default_rng(5).bytes(5000))
        with pytest.raises(RecordingError, match=f"{path.name}: "):
            load_samples(path)

    def test_unknown_suffix(self, tmp_path):
        with pytest.raises(ConfigError, match=r"known are \.csv.*like CSV text: rename it to end in \.csv"):
            load_samples(written(tmp_path / "x.txt", "a,b\n1,2\n"))

    def test_an_empty_file_says_what_to_do(self, path):
        path.write_bytes(b"")
        with pytest.raises(RecordingError, match=r"the file is empty, expected samples of an IMU; record it again"):
            load_samples(path)
        other = written(path.parent / "x.dat", "")
        with pytest.raises(ConfigError, match=r"the file is empty, and its name does not end like.*known are \.csv"):
            load_samples(other)

    @pytest.mark.parametrize(
        ("right", "wrong"),
        [
            (right, wrong)
            for right in (".csv", ".csv.gz", ".npz", ".parquet", ".arrow", ".arrows")
            for wrong in SUFFIXES
            if right[:4] != wrong[:4] and {right[:4], wrong[:4]} != {".arr", ".fea"}  # those are told by their content
        ],
    )
    def test_a_wrong_suffix_is_named_with_the_right_one(self, tmp_path, right, wrong):
        path = tmp_path / f"right{right}"
        save_samples(path, *samples())
        renamed = path.rename(tmp_path / f"wrong{wrong}")
        with pytest.raises(RecordingError, match=rf"; its content .*: rename it to end in {right}$"):
            load_samples(renamed)

    def test_a_pipe_is_not_waited_for(self, path):
        os.mkfifo(path)
        with pytest.raises(RecordingError, match="is a FIFO, not a regular file"):
            load_samples(path)

    @pytest.mark.parametrize("key", ["t", "gx", "fs"])
    def test_objects_are_never_unpickled(self, tmp_path, key):
        class Bomb:
            def __reduce__(self):
                return os.mkdir, (str(tmp_path / "exploded"),)

        path = tmp_path / "x.npz"
        arrays = {"t": np.arange(1.0), "gx": np.arange(1.0), "fs": np.array(1.0)}
        np.savez(path, **{**arrays, key: np.array([Bomb()], dtype=object)})
        with pytest.raises(RecordingError, match=f"x.npz: {key} contains Python objects") as error:
            load_samples(path)
        assert "\n" not in str(error.value)
        assert not (tmp_path / "exploded").exists()

    def test_a_pickle_renamed(self, tmp_path):
        with pytest.raises(RecordingError, match=r"no \.npz file"):
            load_samples(written(tmp_path / "x.npz", pickle.dumps([1, 2])))

    @pytest.mark.parametrize("column", [np.array(["a", "b"]), np.ones((2, 3)), np.array([1j, 2j]), np.float64(3)])
    def test_columns_that_are_none(self, tmp_path, column):
        path = tmp_path / "x.npz"
        np.savez(path, t=np.arange(2.0), gx=column)
        with pytest.raises(RecordingError, match=r"gx (contains|has shape)"):
            load_samples(path)

    @pytest.mark.parametrize("suffix", [".parquet", ".arrow"])
    def test_arrow_types(self, tmp_path, suffix):
        pa = pytest.importorskip("pyarrow")
        from pyarrow import parquet

        def write(**columns):
            table = pa.table(columns)
            if suffix == ".parquet":
                parquet.write_table(table, path)
            else:
                with pa.ipc.new_file(str(path), table.schema) as writer:
                    writer.write_table(table)

        path = tmp_path / f"x{suffix}"
        write(t=pa.array([0, 1, 2]), gx=pa.array([1.5, None, 3.5]), gy=pa.nulls(3), label=["a", "b", "c"])
        recording = load_samples(path)
        assert np.array_equal(recording.values[:, 0], [1.5, np.nan, 3.5], equal_nan=True)
        assert np.isnan(recording.values[:, 1]).all()
        assert recording.notes == ("Other columns are not used: label.",)
        write(t=pa.array([0, 1], pa.timestamp("ns")), gx=[1.0, 2.0])
        with pytest.raises(RecordingError, match=r"t contains timestamp\[ns\], expected numbers; t is in seconds"):
            load_samples(path)
        write(t=pa.array([], pa.float64()), gx=pa.array([], pa.float64()))
        with pytest.raises(RecordingError, match="no samples"):
            load_samples(path)

    @pytest.mark.parametrize("suffix", [".parquet", ".arrow", ".arrows"])
    def test_without_pyarrow_says_what_to_install(self, tmp_path, suffix, monkeypatch):
        path = tmp_path / f"x{suffix}"
        save_samples(path, *samples())
        monkeypatch.setitem(sys.modules, "pyarrow", None)
        with pytest.raises(ConfigError, match=r'pip install "imu-monitor\[arrow\]"'):
            load_samples(path)
        with pytest.raises(ConfigError, match=r'pip install "imu-monitor\[arrow\]"'):
            save_samples(path, *samples())


class TestFolder:
    def test_segments_by_name_are_one_recording(self, tmp_path):
        t, values, temperature = samples(300)
        for name, rows in (("b.npz", slice(100, 200)), ("a.csv", slice(0, 100)), ("c.arrows", slice(200, 300))):
            save_samples(tmp_path / name, t[rows], values[rows], temperature[rows])
        (tmp_path / "README.md").write_text("about")
        (tmp_path / ".a.csv").write_text("hidden")
        recording = load_samples(tmp_path)
        assert np.array_equal(recording.t_s, t)
        assert np.array_equal(recording.values, values)
        assert np.array_equal(recording.temperature_c, temperature)
        assert recording.notes == ()

    def test_an_axis_of_some_segments_is_missing_in_the_others(self, tmp_path):
        written(tmp_path / "a.csv", "t,gx\n0,1\n")
        written(tmp_path / "b.csv", "t,az,mx\n1,9\n1,9,2\n")
        recording = load_samples(tmp_path)
        assert recording.axes == ("gx", "az")
        assert np.array_equal(recording.values[:, 0], [1.0, np.nan], equal_nan=True)
        assert any(note.startswith("b.csv: Other columns") for note in recording.notes)

    def test_a_segment_that_cannot_be_read_is_left_out(self, tmp_path):
        written(tmp_path / "a.csv", ROWS)
        written(tmp_path / "b.csv", "")
        recording = load_samples(tmp_path)
        assert len(recording) == 3
        assert len(recording.notes) == 1
        assert "b.csv: the file is empty" in recording.notes[0]

    def test_times_that_start_again_are_noted(self, tmp_path):
        written(tmp_path / "a.csv", ROWS)
        written(tmp_path / "b.csv", ROWS)
        recording = load_samples(tmp_path)
        assert recording.t_s.tolist() == [0.0, 0.1, 0.2] * 2
        assert "at 1 of 1 joints" in recording.notes[0]

    def test_rates_without_times(self, tmp_path):
        np.savez(tmp_path / "a.npz", fs=100.0, gx=np.zeros(2))
        np.savez(tmp_path / "b.npz", fs=100.0, gx=np.ones(2))
        recording = load_samples(tmp_path)
        assert (recording.t_s, recording.rate_hz, len(recording)) == (None, 100.0, 4)
        np.savez(tmp_path / "b.npz", fs=50.0, gx=np.ones(2))
        with pytest.raises(RecordingError, match="different rates"):
            load_samples(tmp_path)
        assert load_samples(tmp_path, 50.0).rate_hz == 50.0
        written(tmp_path / "c.csv", ROWS)
        with pytest.raises(RecordingError, match="some segments have t"):
            load_samples(tmp_path, 50.0)

    def test_folders_that_hold_none(self, tmp_path):
        with pytest.raises(RecordingError, match="no recordings in this folder"):
            load_samples(tmp_path)
        written(tmp_path / "a.csv", "")
        written(tmp_path / "b.csv", "x,y\n1,2\n")
        with pytest.raises(RecordingError, match=r"none of 2 segments can be read.*a\.csv"):
            load_samples(tmp_path)


class TestTheEndAlone:
    def test_of_a_folder_only_its_last_segments_are_read(self, tmp_path):
        t, values, temperature = samples(300)
        for name, rows in (("b.npz", slice(100, 200)), ("c.arrows", slice(200, 300))):
            save_samples(tmp_path / name, t[rows], values[rows], temperature[rows])
        written(tmp_path / "a.csv", "no recording")  # would be told
        recording = load_samples(tmp_path, last_s=1.25)
        assert np.array_equal(recording.t_s, t[175:])
        assert np.array_equal(recording.values, values[175:])
        assert np.array_equal(recording.temperature_c, temperature[175:])
        assert recording.notes == ("Only the last 1.25 s are used, 125 samples.",)
        assert len(load_samples(tmp_path, last_s=60.0)) == 200

    def test_of_a_file_with_every_format(self, path):
        t, values, temperature = samples(300)
        save_samples(path, t, values, temperature)
        recording = load_samples(path, last_s=0.5)
        assert np.array_equal(recording.t_s, t[250:])
        assert np.array_equal(recording.values, values[250:])

    def test_without_times_by_the_rate(self, tmp_path):
        for name in ("a.npz", "b.npz", "c.npz"):
            np.savez(tmp_path / name, fs=100.0, gx=np.full(100, float(ord(name[0]))))
        recording = load_samples(tmp_path, last_s=1.5)
        assert recording.values[:, 0].tolist() == [float(ord("b"))] * 50 + [float(ord("c"))] * 100

    def test_no_sample_is_older_even_where_times_go_back(self, tmp_path):
        path = written(tmp_path / "a.csv", "t,gx\n10,1\n11,2\n3,3\n10.5,4\n11.5,5\n")
        assert load_samples(path, last_s=2.0).values[:, 0].tolist() == [4.0, 5.0]


class TestRoom:
    def test_a_folder_that_does_not_fit_is_refused(self, tmp_path, monkeypatch):
        t, values, temperature = samples(300)
        for i in range(3):
            save_samples(tmp_path / f"{i}.npz", 3.0 * i + t, values, temperature)
        monkeypatch.setattr(memory_check, "available_bytes", lambda: 3 * 500 * 64)
        with pytest.raises(ConfigError, match=r"GB of memory would be needed.*--last 1d") as error:
            load_samples(tmp_path)
        assert str(error.value).startswith(f"{tmp_path}: ")
        assert len(load_samples(tmp_path, last_s=1.0)) == 100
        monkeypatch.setattr(memory_check, "available_bytes", lambda: None)
        assert len(load_samples(tmp_path)) == 900

    @pytest.mark.parametrize(("text", "free"), [
        ("MemTotal:  16000 kB\nMemAvailable:    2000 kB\n", 2_048_000), ("MemTotal: 5 kB\n", None), ("", None),
        ("MemAvailable:\n", None), ("MemAvailable: x kB\n", None),
    ])  # fmt: skip
    def test_what_the_system_says(self, tmp_path, text, free):
        assert memory_check.available_system_bytes(written(tmp_path / "meminfo", text)) == free
        assert memory_check.available_system_bytes(tmp_path / "absent") is None

    def test_a_control_group_leaves_less(self, tmp_path):
        def group(name, **files):
            (tmp_path / name).mkdir(parents=True, exist_ok=True)
            for file, text in files.items():
                (tmp_path / name / file.replace("__", ".")).write_text(text)

        own = written(tmp_path / "own", "0::/service/imu\n")
        assert memory_check.available_cgroup_bytes(tmp_path / "absent", tmp_path) is None
        assert memory_check.available_cgroup_bytes(own, tmp_path) is None
        group("service/imu", memory__max="max\n", memory__current="5000\n")
        assert memory_check.available_cgroup_bytes(own, tmp_path) is None
        stat = "anon 4000\nactive_file 300\ninactive_file 700\n"
        group("service", memory__max="9000\n", memory__current="6000\n", memory__stat=stat)
        assert memory_check.available_cgroup_bytes(own, tmp_path) == 4000
        group("service/imu", memory__max="7000\n", memory__current="5000\n")
        assert memory_check.available_cgroup_bytes(own, tmp_path) == 2000

    def test_a_control_group_of_version_1(self, tmp_path):
        own = written(tmp_path / "own", "7:cpu,cpuacct:/a\n4:memory:/a\n")
        (tmp_path / "memory" / "a").mkdir(parents=True)
        written(tmp_path / "memory/a/memory.limit_in_bytes", "9000\n")
        written(tmp_path / "memory/a/memory.usage_in_bytes", "6000\n")
        written(tmp_path / "memory/a/memory.stat", "total_inactive_file 500\ninactive_file 9\n")
        assert memory_check.available_cgroup_bytes(own, tmp_path) == 3500

    def test_a_limit_of_the_process(self, tmp_path, monkeypatch):
        page = resource.getpagesize()
        statm = written(tmp_path / "statm", "500 100 50 10 0 200 0\n")
        limits = {resource.RLIMIT_AS: resource.RLIM_INFINITY, resource.RLIMIT_DATA: resource.RLIM_INFINITY}
        monkeypatch.setattr(resource, "getrlimit", lambda kind: (limits[kind], limits[kind]))
        assert memory_check.available_rlimit_bytes(statm) is None
        assert memory_check.available_rlimit_bytes(tmp_path / "absent") is None
        limits[resource.RLIMIT_AS] = 1500 * page
        assert memory_check.available_rlimit_bytes(statm) == 1000 * page
        limits[resource.RLIMIT_DATA] = 300 * page
        assert memory_check.available_rlimit_bytes(statm) == 100 * page

    def test_the_least_counts(self, monkeypatch):
        for name, free in (
            ("available_system_bytes", 900),
            ("available_cgroup_bytes", None),
            ("available_rlimit_bytes", 300),
        ):
            monkeypatch.setattr(memory_check, name, lambda free=free: free)
        assert memory_check.available_bytes() == 300
        monkeypatch.setattr(memory_check, "available_rlimit_bytes", lambda: -5)
        assert memory_check.available_bytes() == 0

    def test_a_file_that_does_not_fit_is_refused_before_it_is_read(self, path, monkeypatch):
        save_samples(path, *samples(3000))
        monkeypatch.setattr(memory_check, "available_bytes", lambda: 3 * 64 * 2500)
        with pytest.raises(ConfigError, match="GB of memory would be needed"):
            load_samples(path)
        monkeypatch.setattr(memory_check, "available_bytes", lambda: 3 * 64 * 3500)
        assert len(load_samples(path)) == 3000

    @pytest.mark.parametrize("suffix", [".csv.gz", ".npz", ".parquet", ".arrow", ".arrows"])
    def test_rows_beyond_what_the_file_can_hold(self, tmp_path, suffix, monkeypatch):
        path = tmp_path / f"x{suffix}"
        n = 400_000
        if suffix == ".arrow" or suffix == ".arrows":
            pa = pytest.importorskip("pyarrow")
            batch = pa.record_batch({"gx": pa.nulls(n)})
            with (pa.ipc.new_file if suffix == ".arrow" else pa.ipc.new_stream)(str(path), batch.schema) as writer:
                writer.write_batch(batch)
        elif suffix == ".csv.gz":
            written(path, "gx\n" + "0\n" * n)
        elif suffix == ".npz":
            np.savez_compressed(path, gx=np.zeros(n))
        else:
            parquet = pytest.importorskip("pyarrow.parquet")
            parquet.write_table(pytest.importorskip("pyarrow").table({"gx": np.zeros(n)}), path)
        assert len(load_samples(path, 100.0)) == n  # below the number of rows that any file may have
        monkeypatch.setattr(memory_check, "MIN_ROW_LIMIT", n // 2)
        with pytest.raises(RecordingError, match=r"rows in a file of \d+ bytes are not measured samples"):
            load_samples(path, 100.0)

    @pytest.mark.parametrize("suffix", [".npz", ".csv.gz", ".parquet", ".arrow", ".mat"])
    def test_a_small_file_that_would_need_more_than_500_mb_is_refused_within_500_mb(self, tmp_path, suffix):
        path = tmp_path / f"x{suffix}"
        n = 12_000_000
        if suffix == ".npz":
            np.savez_compressed(path, gx=np.zeros(n), fs=np.array(100.0))
        elif suffix == ".csv.gz":
            written(path, "gx\n" + "0\n" * n)
        elif suffix == ".mat":
            savemat = pytest.importorskip("scipy.io").savemat
            savemat(path, {"gx": np.zeros((n, 1)), "gy": np.zeros((n, 1)), "gz": np.zeros((n, 1))}, do_compression=True)
        else:
            pa = pytest.importorskip("pyarrow")
            columns = pa.table({"gx": np.zeros(n)})
            if suffix == ".parquet":
                pytest.importorskip("pyarrow.parquet").write_table(columns, path)
            else:
                options = pa.ipc.IpcWriteOptions(compression="zstd")
                with pa.ipc.new_file(str(path), columns.schema, options=options) as writer:
                    writer.write_table(columns)
        assert path.stat().st_size < 5_000_000
        code = (
            "import re, sys; from pathlib import Path; from drivers.recordings import load_samples\n"
            "try: load_samples(Path(sys.argv[1]), 100.0)\n"
            "except ValueError as error: print(error)\n"
            "print(1024 * int(re.search('VmHWM:[^0-9]*([0-9]+)', Path('/proc/self/status').read_text())[1]))\n"
        )
        output = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, check=True).stdout
        *message, peak_bytes = output.splitlines()
        assert int(peak_bytes) < 500e6
        assert len(message) == 1
        assert message[0].startswith(f"{path}: ")
        assert "store it without compression" in message[0]

    def test_a_file_that_unpacks_to_more_than_the_limit(self, tmp_path, monkeypatch):
        text = written(tmp_path / "x.csv.gz", "t,gx\n" + ("0,1" + " " * 5000 + "\n") * 2000)
        np.savez_compressed(tmp_path / "x.npz", gx=np.zeros(10**6))
        cut = written(tmp_path / "y.npz", (tmp_path / "x.npz").read_bytes()[:-22])
        assert len(load_samples(text)) == 2000
        assert len(load_samples(cut, 100.0)) == 10**6
        monkeypatch.setattr(memory_check, "MIN_UNPACKED_LIMIT_BYTES", 5_000_000)
        for path in (text, cut):
            with pytest.raises(RecordingError, match="unpacks to more than"):
                load_samples(path, 100.0)

    def test_memory_that_is_not_there_is_one_line(self, tmp_path, monkeypatch):
        def fail(*_args):
            raise MemoryError

        path = written(tmp_path / "x.csv", ROWS)
        monkeypatch.setattr("drivers.recordings.file_formats.csv_format.np.concatenate", fail)
        with pytest.raises(ConfigError, match=r"x\.csv: does not fit into the memory that is free"):
            load_samples(path)


class TestLimits:
    @pytest.mark.parametrize("suffix", TEXTS)
    def test_a_line_without_end_ends_the_reading(self, tmp_path, suffix):
        recording = load_samples(written(tmp_path / f"x{suffix}", ROWS + "0" * (3 * MAX_LINE_BYTES)))
        assert len(recording) == 3
        assert recording.notes == ("Line 5 is longer than 1048576 bytes; the file was read up to this line.",)
        with pytest.raises(RecordingError, match=r"not one complete line.*Line 1 is longer than 1048576 bytes"):
            load_samples(written(tmp_path / f"y{suffix}", "t,gx," + "x" * (3 * MAX_LINE_BYTES)))

    def test_zeros_at_the_end_as_after_a_power_cut(self, tmp_path):
        recording = load_samples(written(tmp_path / "x.csv", ROWS.encode() + bytes(5 * MAX_LINE_BYTES)))
        assert len(recording) == 3

    def test_mostly_bad_lines_are_not_all_looked_at(self, tmp_path, monkeypatch):
        path = written(tmp_path / "x.csv", "t,gx\n" + "x\n" * 2 * READ_BYTES)
        with pytest.raises(RecordingError, match=r"\d{6} of \d{6} lines are not samples \(line 2"):
            load_samples(path)

    def test_empty_members_of_gzip(self, tmp_path):
        path = tmp_path / "x.csv.gz"
        path.write_bytes(gzip.compress(b"") * 500 + gzip.compress(ROWS.encode()) + gzip.compress(b"") * 5000)
        recording = load_samples(path)
        assert len(recording) == 3
        assert recording.notes == ("1001 consecutive gzip members are empty; the file was read up to these members.",)

    @pytest.mark.parametrize("suffix", [".csv", ".npz", ".parquet", ".arrows"])
    def test_columns_beyond_the_limit(self, tmp_path, suffix, monkeypatch):
        monkeypatch.setattr(memory_check, "MAX_COLUMNS", 20)
        path = tmp_path / f"x{suffix}"
        names = ["gx", *(f"c{i}" for i in range(25))]
        if suffix == ".csv":
            written(path, ",".join(names) + "\n" + ",".join("1" * 1 for _ in names) + "\n")
        elif suffix == ".npz":
            np.savez(path, **{name: np.zeros(2) for name in names})
        else:
            pa = pytest.importorskip("pyarrow")
            table = pa.table({name: [0.0] for name in names})
            if suffix == ".parquet":
                pytest.importorskip("pyarrow.parquet").write_table(table, path)
            else:
                with pa.ipc.new_stream(str(path), table.schema) as writer:
                    writer.write_table(table)
        with pytest.raises(RecordingError, match="has 26 columns, expected at most 20"):
            load_samples(path, 100.0)

    def test_an_archive_that_states_more_than_it_holds(self, tmp_path):
        path = tmp_path / "x.npz"
        data = io.BytesIO()
        np.lib.format.write_array_header_1_0(data, {"descr": "<f8", "fortran_order": False, "shape": (10**6,)})
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("gx.npy", data.getvalue() + bytes(80))
        with pytest.raises(RecordingError, match="its header states 1000000 values, its data hold 10 at most"):
            load_samples(path, 100.0)

    @pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
    def test_an_archive_packed_otherwise(self, tmp_path, method):
        path, plain = tmp_path / "x.npz", tmp_path / "plain.npz"
        np.savez(plain, gx=np.zeros(5))
        with zipfile.ZipFile(plain) as archive, zipfile.ZipFile(path, "w", method) as other:
            other.writestr("gx.npy", archive.read("gx.npy"))
        with pytest.raises(RecordingError, match=rf"gx is packed by method {method} of zip, expected stored"):
            load_samples(path, 100.0)

    def test_dictionaries_beyond_the_limit(self, tmp_path, monkeypatch):
        pa = pytest.importorskip("pyarrow")
        path = tmp_path / "x.arrows"
        words = pa.array(["x" * 1000, "y"]).dictionary_encode()
        batch = pa.record_batch({"gx": [1.0, 2.0], "word": words, "t": [0.0, 1.0]})
        with pa.ipc.new_stream(str(path), batch.schema) as writer:
            writer.write_batch(batch)
        assert load_samples(path).values[:, 0].tolist() == [1.0, 2.0]
        monkeypatch.setattr(arrow_format, "MAX_DICTIONARY_BYTES", 900)
        with pytest.raises(RecordingError, match=r"its dictionaries unpack to 10.. bytes, expected at most 900"):
            load_samples(path)


class TestArrowMessages:
    @pytest.mark.parametrize("compression", [None, "lz4", "zstd"])
    @pytest.mark.parametrize("suffix", [".arrow", ".arrows"])
    def test_sizes_are_those_that_pyarrow_reads(self, tmp_path, suffix, compression):
        pa = pytest.importorskip("pyarrow")
        path = tmp_path / f"x{suffix}"
        columns = {
            "gx": np.zeros(5000),
            "k": np.arange(5000, dtype=np.int32),
            "s": ["word"] * 5000,
            "z": pa.nulls(5000),
        }
        table = pa.table(columns | {"d": pa.array(["a", None] * 2500).dictionary_encode()})
        new = pa.ipc.new_file if suffix == ".arrow" else pa.ipc.new_stream
        with new(str(path), table.schema, options=pa.ipc.IpcWriteOptions(compression=compression)) as writer:
            writer.write_table(table, max_chunksize=2000)
        with path.open("rb") as file:
            dictionary, *batches = iter_batch_sizes(file, 8 if suffix == ".arrow" else 0)
        assert dictionary.dictionary
        assert [batch.rows for batch in batches] == [2000, 2000, 1000]
        counts = [count_column_buffers(pa, field.type) for field in table.schema]
        assert counts == [2, 2, 3, 0, 2]
        for batch in batches:
            assert len(batch.buffers) == sum(counts)
            assert batch.buffers[1] == 8 * batch.rows
            assert batch.buffers[3] == 4 * batch.rows
            assert batch.buffers[6] == 4 * batch.rows
            assert check_batch_buffer_sizes(batch, counts, 0) == ""
        assert "unpacks to 16000 bytes" in check_batch_buffer_sizes(replace(batches[0], rows=1999), counts, 0)
        assert check_batch_buffer_sizes(replace(batches[0], rows=1999), [-2, -2, -3, 0, -2], 0) == ""
        assert check_batch_buffer_sizes(replace(batches[0], rows=0), [-2, None], 0) != ""

    def test_any_cut_and_any_byte_end_quietly(self, tmp_path):
        path = tmp_path / "x.arrows"
        pytest.importorskip("pyarrow")
        save_samples(path, *samples(50))
        data = path.read_bytes()
        rng = np.random.default_rng(2)
        for cut in range(0, len(data), 7):
            assert len(list(iter_batch_sizes(io.BytesIO(data[:cut])))) <= 1
        for _ in range(500):
            damaged = bytearray(data)
            damaged[int(rng.integers(len(data)))] = int(rng.integers(256))
            assert len(list(iter_batch_sizes(io.BytesIO(damaged)))) <= 2


@pytest.mark.data
class TestRealRecordings:
    """Every public recording loads, or says the one thing that is wrong with it."""

    NO_RATE = ("hub-RX.csv", "hub-TH.csv")
    NO_AXIS = ("raw-counts.npz",)

    @pytest.fixture
    def folder(self):
        return recordings()

    @pytest.mark.long
    def test_all_load(self, folder):
        files = sorted([*folder.glob("*/*.npz"), *folder.glob("lego-hub-temp/*.csv")])
        assert len(files) >= 25
        for file in files:
            if file.name in self.NO_AXIS:
                with pytest.raises(RecordingError, match="no axis among its columns"):
                    load_samples(file)
                continue
            if file.name in self.NO_RATE:
                with pytest.raises(ConfigError, match="--rate HZ"):
                    load_samples(file)
                recording = load_samples(file, 1.0 / 15.0)
            else:
                recording = load_samples(file)
            present = [AXES.index(axis) for axis in recording.axes]
            assert len(recording) > 100, file
            assert np.isfinite(recording.values[:, present]).all(), file
            assert sum(map(len, iter_blocks(recording))) == len(recording)

    def test_npz_is_what_numpy_reads(self, folder):
        file = folder / "ig500n" / "static-2h.npz"
        recording = load_samples(file)
        with np.load(file) as archive:
            assert recording.rate_hz == float(archive["fs"])
            assert np.array_equal(recording.values[:, 2], archive["gz"].astype(float))
            assert np.array_equal(recording.temperature_c, archive["temp"].astype(float))
        assert recording.notes == ("Other columns are not used: temp2, mx, my, mz, roll_deg, pitch_deg, yaw_deg.",)

    def test_frames_beside_a_recording_are_left_out(self, folder):
        recording = load_samples(folder / "can-boat")
        assert len(recording) == 29_965
        assert "moored-5min-frames.csv.gz: no axis" in recording.notes[0]
