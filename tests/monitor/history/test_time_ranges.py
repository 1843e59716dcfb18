from datetime import UTC, datetime

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from drivers.errors import ConfigError
from monitor.common.unit_formatting import format_utc
from monitor.history.time_ranges import UNITS_S, TimeRange, parse_duration_s, parse_time, parse_zenoh_range

NOW = 1_763_700_000.0
TIMES = st.datetimes(datetime(1971, 1, 1), datetime(2200, 1, 1), timezones=st.just(UTC))
DURATIONS = st.tuples(st.integers(1, 999), st.sampled_from(["u", "ms", "s", "m", "h", "d", "w"]))


def format_rfc3339(at: datetime) -> str:
    return at.isoformat().replace("+00:00", "Z")


@given(a=TIMES, b=TIMES, left=st.sampled_from("[]"), right=st.sampled_from("[]"))
def test_range_has_the_given_ends_and_brackets(a: datetime, b: datetime, left: str, right: str) -> None:
    a, b = sorted((a, b))
    span = parse_zenoh_range(f"{left}{format_rfc3339(a)}..{format_rfc3339(b)}{right}", NOW)
    assert (span.start_s, span.end_s) == (a.timestamp(), b.timestamp())
    assert (span.start_included, span.end_included) == (left == "[", right == "]")
    assume(a < b)
    assert span.contains(a.timestamp()) is span.start_included
    assert span.contains(b.timestamp()) is span.end_included


@given(a=TIMES, duration=DURATIONS)
def test_range_of_start_and_duration_is_parsed(a: datetime, duration: tuple[int, str]) -> None:
    number, unit = duration
    span = parse_zenoh_range(f"[{format_rfc3339(a)};{number}{unit}]", NOW)
    assert span == TimeRange(a.timestamp(), a.timestamp() + number * UNITS_S[unit])


@given(before=DURATIONS)
def test_now_and_open_ends_are_parsed(before: tuple[int, str]) -> None:
    number, unit = before
    seconds = number * UNITS_S[unit]
    assert parse_zenoh_range(f"[now(-{number}{unit})..]", NOW) == TimeRange(NOW - seconds, float("inf"))
    assert parse_zenoh_range(f"[..now({number}{unit})]", NOW) == TimeRange(float("-inf"), NOW + seconds)
    assert parse_time(f"-{number}{unit}", NOW) == NOW - seconds


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[..]", TimeRange(float("-inf"), float("inf"))),
        ("[now()..now()]", TimeRange(NOW, NOW)),
        ("[now(-1h);30m]", TimeRange(NOW - 3600.0, NOW - 1800.0)),
        ("[ now( -1.5h ) .. now() ]", TimeRange(NOW - 5400.0, NOW)),
        ("[2025-11-21T04:40:00.5Z..]", TimeRange(NOW + 0.5, float("inf"))),
        ("[2025-11-21T05:40:00+01:00..]", TimeRange(NOW, float("inf"))),
    ],
)
def test_zenoh_ranges_are_parsed(text: str, expected: TimeRange) -> None:
    assert parse_zenoh_range(text, NOW) == expected


@pytest.mark.parametrize(
    "text",
    ["", "now()", "[", "[]", "[now()", "[now(-1h)]", "[now(-1y)..]", "[;1h]", "[now(-1h);]", "[a..b]",
     "[now()..now(-1h)]", "[1e9..]", "[now(1e99d)..]", "[now(-nan)..]", "[2025-13-01..]", "(now()..)",
     "[now(-1h)..now()]]"],
)  # fmt: skip
def test_invalid_range_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(ConfigError) as error:
        parse_zenoh_range(text, NOW)
    assert "\n" not in str(error.value)


@given(st.text(max_size=80))
def test_any_text_is_parsed_or_refused_in_one_line(text: str) -> None:
    for parse in (lambda: parse_zenoh_range(text, NOW), lambda: parse_time(text, NOW), lambda: parse_duration_s(text)):
        message = ""
        try:
            parse()
        except ConfigError as error:
            message = str(error)
        assert "\n" not in message


def test_row_that_only_borders_on_a_range_does_not_overlap_it() -> None:
    span = parse_zenoh_range("[1970-01-01T00:01:00Z..1970-01-01T00:02:00Z[", NOW)
    touching = [start for start in range(0, 240, 60) if span.overlaps(start, start + 60)]
    assert touching == [60]


@given(TIMES)
def test_formatted_time_is_parsed_to_the_same_time(at: datetime) -> None:
    assert parse_time(format_utc(at.timestamp()), NOW) == int(at.timestamp())
