"""Read ArduPilot logs (DataFlash, ``.bin``) with the library pymavlink.

The layout of each message is part of the log (messages ``FMT``). These messages contain samples of an IMU, in rad/s,
m/s² and °C (ArduPilot, page "Onboard Message Log Messages"):

- ``IMU`` contains the gyroscope, the accelerometer and the temperature.
- ``GYR`` and ``ACC`` contain raw samples of one sensor. Their field ``SampleUS`` is the time of the sample.
- ``ISBH`` and ``ISBD`` contain batches of raw samples of one triad in counts, at the rate of the sensor. The message
  ISBH describes a batch, and each of the following messages ISBD contains 32 samples. The autopilot records the batches
  of all triads in turn (AP_InertialSensor, class BatchSampler).

The field ``I`` is the number of the sensor. Logs of older versions use other names instead, such as ``IMU2`` or
``GYR1``.

pymavlink finds the messages, and this module decodes them block by block.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, cast

import numpy as np

from drivers.data_types import AXES, Ints, Times
from drivers.errors import RecordingError, convert_library_errors
from drivers.host.safe_file_reading import open_regular_file
from drivers.recordings import memory_check, table
from drivers.recordings.reading_progress import report_read_share
from drivers.recordings.topic_selection import BLOCK_ROWS, RecordedTopic, join_topics, pair_triads, select_topics

MAGIC: Final = b"\xa3\x95\x80"
"""First bytes of a log: the start of a message, and the number of the message FMT."""
HEAD_BYTES: Final = 3
NAME: Final = re.compile(r"(IMU|GYR|ACC)\d?")
FIELDS: Final[Mapping[str, tuple[str, ...]]] = {
    **{axis: (f"Gyr{name}",) for axis, name in zip(AXES[:3], "XYZ", strict=True)},
    **{axis: (f"Acc{name}",) for axis, name in zip(AXES[3:], "XYZ", strict=True)},
    "temperature": ("T", "Temp"),
}
"""For each column of a recording: the names of the field in new and in old logs."""
TIMES: Final = {"SampleUS": 1_000, "TimeUS": 1_000, "TimeMS": 1_000_000}
"""Fields that contain the time since the autopilot started, with the duration of one unit in ns. The first known field
is used."""
INSTANCE: Final = "I"
INDEX_BYTES_PER_MESSAGE: Final = 40
"""Memory in bytes that pymavlink needs for the position of a message."""
MIN_MESSAGE_BYTES: Final = 20
"""Size of a typical short message in bytes, from which the number of messages is estimated."""
MAX_TRAILING_BYTES: Final = 528
"""Maximum size of the unused end of a log. pymavlink uses the same limit, which is more than two flash pages."""
BATCH_TOPICS: Final = {1: ("ISBD_GYR", AXES[:3]), 0: ("ISBD_ACC", AXES[3:])}
"""Name and columns of the topics with batches, for each value of the field ``type`` of ISBH."""
BATCH_SIZE: Final = 32
"""Number of samples in a message ISBD."""
MIN_BATCH_RATE_HZ: Final = 1.0
"""Sample rate below which a message ISBH is damaged."""
EXPECTED: Final = "messages IMU, GYR and ACC, or ISBH and ISBD"


def is_ardupilot_log(path: Path) -> bool:
    """Return True if a file begins like an ArduPilot log. Return False if the file cannot be read."""
    try:
        with open_regular_file(path) as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError:
        return False


def read_ardupilot_log(path: Path, topic: str | None) -> table.Table:
    """Read the samples of an IMU from an ArduPilot log. A log that is cut off is read up to the cut.

    Parameters
    ----------
    path
        File to read.
    topic
        Name of the messages, with the number of the sensor, such as ``IMU:1``, or several topics joined by ``+``. None
        selects the only IMU of the log.

    Raises
    ------
    RecordingError
        If the file is no ArduPilot log or contains no IMU.
    ConfigError
        If the topic is unknown, or the samples do not fit into memory.
    """
    notes: list[str] = []
    limit = memory_check.measure_read_limit(path)
    with _pymavlink_errors(path), _open_log(path, limit) as log:
        messages = _list_messages(log)
        names = _select(path, messages, topic, notes)
        limit.check_row_count(sum(messages[name].rows for name in names))
        tables = {name: _read_columns(log, messages[name]) for name in names}
        if (end := _end_of_messages(log)) < log.data_len - MAX_TRAILING_BYTES:
            notes.append(f"The log is damaged at byte {end} of {log.data_len} and was read up to there.")
    return table.Table(join_topics(path, tables, notes), None, notes)


@contextmanager
def _open_log(path: Path, limit: memory_check.RecordingSizeLimits) -> Iterator[Any]:
    """Open a log and find its messages."""
    from pymavlink import DFReader

    class Log(DFReader.DFReader_binary):  # type: ignore[misc]
        def init_clock(self) -> None:
            """Skip the search for GPS times, because the times of the messages are used."""

        def init_arrays_fast(self, progress_callback: Any = None) -> None:
            """Find the messages in Python, because the compiled function prints a line for each damaged byte."""
            self.formats = _Formats(vars(self)["formats"])
            self.init_arrays(progress_callback)

    if not is_ardupilot_log(path):
        raise RecordingError(
            f"{path}: is no ArduPilot log, which begins with a message FMT{table.describe_suffix_mismatch(path)}; "
            "captured bytes are decoded by the link replay"
        )
    limit.check_needed_memory(INDEX_BYTES_PER_MESSAGE * limit.size_bytes / MIN_MESSAGE_BYTES)
    vars(DFReader)["print"] = _discard  # pymavlink prints warnings about each damaged byte
    log: Any = Log.__new__(Log)
    try:
        log.__init__(str(path), progress_callback=lambda percent: report_read_share(percent, 100.0))
        yield log
    finally:
        for name in ("data_map", "filehandle"):
            if name in vars(log):
                with suppress(BufferError):  # arrays that refer to the file are still in use
                    getattr(log, name).close()


class _Formats(dict[int, Any]):
    """Layouts of messages by their number. pymavlink would not end if a message had no bytes."""

    def __setitem__(self, number: int, form: Any) -> None:
        if form.len > HEAD_BYTES:
            super().__setitem__(number, form)


def _discard(*_: object, **__: object) -> None:
    """Ignore text that a library prints."""


def _pymavlink_errors(path: Path) -> AbstractContextManager[None]:
    return convert_library_errors(
        lambda cause: f"{path}: the log is damaged ({cause}); copy it from the autopilot again"
    )


# --- topics --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Messages:
    """Messages of one sensor."""

    name: str
    offsets: Ints  # [n] positions in the file
    layout: np.dtype[Any]
    factors: Mapping[str, float]  # factor of each field that is a fixed-point number
    batches: np.ndarray[Any, np.dtype[np.void]] | None = None  # [n] ISBH of each message, if these are ISBD

    @property
    def rows(self) -> int:
        return self.offsets.size * (1 if self.batches is None else BATCH_SIZE)


def _list_messages(log: Any) -> dict[str, _Messages]:
    """Return the messages of each sensor of a log by the name of the topic."""
    found: dict[str, _Messages] = {}
    batches: dict[str, _Messages] = {}
    for form in log.formats.values():
        offsets = np.array(log.offsets[form.type], np.int64)
        offsets = offsets[offsets + form.len <= log.data_len]
        if not offsets.size or not (NAME.fullmatch(form.name) or form.name in ("ISBH", "ISBD")):
            continue
        one = _Messages(form.name, offsets, _layout(form), _factors(form))
        if not NAME.fullmatch(form.name):
            batches[form.name] = one
            continue
        if INSTANCE not in form.columns:
            found[form.name] = one
            continue
        numbers = np.concatenate([block[INSTANCE] for block in _iter_blocks(log, one)])
        for number in np.unique(numbers):
            name = f"{form.name}:{number}" if number else form.name
            found[name] = _Messages(form.name, offsets[numbers == number], one.layout, one.factors)
    return dict(sorted(found.items())) | (
        _list_batches(log, batches["ISBH"], batches["ISBD"]) if len(batches) == 2 else {}
    )


def _list_batches(log: Any, descriptions: _Messages, samples: _Messages) -> dict[str, _Messages]:
    """Return the messages ISBD of each triad. Messages without a usable description are left out."""
    headers = np.concatenate(list(_iter_blocks(log, descriptions)))
    numbers = np.concatenate([block["N"] for block in _iter_blocks(log, samples)])
    order = np.lexsort((descriptions.offsets, headers["N"]))
    headers, described = headers[order], descriptions.offsets[order] + (headers["N"][order].astype(np.int64) << 47)
    preceding = np.searchsorted(described, samples.offsets + (numbers.astype(np.int64) << 47)) - 1
    batch = headers[preceding]  # of the same number, as long as the description is not lost
    with np.errstate(invalid="ignore"):  # a damaged log may contain signalling NaN
        usable = (batch["mul"] > 0) & (batch["smp_rate"] > MIN_BATCH_RATE_HZ) & np.isfinite(batch["smp_rate"])
    usable &= (preceding >= 0) & (batch["N"] == numbers)
    found: dict[str, _Messages] = {}
    for kind, (topic, _) in BATCH_TOPICS.items():
        of_kind = usable & (batch["type"] == kind)
        for number in np.unique(batch["instance"][of_kind]):
            own = of_kind & (batch["instance"] == number)
            name = f"{topic}:{number}" if number else topic
            found[name] = _Messages(topic, samples.offsets[own], samples.layout, samples.factors, batch[own])
    return found


def _end_of_messages(log: Any) -> int:
    """Return the position after the last message that pymavlink has found. It stops at an unknown message."""
    return int(max(log.offsets[form.type][-1] + form.len for form in log.formats.values() if log.offsets[form.type]))


def _layout(form: Any) -> np.dtype[Any]:
    """Return the layout of a message. The codes of ``struct`` are those of NumPy, except for text."""
    from pymavlink.DFReader import FORMAT_TO_STRUCT

    codes = [FORMAT_TO_STRUCT[kind][0] for kind in form.format]
    types = [f"S{code[:-1]}" if code.endswith("s") else f"<{code}" for code in codes]
    layout = np.dtype(list(zip(form.columns, types, strict=True)))
    if layout.itemsize != form.len - HEAD_BYTES:
        raise ValueError(f"{form.name} has {form.len - HEAD_BYTES} bytes, expected {layout.itemsize}")
    return layout


def _factors(form: Any) -> dict[str, float]:
    return {name: factor for name, factor in zip(form.columns, form.msg_mults, strict=True) if factor is not None}


def _select(path: Path, messages: Mapping[str, _Messages], topic: str | None, notes: list[str]) -> list[str]:
    """Return the names of the topics to read."""
    topics = [RecordedTopic(name, one.name, tuple(_known_fields(one)), one.rows) for name, one in messages.items()]
    return select_topics(path, topics, _list_imus(messages), topic, EXPECTED, notes)


def _known_fields(messages: _Messages) -> dict[str, str]:
    """Return the name of the field that contains each column."""
    if messages.batches is not None:
        return dict(zip(dict(BATCH_TOPICS.values())[messages.name], "xyz", strict=True))
    names = messages.layout.names or ()
    return {column: field for column, fields in FIELDS.items() for field in fields if field in names}


def _list_imus(messages: Mapping[str, _Messages]) -> Sequence[Sequence[str]]:
    """Return the IMUs of a log. A gyroscope and an accelerometer with the same number form an IMU."""
    imus, gyros, accels = ([name for name in messages if name.startswith(kind)] for kind in ("IMU", "GYR", "ACC"))
    pairs = pair_triads(gyros, accels, lambda name: name[3:])
    batches = [[name for name, one in messages.items() if one.name == topic] for topic, _ in BATCH_TOPICS.values()]
    return [group for group in (imus, *([pairs] if pairs else [gyros, accels]), *batches) if group]


# --- messages ------------------------------------------------------------------------------------


def _iter_blocks(log: Any, messages: _Messages) -> Iterator[np.ndarray[Any, np.dtype[np.void]]]:
    """Yield messages as structured arrays [n] of up to BLOCK_ROWS messages."""
    data = np.frombuffer(log.data_map, np.uint8)
    within = np.arange(HEAD_BYTES, HEAD_BYTES + messages.layout.itemsize)
    for start in range(0, messages.offsets.size, BLOCK_ROWS):
        rows = data[messages.offsets[start : start + BLOCK_ROWS, None] + within]
        yield rows.view(messages.layout)[:, 0]


def _read_columns(log: Any, messages: _Messages) -> dict[str, Times]:
    """Return the columns of a topic in SI units, with the times in ns."""
    if messages.batches is not None:
        return _read_batches(log, messages, messages.batches)
    time = next((name for name in TIMES if name in (messages.layout.names or ())), None)
    if time is None:
        raise ValueError(f"{messages.name} has no time")
    fields = {table.TIME_NS: time, **_known_fields(messages)}
    columns: dict[str, list[Times]] = {name: [] for name in fields}
    with np.errstate(invalid="ignore"):  # a damaged log may contain signalling NaN
        for block in _iter_blocks(log, messages):
            for column, field in fields.items():
                if field == time:
                    columns[column].append(table.integers_to_ns(block[field], TIMES[time]))
                else:
                    columns[column].append(block[field].astype(np.float64) * messages.factors.get(field, 1.0))
    return {name: cast(Times, np.concatenate(parts)) for name, parts in columns.items()}


def _read_batches(log: Any, messages: _Messages, batches: np.ndarray[Any, np.dtype[np.void]]) -> dict[str, Times]:
    """Return the columns of a triad. ``batches`` [n] are the messages ISBH of all messages ISBD."""
    start_ns = table.integers_to_ns(batches["SampleUS"], TIMES["SampleUS"])
    blocks = list(_iter_blocks(log, messages))
    position = BATCH_SIZE * np.concatenate([block["seqno"] for block in blocks]).astype(np.int64)
    position = position[:, None] + np.arange(BATCH_SIZE)
    used = position < batches["smp_cnt"][:, None]
    ages_ns = np.rint(position * (1e9 / batches["smp_rate"].astype(np.float64))[:, None]).astype(np.int64)
    columns: dict[str, Times] = {table.TIME_NS: (start_ns[:, None] + ages_ns)[used]}
    for column, field in _known_fields(messages).items():
        counts = np.concatenate([block[field] for block in blocks]).view("<i2").reshape(-1, BATCH_SIZE)
        columns[column] = (counts / batches["mul"].astype(np.float64)[:, None])[used]
    return columns
