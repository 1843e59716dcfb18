"""End of an existing recording, from which the daemon continues after a restart."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from drivers.errors import ConfigError, RecordingError
from drivers.recordings import segment_file
from drivers.recordings.segment_file import GapFreeSegmentPart, SegmentMetadata


@dataclass(frozen=True, slots=True)
class LastRecordedSamples:
    """End of the recording of one device."""

    origin: SegmentMetadata
    paths: tuple[Path, ...]  # oldest first
    newest: GapFreeSegmentPart

    def read_pieces(self, span_s: float) -> Iterator[GapFreeSegmentPart]:
        """Yield the recorded pieces of the last ``span_s`` seconds with the same axis mounting, oldest first."""
        begin_ns = int(self.newest.samples.t_ns[-1]) - round(span_s * 1e9)
        for path in self._segments_since(begin_ns):
            for piece in segment_file.read_samples(path):
                if piece.samples.t_ns[-1] >= begin_ns:
                    yield piece

    def _segments_since(self, begin_ns: int) -> list[Path]:
        """Return the segments with the same axis mounting that contain samples after ``begin_ns``."""
        chosen: deque[Path] = deque()
        for path in reversed(self.paths):
            try:
                if segment_file.read_metadata(path).axes != self.origin.axes:
                    break
                first = next(segment_file.read_samples(path), None)
            except (RecordingError, OSError):
                continue
            if first is None:
                continue
            chosen.appendleft(path)
            if first.samples.t_ns[0] <= begin_ns:
                break
        return list(chosen)


def read_last_recorded_samples(origin: SegmentMetadata, folder: Path) -> LastRecordedSamples | None:
    """Read the end of the recording in a folder, or return None if there is no recording to continue.

    Files that are not valid segments are ignored.

    Parameters
    ----------
    origin : SegmentMetadata
        Metadata of the recording, with the axis mounting.
    folder : Path
        Folder of the segments.

    Raises
    ------
    RecordingError or OSError
        If no file can be read as a segment.
    """
    paths = segment_file.list_segments(folder)
    failure: Exception | None = None
    while paths:
        path = paths[-1]
        try:
            if segment_file.read_metadata(path).axes != origin.axes:
                return None
            newest = segment_file.read_last_piece(path)
        except (RecordingError, ConfigError, OSError) as error:
            newest, failure = None, failure or error
        if newest is not None:
            return LastRecordedSamples(origin, tuple(paths), newest)
        failure = failure or RecordingError(f"{path}: contains no complete batch of samples")
        paths.pop()
    if failure is not None:
        raise failure
    return None
