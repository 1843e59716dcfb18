"""Prometheus metrics over HTTP: the newest values of each device, if ``[metrics] listen`` is set.

The main loop stores the newest status and estimate of each device. A server thread answers each scrape with the stored
values, so a scrape does not delay the main loop. If the port is in use, the server tries again.

All values are in SI units. A coefficient with only an upper bound has ``hi`` and no value. A coefficient that is not
estimated has no entry.
"""

import socket
import socketserver
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from drivers.data_types import AXES, Event
from monitor.common.device_health import Health
from monitor.daemon.outputs.output import Output
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS
from monitor.noise.effect import gyro_and_accel_units
from monitor.noise.standard_terms import STANDARD_TERMS
from monitor.settings.loading import MetricsAddress

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry, MetricsHandler
    from prometheus_client.core import Metric

RETRY_S: Final = 5.0
"""Interval between two attempts to listen."""
TIMEOUT_S: Final = 10.0
"""Maximum duration of a scrape."""
MAX_SCRAPES: Final = 8
"""Maximum number of concurrent scrapes."""
PAUSE_S: Final = 0.1
"""Pause after a failed connection."""
PATH: Final = "/metrics"
"""Path of the metrics in the URL."""
MISSING_LIBRARY_TEXT: Final = 'prometheus-client is not installed: pip install "imu-monitor[metrics]"'
"""Status message if the library is not installed."""
STATES: Final = ("running", "waiting", "lost", "ended")
"""Possible states of a device."""
_GYRO_UNITS: Final = ", ".join(
    f"{symbol} {gyro_and_accel_units(term)[symbol][0]}" for symbol, term in STANDARD_TERMS.items()
)
UNITS: Final = f"gyroscopes {_GYRO_UNITS}; accelerometers with m/s for rad"
"""Units of the coefficients in the descriptions."""

Rows = Mapping[tuple[str, ...], float | None]
"""Values of one metric by label values, or None if unknown."""
Numbers = Callable[[Health], float | None]
"""Function that reads one value from the health of a device."""

COUNTERS: Final[dict[str, tuple[str, Numbers]]] = {
    "received": ("Samples received", lambda one: one.received),
    "lost": ("Samples missing on the wire", lambda one: one.lost),
    "bad": ("Samples rejected because of a failed check or an impossible value", lambda one: one.bad),
    "overflowed": ("Samples overwritten before they were used", lambda one: one.overflowed),
    "repeated": ("Repeated samples, which were discarded", lambda one: one.repeated),
    "late": ("Samples that arrived too late and were discarded", lambda one: one.late),
}
"""Descriptions and values of the counters ``imu_monitor_samples_<name>_total``."""
GAUGES: Final[dict[str, tuple[str, Numbers]]] = {
    "sample_rate_hertz": ("Measured sample rate", lambda one: one.rate_hz),
    "uptime_seconds": ("Time since the device was started", lambda one: one.uptime_s),
    "moving": ("1 while the device is moved", lambda one: float(one.moving)),
    "limits_crossed": ("Number of crossed user limits", lambda one: float(len(one.crossed))),
}
"""Descriptions and values of the gauges ``imu_monitor_<name>``."""


class MetricsOutput(Output):
    """Output that serves the newest values of each device to Prometheus.

    Parameters
    ----------
    settings : MetricsAddress
        Address of the server. Port 0 selects a free port.
    """

    def __init__(self, settings: MetricsAddress) -> None:
        self._settings = settings
        self.state = "starting"
        self.port = 0
        """Port of the server, or 0 while the server does not listen."""
        self._healths: dict[str, Health] = {}
        self._estimates: dict[str, Estimate] = {}
        self._events: Counter[tuple[str, str]] = Counter()
        self._server: _Server | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="metrics", daemon=True)

    # --- called by the main loop

    def publish_result(self, device: str, unix_s: float, received: int, result: Any) -> None:
        """Store the newest estimate of a device."""
        if isinstance(result, Estimate):
            self._estimates[device] = result

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Count an event of a device."""
        self._events[device, event.kind] += 1

    def publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Store the newest status of a device."""
        self._healths[device] = health

    def remove_device(self, device: str) -> None:
        """Remove the stored values of a device."""
        self._healths.pop(device, None)
        self._estimates.pop(device, None)
        for key in [key for key in self._events if key[0] == device]:
            del self._events[key]

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
        healths, estimates = dict(self._healths), dict(self._estimates)
        yield from _device_metrics(healths)
        yield from _process_metrics(healths)
        yield from _coefficient_metrics(estimates)
        counts: Rows = {key: float(count) for key, count in dict(self._events).items()}
        yield _metric("events", "Number of events", ("device", "kind"), counts, counter=True)

    # --- server thread

    def _run(self) -> None:
        try:
            from prometheus_client import CollectorRegistry
        except ImportError:
            self.state = MISSING_LIBRARY_TEXT
            return
        registry = CollectorRegistry(auto_describe=False)
        registry.register(self)
        while not self._closing.is_set():
            try:
                server = _Server((self._settings.host, self._settings.port), registry)
            except (OSError, UnicodeError) as error:
                where = f"{self._settings.host}:{self._settings.port}"
                self.state = f"{where}: {getattr(error, 'strerror', None) or error}; trying again"
                self._closing.wait(RETRY_S)
                continue
            with server:
                self._server, self.port, self.state = server, int(server.server_address[1]), "ok"
                if not self._closing.is_set():
                    server.serve_forever()
            self.port = 0


