"""History file of the service: the output that writes it, and reading for the viewer and for queries."""

import time
from pathlib import Path

from drivers.errors import NotReady, RecordingError
from monitor.daemon.output_classes import HistoryOutput
from monitor.history.query import parse_query
from monitor.history.reading import HistoryTable, read_history
from monitor.history.sqlite_store import FILE_NAME, open_history
from monitor.history.time_ranges import TimeRange
from monitor.history.writer import HistoryWriter
from monitor.publishing.messages.history import HistoryMessage


class HistoryFile:
    """History file of the service.

    Parameters
    ----------
    folder : Path
        Folder of the history file.
    """

    def __init__(self, folder: Path) -> None:
        self.writer = HistoryWriter(folder / FILE_NAME, time.time)
        self.output = HistoryOutput(self.writer)

    @property
    def state(self) -> str:
        """Status message of the writer."""
        return self.writer.state

    def start(self) -> None:
        """Start the writer."""
        self.writer.start()

    def close(self) -> None:
        """Store the incomplete minutes and close the file."""
        self.output.store_incomplete_minutes()
        self.writer.close()

    def read_newest(self, device: str, span_s: float) -> HistoryTable | None:
        """Return the results of the last ``span_s`` seconds of a device, or None if there are none.

        Parameters
        ----------
        device : str
            Name of the device.
        span_s : float
            Length of the time range in seconds.
        """
        now_s = time.time()
        try:
            with open_history(self.writer.path) as reader:
                return read_history(reader, device, TimeRange(now_s - span_s, now_s))
        except (NotReady, RecordingError):  # no results yet; the writer reports errors of the file
            return None

    def answer_query(self, device: str, parameters: str) -> bytes:
        """Answer a zenoh query for the history of a device. Each query calls this function in a thread of its own.

        Parameters
        ----------
        device : str
            Name of the device.
        parameters : str
            Parameters of the zenoh selector.

        Raises
        ------
        ImuError
            If the query is invalid, or the history has no data to answer it.
        """
        query = parse_query(parameters, time.time())
        with open_history(self.writer.path) as reader:
            table = read_history(reader, device, query.span, query.selects, query.step_s)
            newest_s = reader.newest_s(device)
        return HistoryMessage.reply(table, query, newest_s, self.output.received.get(device, 0)).encode()
