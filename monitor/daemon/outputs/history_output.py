"""Output that writes results to the history file and answers queries from the history file."""

import time
from collections import defaultdict
from pathlib import Path
from typing import Any

from drivers.data_types import Event, Ints, SampleBlock
from drivers.errors import NotReady, RecordingError
from monitor.common.device_health import Health
from monitor.daemon.outputs.output import Output
from monitor.estimation.estimate import Estimate
from monitor.history.bucketed_history import HistoryTable, read_history
from monitor.history.minute_aggregation import MinuteAggregator
from monitor.history.query_parameters import parse_query
from monitor.history.sqlite_store import FILE_NAME, open_history
from monitor.history.stored_events import StoredEvent
from monitor.history.time_ranges import TimeRange
from monitor.history.writer import HistoryWriter
from monitor.publishing.messages.history import HistoryMessage
from monitor.publishing.messages.results import event_start_s


class HistoryOutput(Output):
    """Output that writes events and per-minute results to the history file.

    Parameters
    ----------
    folder : Path
        Folder of the history file.
    """

    name = "history"

    def __init__(self, folder: Path) -> None:
        self.writer = HistoryWriter(folder / FILE_NAME, time.time)
        self._received: dict[str, int] = {}  # number of samples of each device since the start
        self._minutes: defaultdict[str, MinuteAggregator] = defaultdict(MinuteAggregator)

    @property
    def state(self) -> str:
        """Status message of the history writer."""
        return self.writer.state

    def start(self) -> None:
        """Start the history writer."""
        self.writer.start()

    def close(self) -> None:
        """Store the incomplete minutes of all devices, and close the history file."""
        for device, minutes in self._minutes.items():
            self.writer.queue_item(device, minutes.flush())
        self.writer.close()

    def publish_samples(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """Aggregate the temperature of the samples."""
        unix_s = float((samples.t_ns + offset_ns)[-1]) / 1e9
        self.writer.queue_item(device, self._minutes[device].add_temperature(unix_s, samples.temperature_c))

    def publish_result(self, device: str, unix_s: float, received: int, result: Any) -> None:
        """Aggregate the coefficients and the Allan deviations of an estimate."""
        if isinstance(result, Estimate):
            self.writer.queue_item(device, self._minutes[device].add_estimate(unix_s, result))

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Store an event in the history file."""
        # SQLite does not accept NumPy scalars
        what = {name: {side: float(one) for side, one in sides.items()} for name, sides in event.values.items()}
        sigma, since_s = None if event.sigma is None else float(event.sigma), event_start_s(unix_s, event)
        self.writer.queue_item(device, StoredEvent(unix_s, event.kind, event.text, event.axis, what, since_s, sigma))

    def publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Aggregate the sample counts and the state of a device, if the time of the samples is known."""
        self._received[device] = health.received
        if unix_s is not None:
            self.writer.queue_item(device, self._minutes[device].add_health(unix_s, health))

    def remove_device(self, device: str) -> None:
        """Store the incomplete minute of a removed device."""
        self._received.pop(device, None)
        if device in self._minutes:
            self.writer.queue_item(device, self._minutes.pop(device).flush())

    # --- reading

    def read_recent_history(self, device: str, span_s: float) -> HistoryTable | None:
        """Return the stored results of the last ``span_s`` seconds of a device, or None if there are no results.

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
        except (NotReady, RecordingError):  # errors of the file are reported by the writer
            return None

    def answer_query(self, device: str, parameters: str) -> bytes:
        """Return the answer to a zenoh query for the history of a device.

        Parameters
        ----------
        device : str
            Name of the device.
        parameters : str
            Parameters of the query.

        Raises
        ------
        ImuError
            If the query is invalid, or if the history contains no matching data.
        """
        query = parse_query(parameters, time.time())
        with open_history(self.writer.path) as reader:
            table = read_history(reader, device, query.span, query.selects_column, query.step_s)
            newest_s = reader.newest_result_s(device)
        return HistoryMessage.build_reply(table, query, newest_s, self._received.get(device, 0)).encode()
