"""Parsing and formatting of times, durations and time ranges, which are represented as Unix times in seconds.

In a zenoh selector (request address), a time range is written as ``_time=[<start>..<end>]`` or
``_time=[<start>;<duration>]``. The start or the end may be omitted. A bracket that points outwards excludes the start
or the end from the range. Times in a selector are written as ``now()``, as ``now(-1h)`` or in RFC 3339 format. Times in
command options are written, for example, as ``-1d``, ``2026-11-20``, ``2026-11-20 14:30`` (UTC) or ``now``.
"""

import math
import re
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final

from drivers.errors import ConfigError
from drivers.validation.number_ranges import DAY_S, HOUR_S

UNITS_S: Final = {
    "": 1.0,
    "u": 1e-6,
    "us": 1e-6,
    "ms": 1e-3,
    "s": 1.0,
    "m": 60.0,
    "min": 60.0,
    "h": float(HOUR_S),
    "d": float(DAY_S),
    "w": 7.0 * DAY_S,
}
"""Length of each unit of time [s]. Minutes are written as ``m`` in zenoh and as ``min`` in the configuration file."""
MAX_DURATION_S: Final = 1e11
"""Maximum duration [s], about three thousand years."""
MAX_DATE_S: Final = 253_402_300_800.0  # Unix time of the year 10000
_DURATION: Final = re.compile(r"\s*([0-9]+(?:\.[0-9]*)?|\.[0-9]+)\s*([a-z]*)\s*")
_NOW: Final = re.compile(r"now\(\s*([+-]?)\s*([^)]*)\)")


@dataclass(frozen=True, slots=True)
class TimeRange:
    """Time range from ``start_s`` to ``end_s`` in Unix seconds, which may be unbounded on either side.

    >>> TimeRange(10.0, 20.0).contains(20.0), TimeRange(10.0, 20.0, end_included=False).contains(20.0)
    (True, False)
    """

    start_s: float
    end_s: float
    start_included: bool = True  # True if the range includes its start
    end_included: bool = True  # True if the range includes its end

    def contains(self, t_s: float) -> bool:
        """Return True if the time range contains the Unix time ``t_s``."""
        after = t_s >= self.start_s if self.start_included else t_s > self.start_s
        before = t_s <= self.end_s if self.end_included else t_s < self.end_s
        return after and before

    def format_for_zenoh(self) -> str:
        """Format the time range for a zenoh selector. A start or end before 1970 or after 9999 is omitted."""
        ends = [
            "" if not 0.0 <= one < MAX_DATE_S else f"{datetime.fromtimestamp(one, UTC):%Y-%m-%dT%H:%M:%S.%fZ}"
            for one in (self.start_s, self.end_s)
        ]
        return f"{'[' if self.start_included else ']'}{'..'.join(ends)}{']' if self.end_included else '['}"

    def overlaps(self, start_s: float, end_s: float) -> bool:
        """Return True if the time range overlaps a history row from ``start_s`` (inclusive) to ``end_s`` (exclusive).

        >>> TimeRange(60.0, 120.0).overlaps(0.0, 60.0), TimeRange(60.0, 120.0).overlaps(120.0, 180.0)
        (False, True)

        Parameters
        ----------
        start_s
            Unix time at which the row starts [s].
        end_s
            Unix time at which the row ends [s].
        """
        before = start_s <= self.end_s if self.end_included else start_s < self.end_s
        return before and end_s > self.start_s


