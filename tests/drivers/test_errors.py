"""Tests of error texts: one printable line of limited length."""

import pytest

from drivers import errors
from drivers.errors import ConfigError, DecodeError, LinkLost, RecordingError, make_printable_and_shorten


@pytest.mark.parametrize("kind", [ConfigError, DecodeError, LinkLost, RecordingError])
def test_error_text_is_one_line_without_control_characters(kind: type[Exception]) -> None:
    assert str(kind("a\r\nb \x1b[2J ü")) == "a  b  [2J ü"


def test_long_error_text_is_shortened() -> None:
    text = make_printable_and_shorten("x" * 10**6)
    assert len(text) == errors.MAX_TEXT_CHARACTERS + 2
    assert text.endswith(" …")
    assert make_printable_and_shorten("x" * errors.MAX_TEXT_CHARACTERS) == "x" * errors.MAX_TEXT_CHARACTERS
