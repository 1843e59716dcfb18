"""Output that writes metrics to InfluxDB in line protocol over HTTP, if ``[influx] url`` is set.

At each interval, the main loop formats the values of all devices as one batch and appends the batch to a bounded queue.
A thread sends the batches in order. If the server cannot be reached or refuses a batch, the thread repeats the request
with increasing pauses. If the queue is full, the oldest batches are dropped and their points are counted.
"""

import http.client
import threading
import time
import urllib.error
import urllib.request
from collections import deque
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Any, Final
from urllib.parse import urlsplit

import structlog

from drivers.errors import ConfigError, describe_error, make_printable_and_shorten
from monitor.common.device_health import Health
from monitor.common.unexpected_errors import RestartedThread
from monitor.common.unit_formatting import format_count
from monitor.daemon.outputs.newest_metrics import NamedMetric, NewestMetrics
from monitor.settings.token_file import read_token

MEASUREMENT: Final = "imu_monitor"
"""Name of the measurement (table) of all points."""
MAX_QUEUED_BYTES: Final = 8_000_000
"""Maximum size of all batches in the queue."""
TIMEOUT_S: Final = 10.0
"""Longest wait for a connection or for the next bytes of an answer."""
MIN_RETRY_S: Final = 1.0
"""Pause after the first failed request. The pause doubles with each further failure."""
MAX_RETRY_S: Final = 60.0
"""Longest pause between two requests."""
CLOSE_TIMEOUT_S: Final = 2.0
"""Longest wait for the last request when the service stops."""
MAX_ANSWER_BYTES: Final = 300
"""Number of bytes of an error message that are read."""
REFUSED_BATCH: Final = (400, 413, 422)
"""Status codes that concern the batch itself, so that a repetition would fail as well."""
_ESCAPES: Final = str.maketrans({",": r"\,", "=": r"\=", " ": r"\ "})

_log = structlog.get_logger("imu-monitor")


