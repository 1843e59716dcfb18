"""Text lines of numbers, as printed by Arduino boards and similar microcontrollers.

The format has no standard. ``columns`` names the content of each column, and the numbers are converted from the
configured units to SI. A line ends in LF, CR or CR LF. With ``delimiter = "auto"``, fields are separated by commas,
semicolons or tabs. In a line without commas, semicolons or tabs, fields are separated by blanks. A field may begin with
a label and a colon, as in ``gx:0.01``, which is the format of Arduino's Serial Plotter. Labels are ignored, but a line
is rejected if a label is the name of another column. An empty field or ``nan`` means that the value was not measured.
Empty lines and lines that begin with the comment prefix are skipped. A line is rejected if it has the wrong number of
columns, or if a field is not a number. With ``nmea = true``, a line is ``$fields*CC``. The checksum CC is the exclusive
or of the characters between ``$`` and ``*``, in two hexadecimal digits. A line with a wrong checksum is rejected.

For lines in another format, the named groups of the regular expression ``pattern`` contain the fields. The RE2 library
matches the groups in time proportional to the length of the line, which is at most MAX_LINE_BYTES. No pattern can
therefore stop the reader. A line without a match is rejected.

The first line that arrives after the link was opened is often incomplete. For example, ``-0.012`` without the first
characters is read as ``12``. The first line is therefore skipped without being counted as bad. A first line with a
correct checksum is kept, and ``first_line = "keep"`` keeps every first line. ``encode`` puts a line end before the
first line of a block, so that only an empty line is skipped.

If the column ``t`` advances by a power of 1000 faster or slower than the arrival times, ``time_unit`` is wrong. All
lines are then rejected, because the rate and the noise coefficients would be wrong. All lines are also rejected if they
contradict the units or come from several sensors (``drivers.live_stream_check``).
"""

import re
from collections.abc import Sequence
from typing import Any, ClassVar, Final

import numpy as np

from drivers import units
from drivers.data_types import AXES, ArrivalTimedFormat, Chunk, CounterTimedFormat, Floats, Ints, SampleBlock, Timing
from drivers.decoders import base
from drivers.decoders.text_lines.text.settings import (
    SKIP,
    TICK_S,
    Settings,
    apply_preset,
    compile_pattern,
    compute_factors_and_offsets,
)
from drivers.errors import ConfigError
from drivers.live_stream_check import StreamConfiguration

LABEL: Final = re.compile(rb"([^:]*[A-Za-z][^:]*):(.*)", re.DOTALL)
"""Regular expression that matches the label and the number of a field."""
COLON: Final = re.compile(rb"[ \t]*:[ \t]*")
MAX_LINE_BYTES: Final = 4096
"""Maximum length of a line in bytes. Longer text without a line end is discarded."""
OVERLONG_LINE: Final = b"\0"
"""Replacement for an overlong line. The replacement is not a number, so the line is rejected."""
OVERLONG_HINT: Final = f"more than {MAX_LINE_BYTES} bytes without a line end: is the baud rate right?"
DEVICE_WRAP: Final = 1 << 32
"""Number of counts after which ``millis()`` and ``micros()`` of Arduino boards wrap to 0."""
TIME_UNITS: Final = ("s", "ms", "us", "ns")
MIN_CLOCK_CHECK_S: Final = 0.5
MIN_CLOCK_CHECK_LINES: Final = 20
"""Duration and number of lines after which the column ``t`` is compared with the arrival times."""
UNWRAPPED_TICKS: Final = 1 << 62
"""Modulus in ticks for a device clock that does not wrap. The modulus corresponds to 146 years."""


