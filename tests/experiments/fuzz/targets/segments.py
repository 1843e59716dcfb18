"""Segments of the daemon's own recordings, which it reads by itself when it starts: cut, damaged, or another's."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from drivers.data_types import AXES, Chunk, make_block
from drivers.errors import RecordingError
from drivers.recordings.segment_file import (
    DaemonState,
    SegmentFileWriter,
    SegmentMetadata,
    compress_segment_stepwise,
    read_chunks,
    read_last_piece,
    read_metadata,
    read_samples,
)
from tests.experiments.fuzz.checks import LARGEST_LOSS, one_line
from tests.experiments.fuzz.target import target
from tests.experiments.fuzz.targets.files import LARGEST_NS, folder, replayed

NAME: Final = "00000001_2026-11-22T03-00-00Z.arrows"


def _written(of: SegmentMetadata, packed: bool) -> bytes:
    path = folder() / f"seed-{NAME}"
    writer = SegmentFileWriter(path, of)
    for i in range(3):
        rng = np.random.default_rng(i)
        rows = make_block(10**18 + np.arange(4) * 10**7, rng.normal(size=(4, 6)), np.full(4, 20.0), np.arange(4), i)
        if of.kind == "samples":
            writer.write_samples([rows], DaemonState(100.0, (1.7e9,) * 6, 5.0, (1e-4,) * 30, (True,) * 30))
        else:
            writer.write_chunks([Chunk(rng.bytes(9), 10**18 + i, i, b"beside"[:i])])
    writer.close()
    if packed:
        list(compress_segment_stepwise(path))
    data = path.read_bytes()
    path.unlink()
    return data


def _samples() -> Iterator[bytes]:
    for packed in (False, True):
        data = _written(SegmentMetadata("a", "samples", "gx,gy", "bytes", "stim300"), packed)
        yield from (data, data[: len(data) * 2 // 3])


def _raw() -> Iterator[bytes]:
    yield _written(SegmentMetadata("a", "raw", "", "bytes", "stim300"), False)
    yield _written(SegmentMetadata("a", "raw", "", "messages", "samples"), True)


WORDS: Final = (
    *AXES,
    "lost",
    "ticks",
    "state",
    "samples",
    "raw",
    b"\xff\xff\xff\xff",
    "null",
    "1e999",
    "[",
    "imu-monitor",
)


@target("segment", _samples, 8000, WORDS)
def segment(data: bytes) -> None:
    """Samples: those before the damage, or a line."""
    path = folder() / NAME
    path.write_bytes(data)
    try:
        read_metadata(path)
        pieces = [*read_samples(path)]
        last = read_last_piece(path)
        assert last is None or pieces
        for _ in compress_segment_stepwise(path):
            pass
    except RecordingError as error:
        one_line(error)
        return
    for rows, state in ((piece.samples, piece.state) for piece in pieces):
        assert rows.values.shape == (len(rows), 6)
        assert not np.isinf(rows.values).any()
        assert (np.abs(rows.t_ns) < LARGEST_NS).all()
        assert 0 <= rows.lost <= 10 * LARGEST_LOSS
        assert state.rate is None or 0.0 < state.rate < float("inf")


@target("segment-raw", _raw, 4000, WORDS)
def segment_raw(data: bytes) -> None:
    """Bytes as they came, read and replayed."""
    path = folder() / NAME
    path.write_bytes(data)
    try:
        for chunk in read_chunks(path):
            assert isinstance(chunk.data, bytes)
            assert isinstance(chunk.attachment, bytes)
            assert abs(chunk.t_ns) < LARGEST_NS
            assert 0 <= chunk.address < 1 << 32
    except RecordingError as error:
        one_line(error)
    replayed(path)
