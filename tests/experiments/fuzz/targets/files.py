"""Fuzz targets of every format of recordings and logs: truncated, damaged, or with wrong lengths.

A recording contains finite numbers or NaN, equally many in each column, and times that fit into int64 nanoseconds. A
log contains chunks with possible sizes and times, or ends with an error of its link.
"""

import gzip
import io
import json
import struct
import tempfile
import zipfile
from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any, Final
from unittest import mock

import numpy as np

from drivers.errors import ConfigError, LinkEnded, LinkUnavailable, RecordingError
from drivers.links.replay_link import Settings, build
from drivers.recordings import FORMATS, WRITABLE, iter_blocks, load_samples, memory_check, save_samples
from tests.experiments.fuzz.checks import check_error_message
from tests.experiments.fuzz.input_reader import InputReader
from tests.experiments.fuzz.target import Check, target

LARGEST_NS: Final = 1 << 62
MEMORY_FOLDER: Final = Path("/dev/shm") if Path("/dev/shm").is_dir() else None
RATE_HZ: Final = 100.0
FREE_BYTES: Final = 100_000_000
"""Free memory that the readers see. They reject a file that only declares a large recording."""


@cache
def get_folder() -> Path:
    """Return the folder of this process, which is in memory if possible."""
    folder = tempfile.TemporaryDirectory(dir=MEMORY_FOLDER)
    _FOLDERS.append(folder)
    return Path(folder.name)


_FOLDERS: Final[list[tempfile.TemporaryDirectory[str]]] = []


def check_recording(path: Path) -> None:
    """Read a recording and check its contents."""
    try:
        with mock.patch.object(memory_check, "available_bytes", return_value=FREE_BYTES):
            recording = load_samples(path, RATE_HZ)
    except (RecordingError, ConfigError) as error:
        check_error_message(error)
        return
    n = len(recording)
    assert n >= 1
    assert recording.values.shape == (n, 6)
    assert recording.temperature_c.shape == (n,)
    assert not np.isinf(recording.values).any()
    assert not np.isinf(recording.temperature_c).any()
    assert recording.rate_hz is None or 0.0 < recording.rate_hz < float("inf"), recording.rate_hz
    if recording.t_s is not None:
        assert recording.t_s.shape == (n,)
        assert (np.abs(recording.t_s) * 1e9 < LARGEST_NS).all()
    for note in recording.notes:
        assert "\n" not in note, "a note of several lines"
        assert len(note) < 2000, "a note that is too long"
    rows = 0
    for block in iter_blocks(recording, 4096):
        rows += len(block)
        assert (np.abs(block.t_ns) < LARGEST_NS).all()
    assert rows == n


def make_recording_check(suffix: str) -> Check:
    """Return the check of one format, which reads the bytes as a file."""

    def check(data: bytes) -> None:
        path = get_folder() / f"a{suffix}"
        path.write_bytes(data)
        check_recording(path)

    return check