class TextDecoder(base.RejectingDecoder):
    """Decoder and encoder of lines of numbers."""

    carrier: ClassVar[str] = "bytes"

    def __init__(self, settings: Settings) -> None:
        super().__init__(_describe_configuration(settings))
        self._settings = settings
        self._pattern = compile_pattern(settings.pattern) if settings.pattern else None
        self._names = settings.columns if self._pattern is None else tuple(self._pattern.groupindex)
        self._column = {name: i for i, name in enumerate(self._names) if name != SKIP}
        self._wanted = frozenset(self._column.values())
        self._width = len(self._names)
        self._factor, self._offset = compute_factors_and_offsets(settings, self._names)
        self.timing: Timing = _timing(settings, self._names)
        self._comment = settings.comment.encode()
        self._delimiter = settings.delimiter.encode()
        self.forget_stream_state()

    def forget_stream_state(self) -> None:
        """Discard an incomplete line, and treat the next line as the first line after opening the link."""
        self._rest = b""
        self._overlong = False
        self._first_line_ended = False  # True if the end of the first line has arrived
        self._lines_seen = 0  # number of lines since the link was opened
        self._builder.forget_missing_samples()
        self._clock_start: tuple[float, int] | None = None  # first count and arrival time
        self._clock_lines = 0  # number of lines with a count
        self._clock_problem = ""

    def feed(self, chunks: Sequence[Chunk]) -> list[SampleBlock]:
        """Return the samples in all lines that are complete after the given chunks."""
        lines: list[bytes] = []
        t_ns: list[int] = []
        for chunk in chunks:
            new = self._split_lines(chunk.data)
            lines += new
            t_ns += [chunk.t_ns] * len(new)
        if not lines:
            return []
        table, counted = self._parse_data_lines(lines)
        return self._build_blocks(table, np.array(t_ns, np.int64)[counted])

    def _split_lines(self, data: bytes) -> list[bytes]:
        """Return the completed lines without line endings or surrounding blanks. Empty lines are omitted."""
        *lines, rest = (self._rest + data).replace(b"\r", b"\n").split(b"\n")
        if lines and self._overlong:
            lines[0], self._overlong = OVERLONG_LINE, False
        lines = [OVERLONG_LINE if len(line) > MAX_LINE_BYTES else line.strip() for line in lines]
        if lines and not self._first_line_ended:
            self._first_line_ended = True
            lines[0] = lines[0] if self._first_is_whole(lines[0]) else b""
        if len(rest) > MAX_LINE_BYTES:
            rest, self._overlong = b"", True
            self._rejection.note_rejection(OVERLONG_HINT)
        self._rest = rest
        return [line for line in lines if line]

    def _first_is_whole(self, line: bytes) -> bool:
        """Return True if the first line is complete, or if the settings keep every first line."""
        if self._settings.header:
            return True  # the first line belongs to the header, which is skipped later
        if self._settings.nmea:
            return _nmea_body(line) is not None
        return self._settings.first_line == "keep" and self._parse_line(line)[0] is not None

    def _parse_data_lines(self, lines: list[bytes]) -> tuple[Floats, list[int]]:
        """Return the numbers [n, columns] in all data lines, and the indices of these lines.

        A rejected line is returned as a row of infinite numbers.
        """
        bodies: list[bytes | None] = []  # None stands for a line with a wrong checksum
        counted: list[int] = []
        comment, header = self._comment, self._settings.header
        for i, line in enumerate(lines):
            if comment and line.startswith(comment):
                continue
            self._lines_seen += 1
            if self._lines_seen <= header:
                continue
            bodies.append(_nmea_body(line) if self._settings.nmea else line)
            counted.append(i)
        return self._parse_lines(bodies), counted

    def _parse_lines(self, bodies: list[bytes | None]) -> Floats:
        """Return the numbers [n, columns]. Lines are parsed one by one only if parsing all lines together fails."""
        table = self._parse_regular_lines(bodies)
        if table is not None:
            self._rejection.add_good_frames(len(bodies))
            return table
        rows = []
        for body in bodies:
            row, error = (None, "a line fails its checksum") if body is None else self._parse_line(body)
            rows.append(row or [np.inf] * self._width)
            if error:
                self._rejection.note_rejection(error)
            else:
                self._rejection.add_good_frames()
        return np.array(rows).reshape(-1, self._width)

    def _parse_regular_lines(self, bodies: list[bytes | None]) -> Floats | None:
        """Return the numbers [n, columns], or None if a field is missing, is not a number or has a label."""
        if self._pattern is not None:
            return None
        separated = [self._comma_separated(body) for body in bodies if body is not None]
        joined = b",".join(separated)
        regular = all(body.count(b",") == self._width - 1 for body in separated)
        if len(separated) < len(bodies) or b"_" in joined or not regular:
            return None
        fields = joined.split(b",")
        table = np.zeros((len(bodies), self._width))
        try:
            for at in self._wanted if bodies else ():
                table[:, at] = list(map(float, fields[at :: self._width]))
        except ValueError:
            return None
        return table

    def _comma_separated(self, body: bytes) -> bytes:
        if self._delimiter == b"auto":
            body = body.replace(b";", b",").replace(b"\t", b",")
            return body if b"," in body else b",".join(body.split())
        if self._delimiter == b" ":
            return b",".join(body.split())
        return body.replace(b",", b"?").replace(self._delimiter, b",") if self._delimiter != b"," else body

    def _parse_line(self, body: bytes) -> tuple[list[float] | None, str]:
        """Return the numbers of a line and an empty text, or None and the reason if the line is rejected."""
        if body == OVERLONG_LINE:
            return None, OVERLONG_HINT
        fields = self._find_groups(self._pattern, body) if self._pattern else self._split_fields(body)
        if fields is None:
            return None, f"a line does not match the pattern: {body[:60]!r}"
        if len(fields) != self._width:
            todo = "correct `columns`, or describe the line with `pattern`"
            return None, f"a line has {len(fields)} columns, expected {self._width}: {body[:60]!r}; {todo}"
        try:
            return [self._parse_field(f, at) if at in self._wanted else 0.0 for at, f in enumerate(fields)], ""
        except ValueError:
            return None, f"a field is not a number: {body[:60]!r}"

    def _find_groups(self, pattern: Any, body: bytes) -> list[bytes] | None:
        """Return the text of each named group, or None if the line does not match the pattern."""
        match = pattern.search(body.decode("ascii", "replace"))
        return None if match is None else [(match[name] or "").encode() for name in self._names]

    def _split_fields(self, body: bytes) -> list[bytes]:
        fields = self._comma_separated(body).split(b",")
        if len(fields) != self._width and b":" in body:  # blanks around a colon do not separate fields
            fields = self._comma_separated(COLON.sub(b":", body)).split(b",")
        return fields

    def _parse_field(self, field: bytes, at: int) -> float:
        """Return the number in the field of the column with the index ``at``. Raise ValueError if the label names
        another column."""
        labelled = LABEL.fullmatch(field) if self._pattern is None else None
        if labelled is None:
            return _parse_number(field)
        label = labelled[1].strip().decode("ascii", "replace")
        if label in self._column and self._column[label] != at:
            raise ValueError(label)
        return _parse_number(labelled[2])

    def _build_blocks(self, table: Floats, t_ns: Ints) -> list[SampleBlock]:
        n = len(table)
        bad = np.isinf(table).any(axis=1)
        with np.errstate(over="ignore", invalid="ignore"):  # an overflow gives an implausible value, which is rejected
            scaled = table * self._factor + self._offset
        values = np.full((n, 6), np.nan)
        for axis, name in enumerate(AXES):
            if name in self._column:
                values[:, axis] = scaled[:, self._column[name]]
        temperature_c = scaled[:, self._column["temperature"]] if "temperature" in self._column else None
        ticks = None
        if isinstance(self.timing, CounterTimedFormat):
            counts = scaled[:, self._column["t" if "t" in self._column else "counter"]]
            bad |= ~(np.abs(counts) < float(UNWRAPPED_TICKS))  # the clock value is missing or implausible
            if not bad.all():
                self._check_time_unit(counts[~bad], t_ns[~bad])
            if self._clock_problem:
                bad[:] = True
                self._rejection.note_rejection(self._clock_problem)
            ticks = np.rint(np.where(bad, 0.0, counts)).astype(np.int64) % self.timing.modulus
        values[bad] = np.inf
        return self._builder.build_plausible_blocks(t_ns, values, temperature_c, ticks)

    def _check_time_unit(self, counts: Floats, t_ns: Ints) -> None:
        """Compare the column ``t`` with the arrival times, and set ``_clock_problem`` if another unit fits."""
        if "t" not in self._column or self._clock_problem:
            return
        first_count, first_ns = self._clock_start = self._clock_start or (float(counts[0]), int(t_ns[0]))
        self._clock_lines += len(counts)
        host_s, device_s = (int(t_ns[-1]) - first_ns) * 1e-9, (float(counts[-1]) - first_count) * TICK_S
        if host_s < MIN_CLOCK_CHECK_S or self._clock_lines < MIN_CLOCK_CHECK_LINES or device_s <= 0.0:
            return
        configured = self._settings.time_unit
        for unit in TIME_UNITS:
            ratio = units.time_factor(configured) / units.time_factor(unit)
            rate_hz = self._clock_lines / (device_s / ratio)
            if unit != configured and 0.8 < device_s / host_s / ratio < 1.25 and 1.0 <= rate_hz <= 33_000.0:
                self._clock_problem = (
                    f"column t advances {device_s / host_s:.3g} times as fast as the clock of this computer: set "
                    f'time_unit = "{unit}" ({rate_hz:.4g} Hz)'
                )

    def encode(self, samples: SampleBlock) -> list[Chunk]:
        """Encode each sample as one line with the configured columns and units, in full precision.

        Raises
        ------
        ConfigError
            If the settings contain a pattern, because a regular expression does not define how to write a line.
        """
        if self._pattern is not None:
            raise ConfigError("a simulated sensor cannot write lines for a pattern; use columns instead")
        n = len(samples)
        table = np.zeros((n, self._width))
        for name, at in self._column.items():
            if name in AXES:
                table[:, at] = samples.values[:, AXES.index(name)]
            elif name == "temperature":
                table[:, at] = samples.temperature_c
            else:
                table[:, at] = samples.ticks
        table = (table - self._offset) / self._factor
        between = {"auto": ","}.get(self._settings.delimiter, self._settings.delimiter)
        whole = {at for name, at in self._column.items() if name == "counter"}
        bodies = [
            between.join(f"{x:.0f}" if at in whole else repr(x) for at, x in enumerate(row)).encode()
            for row in table.tolist()
        ]
        if self._settings.nmea:
            bodies = [b"$%b*%02X" % (body, base.xor_checksum(body)) for body in bodies]
        lines = [body + b"\r\n" for body in bodies]
        return base.make_chunks([b"\r\n" + lines[0], *lines[1:]], samples.t_ns)


