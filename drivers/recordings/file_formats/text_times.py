"""Times that a table contains as text: ISO 8601 dates with times, and times of day.

The results are integers in ns. A date that does not begin with the year is ignored, because the order of day and month
is unknown, so only the time of day is used. Times of day continue after midnight (``table.unwrap_times``).
"""

import re
from datetime import date
from functools import lru_cache
from typing import Final

from drivers.recordings.table import NO_TIME_NS

DAY_NS: Final = 86_400 * 10**9
_TIME: Final = re.compile(
    r"(?:(?P<date>\d{4}[-/.]\d\d?[-/.]\d\d?|\d\d?[-/. ][\w]{1,9}[-/. ]\d{2,4})[T ,_]+)?"
    r"(?P<h>\d\d?)[:h](?P<m>\d\d)[:m](?P<s>\d\d)(?:[.,:](?P<fraction>\d{1,9}))?s?\s*(?P<half>[AaPp][Mm])?"
    r"(?:Z|\s?UTC|\s?(?P<zone>[+-]\d\d:?\d\d))?"
)


def is_text_time(field: str) -> bool:
    """Return True if a field is a time as text.

    >>> is_text_time("2024-03-01T23:59:00.010Z"), is_text_time("23:59:00,010"), is_text_time("12.5")
    (True, True, False)
    """
    return _TIME.fullmatch(field.strip(' "')) is not None


def has_date(field: str) -> bool:
    """Return True if a time begins with a date that is used."""
    found = _TIME.fullmatch(field.strip(' "'))
    return found is not None and found["date"] is not None and found["date"][:4].isdigit()


def parse_text_time(field: str) -> int:
    """Return a time in ns since 1970, or since midnight if the text has no usable date. NO_TIME_NS if it is empty.

    Raises
    ------
    ValueError
        If the text is no time.

    >>> parse_text_time("1970-01-02 00:00:00.010"), parse_text_time("00:00:01")
    (86400010000000, 1000000000)
    """
    text = field.strip(' "')
    if not text or text.lower() == "nan":
        return NO_TIME_NS
    found = _TIME.fullmatch(text)
    if found is None:
        raise ValueError(f"{text[:20]!a} is not a time")
    hours = int(found["h"])
    if found["half"]:
        hours = hours % 12 + (12 if found["half"].lower() == "pm" else 0)
    seconds = 3600 * hours + 60 * int(found["m"]) + int(found["s"])
    if found["zone"]:
        zone = found["zone"].replace(":", "")
        seconds -= (1 if zone[0] == "+" else -1) * (3600 * int(zone[1:3]) + 60 * int(zone[3:]))
    days = _days_since_1970(found["date"]) if found["date"] and found["date"][:4].isdigit() else 0
    return (86_400 * days + seconds) * 10**9 + int((found["fraction"] or "0").ljust(9, "0"))


@lru_cache(maxsize=16)
def _days_since_1970(text: str) -> int:
    year, month, day = map(int, re.split("[-/.]", text))
    return date(year, month, day).toordinal() - date(1970, 1, 1).toordinal()
