"""Tests of the encoding of diagnostics, with an independent codec."""

from hypothesis import given
from hypothesis import strategies as st

from monitor.publishing.ros2.diagnostic_array import DiagnosticStatus, Level, encode_diagnostic_array
from tests.support.ros2_messages import DIAGNOSTIC_ARRAY, decode, stamp_ns

TEXT = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=12)
STATUS = st.builds(
    DiagnosticStatus, st.sampled_from(Level), TEXT, TEXT, TEXT, st.lists(st.tuples(TEXT, TEXT), max_size=4)
)


@given(st.integers(0, 2**31 * 1_000_000_000 - 1), st.lists(STATUS, max_size=4))
def test_every_field_is_decoded(t_ns: int, statuses: list[DiagnosticStatus]) -> None:
    message = decode(encode_diagnostic_array(t_ns, statuses), DIAGNOSTIC_ARRAY)
    assert stamp_ns(message) == t_ns
    assert message.header.frame_id == ""
    found = [
        DiagnosticStatus(
            Level(one.level), one.name, one.message, one.hardware_id, [(pair.key, pair.value) for pair in one.values]
        )
        for one in message.status
    ]
    assert found == statuses


def test_text_that_is_not_unicode_is_replaced() -> None:
    status = DiagnosticStatus(Level.OK, "a", "file \udcff", "", [])
    [found] = decode(encode_diagnostic_array(0, [status]), DIAGNOSTIC_ARRAY).status
    assert found.message == "file ?"
