"""Process of the daemon that owns the outputs: zenoh, viewer, hooks, metrics, history, table and systemd messages.

``Service`` processes the devices in the same process. ``WorkerSupervisor`` publishes the results of worker processes.
If an output fails, the status of every device reports the problem, and sampling continues. systemd receives the
readiness message after the first attempt to start each output.
"""

import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import structlog

from drivers.data_types import SenderTimedFormat
from drivers.errors import ConfigError
from drivers.host.wake_signal import WakeSignal
from drivers.secret_masking import mask_secrets
from monitor.common.device_health import Health, format_service_status
from monitor.common.unexpected_errors import log_unexpected_error
from monitor.common.unit_formatting import UNIT_SYSTEMS
from monitor.daemon.config_changes import ConfigChange
from monitor.daemon.operations.hooks import Hooks
from monitor.daemon.operations.log_level import set_log_level
from monitor.daemon.operations.systemd import SystemdNotifier
from monitor.daemon.outputs.history_output import HistoryOutput
from monitor.daemon.outputs.output import Output, call_outputs
from monitor.daemon.outputs.viewer_output import ViewerOutput
from monitor.daemon.outputs.zenoh_output import ZenohOutput
from monitor.history.bucketed_history import HistoryTable
from monitor.publishing.rerun.viewer_settings_and_errors import ViewerDeviceDescription, ViewerSettings
from monitor.publishing.terminal.queued_writer import QueuedWriter
from monitor.publishing.zenoh.publisher import ZenohPublisher
from monitor.settings.loading import Config, Device, VirtualTable

if TYPE_CHECKING:
    from monitor.daemon.operations.prometheus_metrics import MetricsOutput
    from monitor.daemon.outputs.influx_output import InfluxOutput
    from monitor.daemon.outputs.ros2_output import Ros2Output
    from monitor.publishing.rerun.queued_view import RerunView

MAX_IDLE_S: Final = 0.2
"""Longest wait of the main loop if no samples or results arrive."""
STATUS_INTERVAL_S: Final = 1.0
"""Interval of the status messages."""
STARTING_STATES: Final = ("not open yet", "starting")
"""States of an output before the first attempt to start it."""
READY_TIMEOUT_S: Final = 30.0
"""Time after which readiness is reported to systemd, even if an output has not been started."""

_log = structlog.get_logger("imu-monitor")


