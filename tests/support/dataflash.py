"""ArduPilot logs, written by the published layout of the DataFlash format (ArduPilot, libraries/AP_Logger)."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

HEAD: Final = b"\xa3\x95"
FMT: Final = 0x80
FMT_LAYOUT: Final = struct.Struct("<BB4s16s64s")  # number, length, name, format, names of the fields
FIRST_NUMBER: Final = 0x81
CODES: Final = {"f4": "f", "u8": "Q", "u4": "I", "u2": "H", "u1": "B", "i2": "h", "S64": "a"}


@dataclass(frozen=True, slots=True)
class Messages:
    """Messages of one name, with one row of a structured array per message. The first field is the time."""

    name: str
    rows: np.ndarray[Any, np.dtype[np.void]]
    codes: str = ""  # codes of the fields; "" for those that belong to the types of the array


def format_message(number: int, name: str, length: int, codes: str, fields: Sequence[str]) -> bytes:
    """Return the message that describes the layout of other messages."""
    packed = FMT_LAYOUT.pack(number, length, name.encode(), codes.encode(), ",".join(fields).encode())
    return HEAD + bytes([FMT]) + packed


def dataflash_bytes(messages: Sequence[Messages]) -> bytes:
    """Return a log with all messages in the order of their times."""
    parts = [format_message(FMT, "FMT", 3 + FMT_LAYOUT.size, "BBnNZ", ("Type", "Length", "Name", "Format", "Columns"))]
    timed = []
    numbers: dict[str, int] = {}
    for one in messages:
        fields = one.rows.dtype.names or ()
        number = numbers.setdefault(one.name, FIRST_NUMBER + len(numbers))
        codes = one.codes or "".join(CODES[one.rows.dtype[field].str[1:]] for field in fields)
        parts.append(format_message(number, one.name, 3 + one.rows.dtype.itemsize, codes, fields))
        head = HEAD + bytes([number])
        timed += [(int(row[0]), number, head + row.tobytes()) for row in one.rows]
    return b"".join([*parts, *(data for _, _, data in sorted(timed))])


def write_dataflash(path: Path, *messages: Messages) -> Path:
    path.write_bytes(dataflash_bytes(messages))
    return path


def table_of(**fields: np.ndarray[Any, Any]) -> np.ndarray[Any, np.dtype[np.void]]:
    """Return messages with the given fields [n]."""
    rows = np.zeros(len(next(iter(fields.values()))), [(name, one.dtype) for name, one in fields.items()])
    for name, one in fields.items():
        rows[name] = one
    return rows


def imu(
    t_us: np.ndarray[Any, Any], values: np.ndarray[Any, Any], number: int | None = 0, name: str = "IMU", warm: str = "T"
) -> Messages:
    """Return messages with the values [n, 6] in rad/s and m/s², and 35 °C. Without a number, as in old logs."""
    n = len(t_us)
    columns = zip(("GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ"), values.astype("<f4").T, strict=True)
    instance = {} if number is None else {"I": np.full(n, number, "u1")}
    return Messages(
        name, table_of(TimeUS=t_us.astype("<u8"), **instance, **dict(columns), **{warm: np.full(n, 35, "<f4")})
    )


def raw_sensor(name: str, t_us: np.ndarray[Any, Any], values: np.ndarray[Any, Any], number: int = 0) -> Messages:
    """Return messages GYR or ACC with the values [n, 3]. They are written 2 ms after the sample."""
    fields = [f"{name.title()}{axis}" for axis in "XYZ"]
    return Messages(
        name,
        table_of(
            TimeUS=(t_us + 2000).astype("<u8"),
            I=np.full(len(t_us), number, "u1"),
            SampleUS=t_us.astype("<u8"),
            **dict(zip(fields, values.astype("<f4").T, strict=True)),
        ),
    )


def batches(
    kind: int, starts_us: np.ndarray[Any, Any], counts: np.ndarray[Any, Any], first_number: int, **header: float
) -> tuple[Messages, Messages]:
    """Return messages ISBH and ISBD with batches of counts [batches, samples, 3].

    Parameters
    ----------
    kind
        0 for an accelerometer, 1 for a gyroscope.
    starts_us
        Times of the first samples.
    counts
        Counts; the number of samples is divisible by 32.
    first_number
        Number of the first batch.
    header
        Fields ``instance``, ``mul`` and ``smp_rate`` of ISBH.
    """
    n, size, _ = counts.shape
    numbers = (first_number + np.arange(n)).astype("u2")
    written_us = (starts_us + size * 1_000_000 / header["smp_rate"]).astype("u8")  # after the last sample
    described = table_of(
        TimeUS=written_us,
        N=numbers,
        type=np.full(n, kind, "u1"),
        instance=np.full(n, header["instance"], "u1"),
        mul=np.full(n, header["mul"], "u2"),
        smp_cnt=np.full(n, size, "u2"),
        SampleUS=starts_us.astype("u8"),
        smp_rate=np.full(n, header["smp_rate"], "f4"),
    )
    parts = size // 32
    xyz = counts.astype("<i2").reshape(n * parts, 32, 3)
    samples = table_of(
        TimeUS=(written_us[:, None] + np.arange(1, parts + 1, dtype="u8")).ravel(),
        N=np.repeat(numbers, parts),
        seqno=np.tile(np.arange(parts), n).astype("u2"),
        **{name: np.ascontiguousarray(xyz[:, :, i]).view("S64")[:, 0] for i, name in enumerate("xyz")},
    )
    return Messages("ISBH", described), Messages("ISBD", samples)
