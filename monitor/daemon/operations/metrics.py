"""Numbers for Prometheus: the newest of each device, as text over HTTP, where ``[metrics] listen`` says so.

The loop leaves the newest health and estimate of each device here and goes on; a scrape reads what lies there, in a
thread of the server's. So a scrape costs the loop nothing, and one that hangs holds up only itself: it is ended after
TIMEOUT_S, and of more than AT_ONCE the next is turned away. A port that is taken is tried again, and said. All numbers
are SI; a coefficient that the data only bound has ``hi`` and no value, one without an answer has nothing.
"""

import socketserver
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from http.server import BaseHTTPRequestHandler
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from drivers.sample import AXES, Event
from monitor.common.health import Health
from monitor.daemon.device_worker import Output
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients import LETTERS
from monitor.settings.loading import Metrics

if TYPE_CHECKING:
    from prometheus_client.core import Metric

RETRY_S: Final = 5.0
TIMEOUT_S: Final = 10.0
AT_ONCE: Final = 8
PAUSE_S: Final = 0.1
PATH: Final = "/metrics"
MISSING: Final = 'prometheus-client is not installed: pip install "imu-monitor[metrics]"'
STATES: Final = ("running", "waiting", "lost", "ended")
UNITS: Final = "gyroscopes Q rad, N rad/√s, B rad/s, K rad/s/√s, R rad/s²; accelerometers with m/s for rad"

Rows = Mapping[tuple[str, ...], float | None]
Numbers = Callable[[Health], float | None]

COUNTERS: Final[dict[str, tuple[str, Numbers]]] = {
    "received": ("Samples received", lambda one: one.received),
    "lost": ("Samples missing on the wire", lambda one: one.lost),
    "bad": ("Samples rejected: failed check, impossible value", lambda one: one.bad),
    "overflowed": ("Samples overwritten before they were used", lambda one: one.overflowed),
    "repeated": ("Samples that came twice and were left out", lambda one: one.repeated),
    "late": ("Samples that came after their place had passed", lambda one: one.late),
}
"""``imu_monitor_samples_<name>_total``, by device."""
GAUGES: Final[dict[str, tuple[str, Numbers]]] = {
    "sample_rate_hertz": ("Measured rate of samples", lambda one: one.rate_hz),
    "uptime_seconds": ("Since the device was started", lambda one: one.uptime_s),
    "moving": ("1 while the device is moved", lambda one: float(one.moving)),
    "limits_crossed": ("Limits of the user that are passed now", lambda one: float(len(one.crossed))),
}
"""``imu_monitor_<name>``, by device."""


class MetricsOutput(Output):
    """Keeps the newest numbers, and serves them.

    Args:
        settings: where; port 0 is any that is free
    """

    def __init__(self, settings: Metrics) -> None:
        self._settings = settings
        self.state = "starting"
        self.port = 0
        """Listened on; 0 while there is none."""
        self._healths: dict[str, Health] = {}
        self._estimates: dict[str, Estimate] = {}
        self._events: Counter[tuple[str, str]] = Counter()
        self._server: _Server | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="metrics", daemon=True)

    # --- from the loop

    def estimate(self, device: str, unix_s: float, estimate: Estimate) -> None:
        """Kept until the next."""
        self._estimates[device] = estimate

    def event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Counted."""
        self._events[device, event.kind] += 1

    def health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Kept until the next."""
        self._healths[device] = health

    def gone(self, device: str) -> None:
        """Its numbers are no longer given."""
        self._healths.pop(device, None)
        self._estimates.pop(device, None)
        for key in [key for key in self._events if key[0] == device]:
            del self._events[key]

    def start(self) -> None:
        """Listen, in a thread; trouble shows in ``state`` and is tried again there."""
        self._thread.start()

    def close(self) -> None:
        """Listen no more."""
        self._closing.set()
        server = self._server
        if server is not None:
            server.shutdown()
        if self._thread.is_alive():
            self._thread.join(RETRY_S)

    # --- what is served

    def collect(self) -> "Iterator[Metric]":
        """All numbers at one moment, as the client library's registry asks for them."""
        healths, estimates = dict(self._healths), dict(self._estimates)
        yield from _of_devices(healths)
        yield from _of_process(healths)
        yield from _coefficients(estimates)
        told: Rows = {key: float(count) for key, count in dict(self._events).items()}
        yield _labelled("events", "Events told", ("device", "kind"), told, counter=True)

    # --- the thread

    def _run(self) -> None:
        try:
            from prometheus_client import CollectorRegistry
        except ImportError:
            self.state = MISSING
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
    """One thread a scrape; not http.server's own, which asks the network for this machine's name first."""

    allow_reuse_address = True
    daemon_threads = True
    block_on_close = False

    def __init__(self, address: tuple[str, int], registry: Any) -> None:
        self.registry = registry
        self.room = threading.Semaphore(AT_ONCE)
        if ":" in address[0]:
            import socket

            self.address_family = socket.AF_INET6
        super().__init__(address, _Scrape)

    def get_request(self) -> Any:
        """The next; where there are no file descriptors for it, not at full speed again and again."""
        try:
            return super().get_request()
        except OSError:
            time.sleep(PAUSE_S)
            raise

    def process_request(self, request: Any, client_address: Any) -> None:
        """A thread, or the door where too many are inside."""
        if not self.room.acquire(blocking=False):
            self.shutdown_request(request)
            return
        try:
            super().process_request(request, client_address)
        except RuntimeError:  # the system gives no more threads
            self.room.release()
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """In the thread."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.room.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Whoever asked has gone: nothing to say, and nobody to say it to."""


