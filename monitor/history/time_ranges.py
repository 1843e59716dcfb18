"""Spans of time as people and zenoh write them: text and the time it is now in, Unix seconds out. Pure.

Zenoh's selectors have ``_time=[<start>..<end>]`` or ``_time=[<start>;<duration>]``, where either end may be left out,
and a bracket that points outwards leaves the end itself out. A time is RFC 3339 in UTC, ``now()`` or ``now(-1h)``.
People write ``-1d``, ``2026-11-20`` or ``2026-11-20 14:30`` (UTC), or ``now``. What is none of these is a ConfigError
that says what would be.
"""

import math
import re
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final

from drivers.errors import ConfigError

UNITS_S: Final = {
    "": 1.0,
    "u": 1e-6,
    "us": 1e-6,
    "ms": 1e-3,
    "s": 1.0,
    "m": 60.0,
    "min": 60.0,
    "h": 3600.0,
    "d": 86_400.0,
    "w": 604_800.0,
}
"""Zenoh's units; ``min`` is the configuration file's word for its ``m``."""
LIMIT_S: Final = 1e11
"""Times further from 1970 than some three thousand years are a slip."""
DATES_END_S: Final = 253_402_300_800.0  # the year 10000
_DURATION: Final = re.compile(r"\s*([0-9]+(?:\.[0-9]*)?|\.[0-9]+)\s*([a-z]*)\s*")
_NOW: Final = re.compile(r"now\(\s*([+-]?)\s*([^)]*)\)")


@dataclass(frozen=True, slots=True)
class Span:
    """From ``start_s`` to ``end_s``, Unix s; infinite where it is not bounded.

    >>> Span(10.0, 20.0).holds(20.0), Span(10.0, 20.0, end_in=False).holds(20.0)
    (True, False)
    """

    start_s: float
    end_s: float
    start_in: bool = True  # whether the end itself belongs to it
    end_in: bool = True

    def holds(self, t_s: float) -> bool:
        """Whether a moment is in it."""
        after = t_s >= self.start_s if self.start_in else t_s > self.start_s
        before = t_s <= self.end_s if self.end_in else t_s < self.end_s
        return after and before

    def zenoh(self) -> str:
        """As zenoh writes it; before 1970 nothing is kept."""
        ends = [
            "" if not 0.0 <= one < DATES_END_S else f"{datetime.fromtimestamp(one, UTC):%Y-%m-%dT%H:%M:%S.%fZ}"
            for one in (self.start_s, self.end_s)
        ]
        return f"{'[' if self.start_in else ']'}{'..'.join(ends)}{']' if self.end_in else '['}"

    def touches(self, start_s: float, end_s: float) -> bool:
        """Whether anything of [start_s, end_s), a row's time, can be in it.

        >>> Span(60.0, 120.0).touches(0.0, 60.0), Span(60.0, 120.0).touches(120.0, 180.0)
        (False, True)
        """
        before = start_s <= self.end_s if self.end_in else start_s < self.end_s
        return before and end_s > self.start_s


def zenoh_span(text: str, now_s: float) -> Span:
    """The span of a selector's ``_time``.

    >>> zenoh_span("[now(-1h)..now()]", 7200.0)
    Span(start_s=3600.0, end_s=7200.0, start_in=True, end_in=True)
    >>> zenoh_span("]1970-01-01T01:00:00Z;2m[", 0.0)
    Span(start_s=3600.0, end_s=3720.0, start_in=False, end_in=False)
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
    return Span(start_s, end_s, start_in, end_in)


def moment(text: str, now_s: float) -> float:
    """A moment as a person writes it, Unix s.

    >>> moment("-1d", 90_000.0), moment("1970-01-02", 0.0), moment("1970-01-01T00:01:30Z", 0.0)
    (3600.0, 86400.0, 90.0)
    """
    text = text.strip()
    if text == "now":
        return now_s
    if text.startswith("now("):
        return _zenoh_time(text, now_s)
    if text.startswith("-"):
        return now_s - _duration_s(text[1:])
    return _instant(text)


def length(text: str) -> float:
    """A duration in s, above zero.

    >>> length("15min"), length("1d"), length("90")
    (900.0, 86400.0, 90.0)
    """
    seconds = _duration_s(text)
    if seconds <= 0.0:
        raise ConfigError(f'"{_short(text)}": a duration above 0 is needed, e.g. 15min, 1h, 1d')
    return seconds


def said(t_s: float) -> str:
    """A moment for people, in UTC.

    >>> said(90.0)
    '1970-01-01 00:01:30'
    """
    try:
        return datetime.fromtimestamp(t_s, UTC).strftime("%Y-%m-%d %H:%M:%S")
    except (OverflowError, ValueError, OSError):
        return f"{t_s:g} s"


def _zenoh_time(text: str, now_s: float) -> float:
    text = text.strip()
    match = _NOW.fullmatch(text)
    if match is None:
        return _instant(text)
    offset = _duration_s(match[2]) if match[2].strip() else 0.0
    return now_s - offset if match[1] == "-" else now_s + offset


def _instant(text: str) -> float:
    """RFC 3339; a date alone is its midnight, and without an offset it is UTC."""
    try:
        found = datetime.fromisoformat(text.strip())
        found = found if found.tzinfo is not None else found.replace(tzinfo=UTC)
        return found.timestamp()
    except (ValueError, OverflowError):
        raise ConfigError(
            f'"{_short(text)}" is no time; write 2026-11-20, 2026-11-20T14:30:00Z, -1d, or now(-1h) in _time'
        ) from None


def _duration_s(text: str) -> float:
    match = _DURATION.fullmatch(text)
    if match is None or match[2] not in UNITS_S:
        raise ConfigError(f'"{_short(text)}" is no duration; write 90s, 30m, 1h, 2d, 1w')
    seconds = float(match[1]) * UNITS_S[match[2]]
    if seconds > LIMIT_S:
        raise ConfigError(f'"{_short(text)}" is too long; at most some three thousand years')
    return seconds


def _short(text: str) -> str:
    """Enough of what a stranger sent to be recognised."""
    printable = "".join(c if c.isprintable() else "?" for c in text)
    return printable if len(printable) <= 60 else f"{printable[:57]}…"