class DaemonProcess:
    """Outputs and main loop of the daemon. A subclass provides the results of the devices.

    Parameters
    ----------
    config : Config
        Configuration to run.
    more : sequence of Output, optional
        Additional outputs, for example the table in the terminal.
    unit : SystemdNotifier, optional
        Notifier of systemd. By default, no message is sent.
    writers : mapping of str to QueuedWriter, optional
        Text outputs by name, such as "terminal" and "log".
    """

    def __init__(
        self,
        config: Config,
        more: Sequence[Output] = (),
        unit: SystemdNotifier | None = None,
        writers: Mapping[str, QueuedWriter] | None = None,
    ) -> None:
        self.config = config
        self._writers = dict(writers or {})
        self._unit = unit or SystemdNotifier()
        self._started_s = time.monotonic()
        self._wake = WakeSignal()
        self._stop = threading.Event()
        self._reload_asked = False
        self._config_reader: threading.Thread | None = None  # reads the configuration file again
        self._config_change: ConfigChange | ConfigError | None = None  # what the thread has found
        storage = config.storage
        self.history = HistoryOutput(storage.folder) if storage is not None and storage.history else None
        answer_query = None if self.history is None else self.history.answer_query
        self.zenoh = ZenohPublisher(config.zenoh, [device.name for device in config.devices], answer_query)
        self.viewer = _build_view(config, self._read_viewer_history)
        self._viewer_url = ""  # last announced URL of the web viewer
        self.hooks = Hooks(config.hooks, self.zenoh.publish_json_return_error)
        self.metrics = _build_metrics_output(config)
        self.influx = _build_influx_output(config)
        self.ros2 = _build_ros2_output(config)
        viewer = None if self.viewer is None else ViewerOutput(self.viewer)
        optional = (self.metrics, self.influx, self.ros2, viewer, self.history)
        self.outputs: list[Output] = [
            ZenohOutput(self.zenoh), self.hooks, *more, *(one for one in optional if one is not None)
        ]  # fmt: skip

    def request_stop(self) -> None:
        """Request the end of the main loop, from any thread."""
        self._stop.set()
        self._wake.set()

    def request_reload(self) -> None:
        """Request a reload of the configuration file, from any thread."""
        self._reload_asked = True
        self._wake.set()

    def run(self, seconds: float | None = None) -> None:
        """Run the daemon until ``request_stop`` is called, all replays have ended, or ``seconds`` have passed."""
        try:
            for output in (self.history, self.zenoh, self.metrics, self.influx, self.ros2, self.viewer):
                if output is not None:
                    output.start()
            self._start_devices()
            self.run_main_loop(None if seconds is None else time.monotonic() + seconds)
        finally:
            self._close()

    def run_main_loop(self, until_s: float | None) -> None:
        """Publish the results of all devices in rounds, and publish the status once a second.

        The loop ends after ``request_stop``, at the end of all replays, or at the monotonic time ``until_s``.
        """
        status_s = 0.0
        while not self._stop.is_set():
            now_s = time.monotonic()
            self._work(now_s)
            if now_s >= status_s:
                status_s = now_s + STATUS_INTERVAL_S
                self._publish_status()
            call_outputs(self.outputs, "finish_round")
            if self._has_ended() or (until_s is not None and now_s >= until_s):
                return
            if self._reload_asked and self._config_reader is None:
                self._reload_asked = False
                self._begin_reload()
            change = self._config_change
            if change is not None:
                self._config_reader = self._config_change = None
                self._finish_reload(change)
            self._wait(now_s)

    def output_states(self) -> dict[str, str]:
        """Return the state of each output by name: "ok", or a description of the problem."""
        outputs = {
            "zenoh": self.zenoh,
            "viewer": self.viewer,
            "history": self.history,
            "metrics": self.metrics,
            "influx": self.influx,
            "ros2": self.ros2,
            "hook": self.hooks if self.hooks.hooks else None,
            **self._writers,
        }
        states = {name: output.state for name, output in outputs.items() if output is not None}
        states |= {output.name: output.failure.text for output in self.outputs if output.failure.text}
        return {name: mask_secrets(state) for name, state in states.items()}

    # --- defined by the subclasses

    def _start_devices(self) -> None:
        """Start all devices."""
        raise NotImplementedError

    def _work(self, now_s: float) -> None:
        """Publish the new results of all devices, and execute commands."""
        raise NotImplementedError

    def _wait(self, round_start_s: float) -> None:
        """Wait for new samples or results, up to MAX_IDLE_S, after a round that began at this monotonic time."""
        raise NotImplementedError

    def _has_ended(self) -> bool:
        """Return True if all devices are replays that have ended."""
        raise NotImplementedError

    def _publish_status(self) -> None:
        """Publish the status of all devices, and call ``_report_status``."""
        raise NotImplementedError

    def _stop_devices(self) -> None:
        """Stop all devices, and publish the remaining results."""
        raise NotImplementedError

    def _find_changes(self) -> ConfigChange:
        """Return the changes since the configuration was read. Raise ConfigError if the new one is invalid.

        Another thread calls this method.
        """
        raise NotImplementedError

    def _apply(self, change: ConfigChange) -> None:
        """Apply a change of the configuration to the devices, and call ``_adopt``."""
        raise NotImplementedError

    # --- stop and reload

    def _close(self) -> None:
        self._unit.send_stopping()
        try:
            self._stop_devices()
        finally:
            exporters = (self.metrics, self.influx, self.ros2, self.viewer, self.zenoh)
            for output in (self.hooks, *exporters, self.history):
                if output is not None:
                    output.close()

    def _begin_reload(self) -> None:
        """Read the configuration again in a thread, because a large file takes seconds."""

        def read() -> None:
            try:
                self._config_change = self._find_changes()
            except ConfigError as error:
                self._config_change = error
            except Exception as error:  # noqa: BLE001 - the log contains the error
                self._config_change = ConfigError(log_unexpected_error("reload", error))
            self._wake.set()

        self._unit.send_reloading()
        self._config_reader = threading.Thread(target=read, name="reload", daemon=True)
        try:
            self._config_reader.start()
        except RuntimeError as error:  # the system allows no more threads
            self._config_change = ConfigError(str(error))

    def _finish_reload(self, change: ConfigChange | ConfigError) -> None:
        """Apply the changes of the configuration, unless it contains an error."""
        try:
            if isinstance(change, ConfigError):
                raise change
            self._apply(change)
        except ConfigError as error:
            _log.error("not reloaded, the running configuration stays in force", error=str(error))
        else:
            (_log.warning if change.restart else _log.info)("reloaded", text=change.describe_changes())
        if self._unit.ready_sent:
            self._unit.send_ready()

    def _adopt(self, config: Config) -> None:
        """Replace the configuration and the settings that apply to all devices."""
        self.config = config
        self.hooks.hooks = config.hooks
        set_log_level(config.log.level)
        if self.viewer is not None:
            self.viewer.set_detailed_devices(_device_features(config.devices))

    # --- status

    def _report_status(
        self, healths: Mapping[str, Health], states: Mapping[str, str], progress: Mapping[str, int]
    ) -> None:
        """Announce the viewer, and send the status of all devices to ROS 2 and systemd.

        Parameters
        ----------
        healths : mapping of str to Health
            Status of each device by its name.
        states : mapping of str to str
            State of each output by its name.
        progress : mapping of str to int
            Number of read attempts of each reader thread that must not block.
        """
        self._announce_viewer_url()
        if self.ros2 is not None:
            self.ros2.publish_diagnostics()
        now_s = time.monotonic()
        tried = (
            not any(state in STARTING_STATES for state in states.values()) or now_s - self._started_s > READY_TIMEOUT_S
        )
        if tried and not self._unit.ready_sent:
            self._unit.send_ready()
        stuck = self._unit.send_watchdog(progress, now_s)
        self._unit.send_status(format_service_status(healths, states, stuck))

    def _announce_viewer_url(self) -> None:
        """Pass the URL of the web viewer to the outputs each time the URL changes."""
        url = self.viewer.url if self.viewer is not None else ""
        page = url if url.startswith("http://") else ""
        if page == self._viewer_url:
            return
        self._viewer_url = page
        call_outputs(self.outputs, "set_viewer_url", page)

    def _read_viewer_history(self, device: str) -> HistoryTable | None:
        """Return the stored results that the viewer shows at the start, or None if there are no results.

        Results of a device with its own time stamps, such as a replayed recording, are not shown.
        """
        history_s = self.config.viewer.history
        self_timed = any(one.name == device and _has_own_times(one) for one in self.config.devices)
        if self.history is None or history_s is None or self_timed:
            return None
        assert isinstance(history_s, float)
        return self.history.read_recent_history(device, history_s)


