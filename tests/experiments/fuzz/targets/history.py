"""What a query asks of a history: parameters and spans of time, as people and zenoh write them."""

import math

from drivers.errors import ConfigError
from monitor.common.unit_formatting import format_utc
from monitor.history.query_parameters import parse_query
from monitor.history.time_ranges import parse_duration_s, parse_time, parse_zenoh_range
from tests.experiments.fuzz.checks import one_line
from tests.experiments.fuzz.target import target

NOW_S = 1.7e9
WORDS = (
    "_time=",
    "[",
    "]",
    "..",
    ";",
    "now(",
    "-1h",
    ")",
    "step=",
    "what=",
    "axis=gz",
    "letter=N",
    "2026-11-20T14:30:00Z",
    "+14:00",
)


@target(
    "history-question",
    (b"_time=[now(-1h)..now()];step=15min;what=status;axis=gz", b"_time=]2026-11-20T00:00:00Z;2m["),
    200,
    WORDS,
)
def history_question(data: bytes) -> None:
    """A selector's parameters: a question, or a line; a question's own words ask the same."""
    try:
        asked = parse_query(data.decode("utf-8", "surrogateescape"), NOW_S)
    except ConfigError as error:
        one_line(error)
        return
    if asked.span is not None:
        assert not math.isnan(asked.span.start_s)
        assert asked.span.start_s <= asked.span.end_s
    again = parse_query(asked.format_parameters(), NOW_S)
    assert (again.step_s, again.what, again.axes, again.symbols) == (
        asked.step_s,
        asked.what,
        asked.axes,
        asked.symbols,
    )


@target("history-times", (b"-1d", b"2026-11-20 14:30", b"now(-1h)", b"[now(-1h)..now()]"), 60, WORDS)
def history_times(data: bytes) -> None:
    """A moment, a duration and a span: numbers, or a line."""
    text = data.decode("utf-8", "surrogateescape")
    for read in (lambda word: parse_time(word, NOW_S), parse_duration_s, lambda word: parse_zenoh_range(word, NOW_S)):
        try:
            found = read(text)
        except ConfigError as error:
            one_line(error)
            continue
        if isinstance(found, float):
            assert abs(found) < math.inf
            assert format_utc(found)
