"""Fuzz targets of the queries of the history: parameters and time ranges."""

import math

from drivers.errors import ConfigError
from monitor.common.unit_formatting import format_utc
from monitor.history.query_parameters import parse_query
from monitor.history.time_ranges import parse_duration_s, parse_time, parse_zenoh_range
from tests.experiments.fuzz.checks import check_error_message
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
    "history-query",
    (b"_time=[now(-1h)..now()];step=15min;what=status;axis=gz", b"_time=]2026-11-20T00:00:00Z;2m["),
    200,
    WORDS,
)
def history_query(data: bytes) -> None:
    """Check that a query is parsed or rejected, and that its formatted parameters give the same query."""
    try:
        query = parse_query(data.decode("utf-8", "surrogateescape"), NOW_S)
    except ConfigError as error:
        check_error_message(error)
        return
    if query.span is not None:
        assert not math.isnan(query.span.start_s)
        assert query.span.start_s <= query.span.end_s
    parsed_again = parse_query(query.format_parameters(), NOW_S)
    assert (parsed_again.step_s, parsed_again.what, parsed_again.axes, parsed_again.symbols) == (
        query.step_s,
        query.what,
        query.axes,
        query.symbols,
    )


@target("history-times", (b"-1d", b"2026-11-20 14:30", b"now(-1h)", b"[now(-1h)..now()]"), 60, WORDS)
def history_times(data: bytes) -> None:
    """Check that times, durations and time ranges are parsed or rejected."""
    text = data.decode("utf-8", "surrogateescape")
    for read in (lambda word: parse_time(word, NOW_S), parse_duration_s, lambda word: parse_zenoh_range(word, NOW_S)):
        try:
            value = read(text)
        except ConfigError as error:
            check_error_message(error)
            continue
        if isinstance(value, float):
            assert abs(value) < math.inf
            assert format_utc(value)