def measure_memory_bytes() -> int:
    """Return the resident memory of this process in bytes."""
    import resource  # missing on Windows

    try:
        return int(Path("/proc/self/statm").read_text("ascii").split()[1]) * resource.getpagesize()
    except OSError:  # only the peak is available outside Linux
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else peak * 1024


def _build_metrics_output(config: Config) -> "MetricsOutput | None":
    if config.metrics is None:
        return None
    from monitor.daemon.operations.prometheus_metrics import (
        MetricsOutput,  # imports http.server, so only if it is needed
    )

    return MetricsOutput(config.metrics)


def _build_influx_output(config: Config) -> "InfluxOutput | None":
    settings = config.influx
    if settings is None or settings.url is None:
        return None
    from monitor.daemon.outputs.influx_output import InfluxOutput  # imports http.client, so only if it is needed

    return InfluxOutput(settings.url, settings.token_file, settings.interval_s)


def _build_ros2_output(config: Config) -> "Ros2Output | None":
    if config.ros2 is None:
        return None
    from monitor.daemon.outputs.ros2_output import Ros2Output

    return Ros2Output(config.ros2, config.devices)


def _build_view(config: Config, recall: Callable[[str], HistoryTable | None]) -> "RerunView | None":
    if config.viewer.mode == "none":
        return None
    from monitor.publishing.rerun.queued_view import RerunView

    own = config.viewer
    return RerunView(
        ViewerSettings(own.mode, own.port, own.web_port, own.memory, UNIT_SYSTEMS[own.units]),
        _device_features(config.devices),
        recall,
    )


def _device_features(devices: Sequence[Device]) -> list[ViewerDeviceDescription]:
    return [
        ViewerDeviceDescription(
            device.name,
            "simulated" if isinstance(device.link, VirtualTable) else device.link.name,
            device.model is not None,
            device.thermal_s is not None,
            device.compensate,
        )
        for device in devices
    ]


def _has_own_times(device: Device) -> bool:
    return getattr(device.link, "epoch", "") == "unix" or isinstance(device.decoder.timing, SenderTimedFormat)
