import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import ConfigError
from monitor.history.query_parameters import DEFAULT_PARTS, HistoryQuery, parse_query
from monitor.history.time_ranges import TimeRange

NOW = 1_763_700_000.0


def test_empty_query_means_the_last_day_without_deviations() -> None:
    assert parse_query("", NOW) == HistoryQuery(None, None, DEFAULT_PARTS)


def test_all_parameters_are_accepted_in_any_order() -> None:
    query = parse_query("letter=B,N;step=15min;_time=[now(-1h);30m];axis=gz;what=deviations,coefficients;_anyke", NOW)
    expected = HistoryQuery(
        TimeRange(NOW - 3600.0, NOW - 1800.0), 900, ("coefficients", "deviations"), ("gz",), ("N", "B")
    )
    assert query == expected
    selected = [
        name for name in ("gz.N", "gz.B.bound", "gz.K", "gx.N", "gz.sigma.1", "rate") if query.selects_column(name)
    ]
    assert selected == ["gz.N", "gz.B.bound", "gz.sigma.1"]


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ("axes=gz", 'did you mean "axis"'),
        ("axis=gq", 'axis: "gq"'),
        ("letter=X", 'letter: "X"'),
        ("what=coefficient", 'did you mean "coefficients"'),
        ("_time=yesterday", "_time"),
        ("step=often", "not a duration"),
        ("step=0", "above 0"),
        ("step=1u", "1 s and more"),
        ("a" * 2000, "at most"),
    ],
)
def test_invalid_query_is_refused_in_one_line(parameters: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as error:
        parse_query(parameters, NOW)
    assert "\n" not in str(error.value)


@given(st.text(max_size=200))
def test_any_text_is_parsed_or_refused_briefly(text: str) -> None:
    message = ""
    try:
        parse_query(text, NOW)
    except ConfigError as error:
        message = str(error)
    assert len(message) < 1000