def parse_zenoh_range(text: str, now_s: float) -> TimeRange:
    """Parse the ``_time`` parameter of a zenoh selector.

    >>> parse_zenoh_range("[now(-1h)..now()]", 7200.0)
    TimeRange(start_s=3600.0, end_s=7200.0, start_included=True, end_included=True)
    >>> parse_zenoh_range("]1970-01-01T01:00:00Z;2m[", 0.0)
    TimeRange(start_s=3600.0, end_s=3720.0, start_included=False, end_included=False)

    Parameters
    ----------
    text
        Value of the parameter, for example ``[now(-1h)..now()]``.
    now_s
        Current Unix time [s].

    Raises
    ------
    ConfigError
        If the text is not a time range, or if the range ends before it begins.
    """
    text = text.strip()
    if len(text) < 2 or text[0] not in "[]" or text[-1] not in "[]":
        raise ConfigError(f'_time: "{_short(text)}" has no brackets; write [now(-1h)..now()] or [<start>;<duration>]')
    start_in, end_in, inner = text[0] == "[", text[-1] == "]", text[1:-1]
    if ".." in inner:
        first, _, last = inner.partition("..")
        start_s = _zenoh_time(first, now_s) if first.strip() else -math.inf
        end_s = _zenoh_time(last, now_s) if last.strip() else math.inf
    elif ";" in inner:
        first, _, last = inner.partition(";")
        start_s = _zenoh_time(first, now_s)
        end_s = start_s + _duration_s(last)
    else:
        raise ConfigError(f'_time: "{_short(text)}" has no end; write [<start>..<end>] or [<start>;<duration>]')
    if end_s < start_s:
        raise ConfigError(f'_time: "{_short(text)}" ends before it begins')
    return TimeRange(start_s, end_s, start_in, end_in)


def parse_time(text: str, now_s: float) -> float:
    """Parse a time that is given in a command option, and return the Unix time [s].

    >>> parse_time("-1d", 90_000.0), parse_time("1970-01-02", 0.0), parse_time("1970-01-01T00:01:30Z", 0.0)
    (3600.0, 86400.0, 90.0)

    Parameters
    ----------
    text
        Time, for example ``-1d``, ``2026-11-20 14:30`` or ``now``.
    now_s
        Current Unix time [s].

    Raises
    ------
    ConfigError
        If the text is not a time.
    """
    text = text.strip()
    if text == "now":
        return now_s
    if text.startswith("now("):
        return _zenoh_time(text, now_s)
    if text.startswith("-"):
        return now_s - _duration_s(text[1:])
    return _instant(text)


def parse_duration_s(text: str) -> float:
    """Parse a positive duration, and return it in seconds.

    >>> parse_duration_s("15min"), parse_duration_s("1d"), parse_duration_s("90")
    (900.0, 86400.0, 90.0)

    Raises
    ------
    ConfigError
        If the text is not a duration, or if the duration is zero or too long.
    """
    seconds = _duration_s(text)
    if seconds <= 0.0:
        raise ConfigError(f'"{_short(text)}": a duration above 0 is needed, e.g. 15min, 1h, 1d')
    return seconds


def _zenoh_time(text: str, now_s: float) -> float:
    """Parse an RFC 3339 time or ``now(±duration)``, and return the Unix time [s]."""
    text = text.strip()
    match = _NOW.fullmatch(text)
    if match is None:
        return _instant(text)
    offset = _duration_s(match[2]) if match[2].strip() else 0.0
    return now_s - offset if match[1] == "-" else now_s + offset


def _instant(text: str) -> float:
    """Parse an RFC 3339 time. A date alone means midnight, and a time without an offset is in UTC."""
    try:
        found = datetime.fromisoformat(text.strip())
        found = found if found.tzinfo is not None else found.replace(tzinfo=UTC)
        return found.timestamp()
    except (ValueError, OverflowError):
        raise ConfigError(
            f'"{_short(text)}" is not a time; write 2026-11-20, 2026-11-20T14:30:00Z, -1d, or now(-1h) in _time'
        ) from None


def _duration_s(text: str) -> float:
    match = _DURATION.fullmatch(text)
    if match is None or match[2] not in UNITS_S:
        raise ConfigError(f'"{_short(text)}" is not a duration; write 90s, 30m, 1h, 2d, 1w')
    seconds = float(match[1]) * UNITS_S[match[2]]
    if seconds > MAX_DURATION_S:
        raise ConfigError(f'"{_short(text)}" is too long; at most about three thousand years')
    return seconds


def _short(text: str) -> str:
    printable = "".join(c if c.isprintable() else "?" for c in text)
    return printable if len(printable) <= 60 else f"{printable[:57]}…"