class InfluxOutput(NewestMetrics):
    """Output that writes the newest values of each device to InfluxDB at a fixed interval.

    Parameters
    ----------
    url : str
        URL of the write endpoint, with ``http`` or ``https``.
    token_file : Path or None
        File that contains the token. The file is read before each request.
    interval_s : float
        Interval between two batches in seconds. The status of the devices sets a lower limit of one second.
    """

    name = "influx"

    def __init__(self, url: str, token_file: Path | None, interval_s: float) -> None:
        super().__init__()
        self._url = url
        self._token_file = token_file
        self._interval_s = interval_s
        self._due_s = time.monotonic() + interval_s
        self._queue: deque[bytes] = deque()
        self._lock = threading.Lock()
        self._dropped = 0  # number of points that were not stored
        self._error = ""  # description of the newest failure; empty if the newest request succeeded
        self._opener = urllib.request.build_opener(_RedirectRefusal)
        self._wake = threading.Event()
        self._closing = threading.Event()
        self._thread = RestartedThread(self._run, "influx", self._closing)

    @property
    def state(self) -> str:
        """Status message: ``ok``, or a description of the problem."""
        dropped = f"{format_count(self._dropped, 'point')} not stored" if self._dropped else ""
        error = self._thread.failure or self._error
        if error:
            return f"{error} ({dropped})" if dropped else error
        return f"ok, but {dropped}" if dropped else "ok"

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """Send the last values and stop the thread. Values that cannot be sent in CLOSE_TIMEOUT_S are lost."""
        self._queue_newest_values()
        self._closing.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(CLOSE_TIMEOUT_S)
        with self._lock:
            lost = sum(map(_count_points, self._queue))
        if lost:
            _log.warning("influx", text=f"{format_count(lost, 'point')} not sent before the end of the service")

    def publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Store the newest status of a device, and queue the values of all devices if the interval has passed."""
        super().publish_health(device, unix_s, health)
        now_s = time.monotonic()
        if now_s >= self._due_s:
            self._due_s = now_s + self._interval_s
            self._queue_newest_values()

    def _queue_newest_values(self) -> None:
        """Queue the values that have arrived since the previous batch."""
        lines = format_lines(self.read_metrics())
        self._healths.clear()
        self._estimates.clear()
        if not lines:
            return
        with self._lock:
            self._queue.append("\n".join(lines).encode())
            self._drop_oldest_batches()
        self._wake.set()

    def _drop_oldest_batches(self) -> None:
        size = sum(map(len, self._queue))
        while size > MAX_QUEUED_BYTES:
            batch = self._queue.popleft()
            size -= len(batch)
            self._dropped += _count_points(batch)

    # --- methods of the thread

    def _run(self) -> None:
        pause_s = MIN_RETRY_S
        while True:
            closing = self._closing.is_set()
            self._wake.clear()
            succeeded = self._send_queue()
            if closing:
                return
            if succeeded:
                pause_s = MIN_RETRY_S
                self._wake.wait()
            else:
                self._closing.wait(pause_s)
                pause_s = min(2.0 * pause_s, MAX_RETRY_S)

    def _send_queue(self) -> bool:
        """Send all batches in the queue, and return False after a failure that may end."""
        while True:
            with self._lock:
                if not self._queue:
                    return True
                batch = self._queue.popleft()
            error, is_final = self._send(batch)
            with self._lock:
                if error and is_final:
                    self._dropped += _count_points(batch)
                elif error:
                    self._queue.appendleft(batch)
                    self._drop_oldest_batches()
            self._set_error(error)
            if error and not is_final:
                return False

    def _send(self, batch: bytes) -> tuple[str, bool]:
        """Send a batch.

        Returns
        -------
        error : str
            Empty string, or a description of the failure.
        is_final : bool
            True if a repetition of the request would fail as well.
        """
        try:
            headers = {"Content-Type": "text/plain; charset=utf-8", "User-Agent": "imu-monitor"}
            if self._token_file is not None:
                headers["Authorization"] = f"Token {read_token(self._token_file)}"
            request = urllib.request.Request(self._url, batch, headers, method="POST")
            with self._opener.open(request, timeout=TIMEOUT_S):
                return "", False
        except urllib.error.HTTPError as error:
            with error:
                text = _read_message(error)
            is_final = error.code in REFUSED_BATCH
            next_step = "these values are dropped" if is_final else "trying again"
            return f"{self._host}: HTTP {error.code} {text}; {next_step}", is_final
        except ConfigError as error:
            return f"{error}; trying again", False
        except (OSError, http.client.HTTPException, ValueError) as error:
            cause = error.reason if isinstance(error, urllib.error.URLError) else error
            text = describe_error(cause) if isinstance(cause, Exception) else str(cause)
            return f"{self._host}: {make_printable_and_shorten(text)}; trying again", False

    @property
    def _host(self) -> str:
        return urlsplit(self._url).netloc

    def _set_error(self, error: str) -> None:
        """Store the result of a request, and log the first failure and the first success after a failure."""
        before, self._error = self._error, error
        if error and not before:
            _log.warning("influx", text=error)
        elif before and not error:
            _log.info("influx", text=f"{self._host}: writing continues")


class _RedirectRefusal(urllib.request.HTTPRedirectHandler):
    """Handler that treats a redirection as an error, because urllib would send the token to the other host."""

    def redirect_request(
        self, req: urllib.request.Request, fp: IO[bytes], code: int, msg: str, headers: Any, newurl: str
    ) -> None:
        """Refuse the redirection."""


def format_lines(metrics: Iterable[NamedMetric]) -> list[str]:
    """Format metrics in the line protocol of InfluxDB.

    Labels become tags. All metrics with the same tags and time become the fields of one point. Values without a time
    are omitted.

    Parameters
    ----------
    metrics : iterable of NamedMetric
        Metrics to format.

    Returns
    -------
    list of str
        One line per point, with the time in nanoseconds since 1970.
    """
    points: dict[tuple[str, int], list[str]] = {}
    for metric in metrics:
        for label_values, value, unix_s in metric.values:
            if unix_s is not None:
                pairs = zip(metric.labels, label_values, strict=True)
                tags = "".join(f",{label}={escape_tag_value(text)}" for label, text in pairs)
                points.setdefault((tags, round(unix_s * 1e9)), []).append(f"{metric.name}={value!r}")
    return [f"{MEASUREMENT}{tags} {','.join(fields)} {t_ns}" for (tags, t_ns), fields in points.items()]


def escape_tag_value(text: str) -> str:
    r"""Escape commas, equals signs and spaces in a tag value of the line protocol.

    The line protocol cannot express a line break or a backslash at the end of a tag value
    (docs.influxdata.com, "Line protocol", sections "Special characters" and "Elements"). No name of a device, output or
    event contains these characters.

    >>> print(escape_tag_value("bench 1,a=b"))
    bench\ 1\,a\=b
    """
    return text.translate(_ESCAPES)


def _count_points(batch: bytes) -> int:
    return batch.count(b"\n") + 1


def _read_message(error: urllib.error.HTTPError) -> str:
    """Return the reason phrase and the beginning of the error message of a server."""
    try:
        body = error.read(MAX_ANSWER_BYTES).decode("utf-8", "replace")
    except (OSError, http.client.HTTPException):  # the connection was closed early
        body = ""
    return make_printable_and_shorten(f"{error.reason}: {body}" if body else str(error.reason))