class _Scrape(BaseHTTPRequestHandler):
    """One request."""

    timeout = TIMEOUT_S
    server: _Server

    def do_GET(self) -> None:
        """The numbers, in the form that is asked for."""
        from prometheus_client.exposition import choose_encoder

        if self.path.partition("?")[0] != PATH:
            self.send_error(404, f"only {PATH} is here")
            return
        encode, kind = choose_encoder(self.headers.get("Accept", ""))
        body = encode(self.server.registry)
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *arguments: Any) -> None:  # noqa: A002 - the library's name
        """A scrape every few seconds is not worth a line."""


def _of_devices(healths: Mapping[str, Health]) -> "Iterator[Metric]":
    for name, (words, number) in COUNTERS.items():
        rows: Rows = {(device,): number(one) for device, one in healths.items()}
        yield _labelled(f"samples_{name}", words, ("device",), rows, counter=True)
    for name, (words, number) in GAUGES.items():
        yield _labelled(name, words, ("device",), {(device,): number(one) for device, one in healths.items()})
    states: Rows = {(device, state): float(one.state == state) for device, one in healths.items() for state in STATES}
    yield _labelled("state", "1 for the state that the device is in", ("device", "state"), states)
    latencies: dict[tuple[str, ...], float | None] = {}
    for device, one in healths.items():
        latencies |= {(device, "0.5"): one.latency_p50_s, (device, "0.99"): one.latency_p99_s}
    words = "Receipt to published, over the last second"
    yield _labelled("latency_seconds", words, ("device", "quantile"), latencies)


def _of_process(healths: Mapping[str, Health]) -> "Iterator[Metric]":
    """What every device says alike."""
    if not healths:
        return
    newest = list(healths.values())[-1]
    yield _labelled("memory_bytes", "Resident memory of the service", (), {(): newest.memory_bytes})
    well: Rows = {
        (output,): float(state == "ok" or state.startswith("ok,"))
        for output, state in newest.outputs.items()
        if state != "off"
    }
    yield _labelled("output_up", "1 while the output works", ("output",), well)


def _coefficients(estimates: Mapping[str, Estimate]) -> "Iterator[Metric]":
    for name, words in (
        ("value", "of the window"),
        ("lo", "lower end of its 95 % interval"),
        ("hi", "upper end of its 95 % interval, or the one-sided 95 % bound where there is no value"),
    ):
        rows: Rows = {
            (device, axis, letter): float(getattr(one.coefficients, name)[row, column])
            for device, one in estimates.items()
            for column, axis in enumerate(AXES)
            for row, letter in enumerate(LETTERS)
        }
        words = f"Coefficient of IEEE Std 952, {words}; SI: {UNITS}"
        yield _labelled(
            "coefficient" if name == "value" else f"coefficient_{name}", words, ("device", "axis", "letter"), rows
        )


def _labelled(
    name: str,
    words: str,
    labels: tuple[str, ...],
    rows: Rows,
    counter: bool = False,
) -> "Metric":
    """One family; what is not known has no row."""
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

    kind = CounterMetricFamily if counter else GaugeMetricFamily
    family = kind(f"imu_monitor_{name}", words, labels=labels)
    for key, value in rows.items():
        if value is not None and np.isfinite(value):
            family.add_metric(key, value)
    return family
