"""Fuzz targets of the segments of recordings that a daemon reads at its start."""

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
from tests.experiments.fuzz.checks import MAX_LOST_SAMPLES, check_error_message
from tests.experiments.fuzz.target import target
from tests.experiments.fuzz.targets.files import LARGEST_NS, check_replay, get_folder

NAME: Final = "00000001_2026-11-22T03-00-00Z.arrows"


def _write_segment(metadata: SegmentMetadata, compressed: bool) -> bytes:
    path = get_folder() / f"seed-{NAME}"
    writer = SegmentFileWriter(path, metadata)
    for i in range(3):
        rng = np.random.default_rng(i)
        rows = make_block(10**18 + np.arange(4) * 10**7, rng.normal(size=(4, 6)), np.full(4, 20.0), np.arange(4), i)
        if metadata.kind == "samples":
            writer.write_samples([rows], DaemonState(100.0, (1.7e9,) * 6, 5.0, (1e-4,) * 30, (True,) * 30))
        else:
            writer.write_chunks([Chunk(rng.bytes(9), 10**18 + i, i, b"beside"[:i])])
    writer.close()
    if compressed:
        list(compress_segment_stepwise(path))
    data = path.read_bytes()
    path.unlink()
    return data


def _sample_seeds() -> Iterator[bytes]:
    for compressed in (False, True):
        data = _write_segment(SegmentMetadata("a", "samples", "gx,gy", "bytes", "stim300"), compressed)
        yield from (data, data[: len(data) * 2 // 3])


def _raw_seeds() -> Iterator[bytes]:
    yield _write_segment(SegmentMetadata("a", "raw", "", "bytes", "stim300"), False)
    yield _write_segment(SegmentMetadata("a", "raw", "", "messages", "samples"), True)


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


@target("segment", _sample_seeds, 8000, WORDS)
def segment(data: bytes) -> None:
    """Check the samples before the damage, or the error."""
    path = get_folder() / NAME
    path.write_bytes(data)
    try:
        read_metadata(path)
        pieces = [*read_samples(path)]
        last = read_last_piece(path)
        assert last is None or pieces
        for _ in compress_segment_stepwise(path):
            pass
    except RecordingError as error:
        check_error_message(error)
        return
    for rows, state in ((piece.samples, piece.state) for piece in pieces):
        assert rows.values.shape == (len(rows), 6)
        assert not np.isinf(rows.values).any()
        assert (np.abs(rows.t_ns) < LARGEST_NS).all()
        assert 0 <= rows.lost <= 10 * MAX_LOST_SAMPLES
        assert state.rate is None or 0.0 < state.rate < float("inf")


@target("segment-raw", _raw_seeds, 4000, WORDS)
def segment_raw(data: bytes) -> None:
    """Check recorded bytes that are read and replayed."""
    path = get_folder() / NAME
    path.write_bytes(data)
    try:
        for chunk in read_chunks(path):
            assert isinstance(chunk.data, bytes)
            assert isinstance(chunk.attachment, bytes)
            assert abs(chunk.t_ns) < LARGEST_NS
            assert 0 <= chunk.address < 1 << 32
    except RecordingError as error:
        check_error_message(error)
    check_replay(path)
