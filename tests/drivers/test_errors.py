"""The text of an error is one line that a terminal can be given."""

import pytest

from drivers import errors
from drivers.errors import ConfigError, DecodeError, LinkLost, RecordingError, make_printable_and_shorten


@pytest.mark.parametrize("kind", [ConfigError, DecodeError, LinkLost, RecordingError])
def test_one_line_whatever_it_quotes(kind: type[Exception]) -> None:
    assert str(kind("a\r\nb \x1b[2J ü")) == "a  b  [2J ü"


def test_not_endless() -> None:
    text = make_printable_and_shorten("x" * 10**6)
    assert len(text) == errors.MAX_TEXT_CHARACTERS + 2
    assert text.endswith(" …")
    assert make_printable_and_shorten("x" * errors.MAX_TEXT_CHARACTERS) == "x" * errors.MAX_TEXT_CHARACTERS