def recording_seeds(suffix: str) -> Iterator[bytes]:
    """Return recordings that the project writes, and truncated ones."""
    rng = np.random.default_rng(7)
    if suffix in (".mat", ".zip"):
        yield from _matlab_seeds() if suffix == ".mat" else _sensor_archive_seeds()
        return
    if suffix not in WRITABLE:
        yield from robot_log_seeds(suffix)
        return
    for n, axes in ((3, ("gz",)), (12, ("gx", "gy", "gz", "ax", "ay", "az"))):
        path = get_folder() / f"seed{suffix}"
        values = np.round(rng.normal(size=(n, 6)), 2)
        save_samples(path, np.arange(n) * 0.01, values, np.full(n, 25.0), axes)
        data = path.read_bytes()
        yield data
        yield data[: len(data) * 2 // 3]
    if suffix == ".csv":
        yield b't,gx,"az",temp\r\n0,1,,nan\r\n0.01,inf,"2",\r\n\r\n0.02,1e999,x,3\r\n0.03,1,2,3\r\n'
        yield b"#timestamp [ns],w_RS_S_x [rad s^-1]\n# remark\n1403636579758555392,0.1\n1403636579763555584,0.2\n"
        yield b'sep=;\n"Time (ms)";"Gyro x (deg/s)";\n"0,5";1,5;\n1;2e1;\n'
        yield b"time_us\tax_g\ttemp_k\n1\t2,5\t300\n2\t2,5\t300\n"
        yield b"loopIteration, time (us), gyroADC[0], accSmooth[2]\n1, 500, -4, 2048\n2, 1000, -4, 2048\n"
        yield b"stamp wx wy\n 0.1  1 2\n0.2 1 2\n"
    if suffix == ".npz":
        packed = io.BytesIO()
        np.savez(packed, fs=np.array(100), gz=np.arange(4.0), ax=np.arange(4, dtype=np.int16))
        yield packed.getvalue()
    if suffix in (".arrow", ".parquet", ".arrows"):
        yield from _arrow_seeds(suffix)


def _matlab_seeds() -> Iterator[bytes]:
    """Return MATLAB files with vectors, matrices and structures, as SciPy writes them."""
    from scipy.io import savemat

    t, values = np.arange(6) * 0.01, np.ones((6, 3))
    for compress in (False, True):
        file = io.BytesIO()
        savemat(file, {"t": t, "gyro": values, "imu": {"acc": values.T}, "fs": 100.0}, do_compression=compress)
        yield file.getvalue()


def _sensor_archive_seeds() -> Iterator[bytes]:
    """Return zip archives with one CSV file per sensor."""
    for method in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w", method) as archive:
            for name in ("Gyroscope", "Accelerometer"):
                archive.writestr(
                    f"{name}.csv", "time,seconds_elapsed,z,y,x\n1,0.00,1,2,3\n2,0.01,1,2,3\n3,0.02,1,2,3\n"
                )
        yield file.getvalue()


def robot_log_seeds(suffix: str) -> Iterator[bytes]:
    """Logs that the libraries of their formats write or read."""
    from tests.support.dataflash import dataflash_bytes, imu, raw_sensor
    from tests.support.ros_bags import imu_topic, storage_file, write_bag
    from tests.support.ulog import sensor_combined, ulog_bytes, vehicle_imu

    t_us, values = 1_000_000 + 10_000 * np.arange(4), np.ones((4, 6))
    if suffix == ".ulg":
        yield ulog_bytes([sensor_combined(t_us, values), vehicle_imu(t_us, values, 10_000)])
        return
    if suffix == ".bin":
        yield dataflash_bytes([imu(t_us, values), raw_sensor("GYR", t_us, values[:, :3], 1)])
        return
    kinds = {".bag": ("ros1", "ros1-bz2", "ros1-lz4"), ".db3": ("sqlite",), ".mcap": ("mcap", "mcap-chunk")}
    for kind in kinds[suffix]:
        with tempfile.TemporaryDirectory() as place:
            path = write_bag(Path(place), kind, {"/imu": imu_topic(1000 * t_us, values)})
            yield storage_file(path).read_bytes()


def _arrow_seeds(suffix: str) -> Iterator[bytes]:
    """Return tables with other types, nulls, compression and dictionaries."""
    import pyarrow as pa
    from pyarrow import parquet

    table = pa.table(
        {
            "t": pa.array([0.0, 0.01, None, 0.03]),
            "gz": pa.array([1, 2, None, 4], pa.int16()),
            "ax": pa.array([1.0, 1.0, 1.0, 1.0], pa.float32()),
            "word": pa.array(["a", "b", "a", None]).dictionary_encode(),
        }
    )
    for compression in ("lz4", "zstd", None):
        sink = io.BytesIO()
        if suffix == ".parquet":
            parquet.write_table(table, sink, compression=compression or "none")
        else:
            new = pa.ipc.new_file if suffix == ".arrow" else pa.ipc.new_stream
            with new(sink, table.schema, options=pa.ipc.IpcWriteOptions(compression=compression)) as writer:
                writer.write_table(table)
        yield sink.getvalue()


SIZES: Final = {".csv": 2000, ".csv.gz": 2000}
WORDS: Final = {
    ".csv": (
        "t,gx,gy,gz\n", "temp", "nan", "inf", "1e999", "\r\n", '"', ",", "\0", "-9.3e9", "#", "1_0", ";", "\t", " ",
        "sep=;", "[deg/s]", "time,",
    ),
    ".mat": (b"\x0e\0\0\0", b"\x0f\0\0\0", b"\x06\0\0\0", b"\x09\0\0\0", b"\xff\xff\xff\x7f", "gyro"),
    ".zip": ("PK\3\4", "PK\1\2", "PK\5\6", "Gyroscope.csv", "seconds_elapsed,"),
    ".npz": ("PK\3\4", "PK\1\2", "PK\5\6", "gz.npy", "t.npy", "fs.npy", "\x93NUMPY", "'<f8'", "(99999999999,)"),
    ".parquet": ("PAR1", "gz", "t"),
    ".arrow": ("ARROW1\0\0", b"\xff\xff\xff\xff"),
    ".arrows": (b"\xff\xff\xff\xff", b"\0\0\0\0"),
}  # fmt: skip

for _suffix in FORMATS:
    _name = f"recording-{_suffix[1:].replace('.', '-')}"
    target(_name, partial(recording_seeds, _suffix), SIZES.get(_suffix, 6000), WORDS.get(_suffix, ()))(
        make_recording_check(_suffix)
    )


@target(
    "recording-npz-arrays",
    [bytes([i, 1, 1, *b"\x08" * 20, *range(60)]) for i in range(6)],
    1000,
    ("'descr': '<f8', 'fortran_order': False, 'shape': (4,), }", "'|O'", "(9999999999,)", "('<f8', (3,))", "'<U9'"),
)
def npz_arrays(data: bytes) -> None:
    """Check a complete archive of arrays with any headers."""
    reader = InputReader(data)
    with zipfile.ZipFile(packed := io.BytesIO(), "w") as archive:
        for name in ("t", "gz", "fs", "temperature")[: 1 + reader.read_byte() % 4]:
            kind = reader.read_byte()
            body = reader.read_piece() * (1 + reader.read_byte() % 16 * (kind & 1) * 100)
            header = reader.read_piece() if kind & 2 else _header(reader).encode()
            version = (1, 2, 3, 9)[kind >> 2 & 3 if kind & 16 else 0]
            size = struct.pack("<H" if version == 1 else "<I", len(header))
            how = zipfile.ZIP_DEFLATED if kind & 32 else zipfile.ZIP_STORED
            archive.writestr(f"{name}.npy", b"\x93NUMPY" + bytes([version, 0]) + size + header + body, how)
    whole = packed.getvalue()
    path = get_folder() / "a.npz"
    path.write_bytes(whole[: -22 if reader.read_byte() & 1 else None])
    check_recording(path)


def _header(reader: InputReader) -> str:
    dtype = reader.choose(
        ("'<f8'", "'<i2'", "'>f4'", "'|u1'", "'<f2'", "'|O'", "'<c16'", "'|b1'", "'<M8[s]'", "[('a', '<f8')]")
    )
    shape = reader.choose(
        ("(4,)", "(7,)", "()", "(2, 2)", "(99999999999,)", "(300000000,)", "(-1,)", "(0,)", "(1 << 3,)")
    )
    return f"{{'descr': {dtype}, 'fortran_order': {reader.read_byte() % 2 == 1}, 'shape': {shape}, }}\n"


# --- logs


def check_replay(path: Path, channel: str | None = None) -> None:
    """Replay a file to its end and check its chunks."""
    try:
        link = build(Settings(path=str(path), speed="max", channel=channel))
    except ConfigError as error:
        check_error_message(error)
        return
    try:
        with mock.patch.object(memory_check, "available_bytes", return_value=FREE_BYTES):
            link.open()
        for _ in range(1000):
            for chunk in link.wait_for_chunks_or_timeout(0.0) or []:
                assert abs(chunk.t_ns) < LARGEST_NS, "a time beyond int64"
                assert 0 <= chunk.address < 1 << 32, "no CAN identifier"
                if link.carrier == "frames":
                    assert len(chunk.data) <= 64, "longer than any CAN frame"
    except (LinkUnavailable, LinkEnded) as error:
        check_error_message(error)
    finally:
        link.close()


def make_log_check(suffix: str) -> Check:
    """Return the check of one format of logs."""

    def check(data: bytes) -> None:
        path = get_folder() / f"log{suffix}"
        path.write_bytes(data)
        check_replay(path)

    return check


def log_seeds(suffix: str) -> Iterator[bytes]:
    """Return logs that python-can writes."""
    import can

    for options in ({}, {"compression_level": 0}) if suffix == ".blf" else ({},):
        path = get_folder() / f"seed-log{suffix}"
        with can.Logger(path, **options) as log:
            _write_messages(log)
        yield path.read_bytes()


def _write_messages(log: Any) -> None:
    import can

    for i in range(6):
        identifier = 0x123 + (i << 20 if i % 2 else 0)
        log(
            can.Message(
                1.7e9 + 0.01 * i,
                identifier,
                bool(i % 2),
                channel=0,
                is_rx=i != 3,
                is_fd=i == 4,
                data=bytes(range(i + 2)),
            )
        )


LOG_WORDS: Final = {
    ".asc": (
        "date ",
        "base hex timestamps absolute\n",
        "Begin Triggerblock\n",
        "CANFD",
        "ErrorFrame",
        " Rx d 8 ",
        "1e999",
    ),
    ".log": ("(1700000000.01)", "can0 123#", "##1", "#R8", "1e999", "nan"),
    ".trc": (";$FILEVERSION=2.1\n", ";$STARTTIME=43000.5\n", ";$COLUMNS=N,O,T,B,I,d,R,L,D\n", " DT ", "Rx", "1e999"),
    ".csv": ("timestamp,arbitration_id,extended,remote,error,dlc,data\n", "0x123", "1e999", "nan", "AQI="),
    ".blf": ("LOGG", "LOBJ", b"\xff\xff\xff\xff", b"\0\0\0\0", b"\x0a\0\0\0"),
}

for _suffix in (".asc", ".blf", ".log", ".trc", ".csv"):
    target(f"log-{_suffix[1:]}", partial(log_seeds, _suffix), 2000, LOG_WORDS[_suffix])(make_log_check(_suffix))

FRAMES: Final = b"t,id_hex,data_hex,bus,extended\n0.01,123,0102ff,0,0\n0.02,18F02980,01,1,1\n"


@target("log-frames-csv", [FRAMES], 600, ("1e999", "nan", "-1", "0x", "ffffffffffffffffff", '"', "\r\n", "inf"))
def log_frames(data: bytes) -> None:
    """Check a CSV file of CAN frames with a valid header."""
    path = get_folder() / "frames.csv"
    path.write_bytes(data if data[:1] == b"t" else b"t,id_hex,data_hex,bus,extended\n" + data)
    check_replay(path, "1" if data[-1:] == b"\n" else None)


@target("log-gz", lambda: [gzip.compress(FRAMES, mtime=0)], 600)
def log_compressed(data: bytes) -> None:
    """Check compressed CAN frames and compressed captured bytes."""
    for name in ("frames.csv.gz", "a.bin.gz", "a.log.gz"):
        path = get_folder() / name
        path.write_bytes(data)
        check_replay(path)


@target("log-recording", lambda: [json.dumps({"t": [0, 1, 2], "gz": [1, 2, 3]}).encode()], 400)
def log_recording(data: bytes) -> None:
    """Check the replay of a recording with any times."""
    reader = InputReader(data)
    rows = [",".join(repr(reader.read_special_float()) for _ in range(2)) for _ in range(1 + reader.read_byte() % 40)]
    path = get_folder() / "replayed.csv"
    path.write_text("t,gz\n" + "\n".join(rows) + "\n")
    check_replay(path)