def _parse_number(field: bytes) -> float:
    """Return the number in a field, or NaN for an empty field. Raise ValueError for any other text."""
    field = field.strip()
    if b"_" in field:  # Python accepts underscores in numbers
        raise ValueError(field)
    return float(field) if field else np.nan


def _nmea_body(line: bytes) -> bytes | None:
    """Return the text between ``$`` and ``*``; None if the checksum is wrong."""
    start, star = line.rfind(b"$") + 1, line.rfind(b"*")
    body, stated = line[start:star], line[star + 1 :]
    try:
        return body if 0 < start <= star and len(stated) == 2 and int(stated, 16) == base.xor_checksum(body) else None
    except ValueError:
        return None


def _describe_configuration(settings: Settings) -> StreamConfiguration:
    """Return what the settings state about the samples. A unit is also stated by a scale of its axes."""
    scaled = {"gyro_unit" if axis.startswith("g") else "accel_unit" for axis in settings.scale if axis in AXES}
    given = settings.model_fields_set | scaled
    return StreamConfiguration(
        (settings.gyro_unit, settings.accel_unit),
        ("gyro_unit" in given, "accel_unit" in given),
        lambda found: f"set {found.triad}_unit = {found.fits}",
        "connect one sensor, or select its lines with `pattern`",
    )


def _timing(settings: Settings, columns: Sequence[str]) -> Timing:
    if "t" in columns:
        unit_ticks = round(units.time_factor(settings.time_unit) / TICK_S)
        wraps = settings.time_unit in ("ms", "us")
        return CounterTimedFormat(DEVICE_WRAP * unit_ticks if wraps else UNWRAPPED_TICKS, TICK_S)
    return CounterTimedFormat(settings.counter_modulus) if "counter" in columns else ArrivalTimedFormat()


def build(settings: Settings) -> base.Decoder:
    """Return a decoder of text lines with the given settings."""
    return TextDecoder(apply_preset(settings))
