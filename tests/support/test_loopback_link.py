"""Tests of the loopback link."""

import pytest

from drivers.data_types import Chunk
from drivers.errors import LinkEnded, LinkLost, LinkUnavailable
from tests.support.loopback_link import LoopbackLink


def test_data_written_before_opening_are_received() -> None:
    link = LoopbackLink("frames", "unix")
    chunk = Chunk(b"frame", 7, 0x123)
    link.write(chunk)
    link.open()
    assert link.wait_for_chunks_or_timeout(0.0) == [chunk]
    assert (link.carrier, link.epoch) == ("frames", "unix")


def test_drop_discards_unread_data_and_opening_reconnects() -> None:
    link = LoopbackLink()
    link.open()
    link.write(b"lost")
    link.drop()
    with pytest.raises(LinkLost, match="gone"):
        link.wait_for_chunks_or_timeout(1.0)
    link.open()
    link.write(b"new")
    assert [c.data for c in link.wait_for_chunks_or_timeout(1.0) or ()] == [b"new"]


def test_link_ends_after_all_data_have_been_read() -> None:
    link = LoopbackLink()
    link.open()
    link.write(b"last")
    link.end()
    assert link.wait_for_chunks_or_timeout(1.0)
    with pytest.raises(LinkEnded):
        link.wait_for_chunks_or_timeout(1.0)


def test_absent_link_cannot_be_opened() -> None:
    link = LoopbackLink()
    link.absent = True
    with pytest.raises(LinkUnavailable):
        link.open()
    link.absent = False
    link.open()
    assert link.wait_for_chunks_or_timeout(0.0) is None
