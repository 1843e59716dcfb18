"""The in-memory twin does what its writer tells it."""

import pytest

from drivers.data_types import Chunk
from drivers.errors import LinkEnded, LinkLost, LinkUnavailable
from tests.support.loopback_link import LoopbackLink


def test_what_was_written_before_opening_waits() -> None:
    link = LoopbackLink("frames", "unix")
    chunk = Chunk(b"frame", 7, 0x123)
    link.write(chunk)
    link.open()
    assert link.wait_for_chunks_or_timeout(0.0) == [chunk]
    assert (link.carrier, link.epoch) == ("frames", "unix")


def test_drop_loses_what_was_unread_and_opening_heals() -> None:
    link = LoopbackLink()
    link.open()
    link.write(b"lost")
    link.drop()
    with pytest.raises(LinkLost, match="gone"):
        link.wait_for_chunks_or_timeout(1.0)
    link.open()
    link.write(b"new")
    assert [c.data for c in link.wait_for_chunks_or_timeout(1.0) or ()] == [b"new"]


def test_end_comes_behind_what_was_written() -> None:
    link = LoopbackLink()
    link.open()
    link.write(b"last")
    link.end()
    assert link.wait_for_chunks_or_timeout(1.0)
    with pytest.raises(LinkEnded):
        link.wait_for_chunks_or_timeout(1.0)


def test_absent() -> None:
    link = LoopbackLink()
    link.absent = True
    with pytest.raises(LinkUnavailable):
        link.open()
    link.absent = False
    link.open()
    assert link.wait_for_chunks_or_timeout(0.0) is None
