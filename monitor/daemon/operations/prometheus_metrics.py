"""Prometheus metrics over HTTP: the newest values of each device, if ``[metrics] listen`` is set.

The main loop stores the newest status and estimate of each device. A server thread answers each scrape with the stored
values, so a scrape does not delay the main loop. If the port is in use, the server tries again.
"""

import contextlib
import socket
import socketserver
import threading
import time
from collections import deque
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Final

from drivers.host.extras import install_command
from monitor.common.unexpected_errors import RestartedThread
from monitor.daemon.outputs.newest_metrics import NewestMetrics
from monitor.settings.loading import MetricsAddress

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry, MetricsHandler
    from prometheus_client.core import Metric

RETRY_S: Final = 5.0
"""Interval between two attempts to listen."""
TIMEOUT_S: Final = 10.0
"""Maximum duration of a scrape."""
MAX_CONNECTIONS: Final = 64
"""Maximum number of open connections. A further connection ends the oldest one, which is slower than any scrape."""
PAUSE_S: Final = 0.1
"""Pause after a failed connection."""
PATH: Final = "/metrics"
"""Path of the metrics in the URL."""
MISSING_LIBRARY_TEXT: Final = f"prometheus-client is not installed: {install_command('imu-monitor[metrics]')}"
"""Status message if the library is not installed."""


class MetricsOutput(NewestMetrics):
    """Output that serves the newest values of each device to Prometheus.

    Parameters
    ----------
    settings : MetricsAddress
        Address of the server. Port 0 selects a free port.
    """

    name = "metrics"

    def __init__(self, settings: MetricsAddress) -> None:
        super().__init__()
        self._settings = settings
        self._state = "starting"
        self.port = 0
        """Port of the server, or 0 while the server does not listen."""
        self._server: _Server | None = None
        self._closing = threading.Event()
        self._thread = RestartedThread(self._run, "metrics", self._closing)

    @property
    def state(self) -> str:
        """Status message: ``ok``, or a description of the problem."""
        return self._thread.failure or self._state

    def start(self) -> None:
        """Start the server in a thread."""
        self._thread.start()

    def close(self) -> None:
        """Stop the server thread."""
        self._closing.set()
        server = self._server
        if server is not None:
            server.shutdown()
        if self._thread.is_alive():
            self._thread.join(RETRY_S)

    # --- called by the registry of the client library

    def collect(self) -> "Iterator[Metric]":
        """Yield all current metrics."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        for metric in self.read_metrics():
            kind = CounterMetricFamily if metric.is_counter else GaugeMetricFamily
            family = kind(metric.name, metric.description, labels=metric.labels)
            for one in metric.values:
                family.add_metric(one.label_values, one.value)
            yield family

    # --- server thread

    def _run(self) -> None:
        try:
            from prometheus_client import CollectorRegistry
        except ImportError:
            self._state = MISSING_LIBRARY_TEXT
            return
        registry = CollectorRegistry(auto_describe=False)
        registry.register(self)
        while not self._closing.is_set():
            try:
                server = _Server((self._settings.host, self._settings.port), registry)
            except (OSError, UnicodeError) as error:
                where = f"{self._settings.host}:{self._settings.port}"
                self._state = f"{where}: {getattr(error, 'strerror', None) or error}; trying again"
                self._closing.wait(RETRY_S)
                continue
            with server:
                self._server, self.port, self._state = server, int(server.server_address[1]), "ok"
                if not self._closing.is_set():
                    server.serve_forever()
            self.port = 0


class _Server(socketserver.ThreadingTCPServer):
    """Server with one thread per connection.

    The server class of http.server is not used, because it queries the network for the name of the host.
    """

    allow_reuse_address = True
    daemon_threads = True
    block_on_close = False

    def __init__(self, address: tuple[str, int], registry: "CollectorRegistry") -> None:
        self._open: deque[socket.socket] = deque()  # oldest first
        self._lock = threading.Lock()  # protects ``_open``
        if ":" in address[0]:
            self.address_family = socket.AF_INET6
        super().__init__(address, _make_handler(registry))

    def get_request(self) -> Any:
        """Accept the next connection, and pause after an error."""
        try:
            return super().get_request()
        except OSError:
            time.sleep(PAUSE_S)
            raise

    def process_request(self, request: Any, client_address: Any) -> None:
        """Start a thread for a connection, and end the oldest connection if too many connections are open."""
        with self._lock:
            self._open.append(request)
            if len(self._open) > MAX_CONNECTIONS:
                with contextlib.suppress(OSError):  # the client has closed the connection
                    self._open.popleft().shutdown(socket.SHUT_RDWR)  # its thread then ends
        try:
            super().process_request(request, client_address)
        except RuntimeError:  # the system allows no more threads
            self._forget(request)
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer a scrape in a thread."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._forget(request)

    def _forget(self, request: socket.socket) -> None:
        with self._lock, contextlib.suppress(ValueError):  # the connection has been ended
            self._open.remove(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore errors from connections that the client has closed."""


def _make_handler(registry: "CollectorRegistry") -> "type[MetricsHandler]":
    """Return a handler class that serves the metrics of a registry at PATH."""
    from prometheus_client import MetricsHandler

    class Handler(MetricsHandler):
        timeout = TIMEOUT_S

        def do_GET(self) -> None:  # noqa: N802 - the library's name
            if self.path.partition("?")[0] == PATH:
                super().do_GET()
            else:
                self.send_error(404, f"the metrics are at {PATH}")

    Handler.registry = registry
    return Handler