class _Server(socketserver.ThreadingTCPServer):
    """Server with one thread per scrape.

    The server class of http.server is not used, because it queries the network for the name of the host.
    """

    allow_reuse_address = True
    daemon_threads = True
    block_on_close = False

    def __init__(self, address: tuple[str, int], registry: "CollectorRegistry") -> None:
        self._free = threading.Semaphore(MAX_SCRAPES)
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
        """Start a thread for a scrape, or reject the scrape if too many scrapes are active."""
        if not self._free.acquire(blocking=False):
            self.shutdown_request(request)
            return
        try:
            super().process_request(request, client_address)
        except RuntimeError:  # the system allows no more threads
            self._free.release()
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer a scrape in a thread."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore errors of connections that the client has closed."""


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


def _device_metrics(healths: Mapping[str, Health]) -> "Iterator[Metric]":
    for name, (words, number) in COUNTERS.items():
        rows: Rows = {(device,): number(one) for device, one in healths.items()}
        yield _metric(f"samples_{name}", words, ("device",), rows, counter=True)
    for name, (words, number) in GAUGES.items():
        yield _metric(name, words, ("device",), {(device,): number(one) for device, one in healths.items()})
    states: Rows = {(device, state): float(one.state == state) for device, one in healths.items() for state in STATES}
    yield _metric("state", "1 for the present state of the device", ("device", "state"), states)
    latencies: dict[tuple[str, ...], float | None] = {}
    for device, one in healths.items():
        latencies |= {(device, "0.5"): one.latency_p50_s, (device, "0.99"): one.latency_p99_s}
    words = "Latency from reception to publication, over the last second"
    yield _metric("latency_seconds", words, ("device", "quantile"), latencies)


def _process_metrics(healths: Mapping[str, Health]) -> "Iterator[Metric]":
    if not healths:
        return
    newest = list(healths.values())[-1]
    yield _metric("memory_bytes", "Resident memory of the service", (), {(): newest.memory_bytes})
    well: Rows = {
        (output,): float(state == "ok" or state.startswith("ok,"))
        for output, state in newest.outputs.items()
        if state != "off"
    }
    yield _metric("output_up", "1 while the output works", ("output",), well)


def _coefficient_metrics(estimates: Mapping[str, Estimate]) -> "Iterator[Metric]":
    for name, words in (
        ("value", "of the window"),
        ("lo", "lower end of the 95 % interval"),
        ("hi", "upper end of the 95 % interval, or the one-sided 95 % bound if there is no value"),
    ):
        rows: Rows = {
            (device, axis, letter): float(getattr(one.coefficients, name)[row, column])
            for device, one in estimates.items()
            for column, axis in enumerate(AXES)
            for row, letter in enumerate(SYMBOLS)
        }
        words = f"Coefficient of IEEE Std 952, {words}; SI: {UNITS}"
        yield _metric(
            "coefficient" if name == "value" else f"coefficient_{name}", words, ("device", "axis", "letter"), rows
        )


def _metric(
    name: str,
    words: str,
    labels: tuple[str, ...],
    rows: Rows,
    counter: bool = False,
) -> "Metric":
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

    kind = CounterMetricFamily if counter else GaugeMetricFamily
    family = kind(f"imu_monitor_{name}", words, labels=labels)
    for key, value in rows.items():
        if value is not None and np.isfinite(value):
            family.add_metric(key, value)
    return family
