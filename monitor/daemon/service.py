"""The daemon: builds and wires everything, runs the loop, stops in order.

``Service.loop`` is a corridor: take, update, publish, for each device in turn; it decides nothing. It sleeps until a
reader has pushed samples. An output that cannot start or does not keep up is shown in the status of every device;
samples go on. systemd, where it asks, is told once all outputs are up or were tried. Stopping: readers first, then what
is in the rings is worked off and published, then the outputs close.
"""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import structlog

from drivers.errors import ConfigError, NotReady, RecordingError
from drivers.links.replay_link import ReplayLink
from drivers.recordings.segment import Origin
from monitor.common.health import Health, sentence
from monitor.daemon import kernel_compilation, reload
from monitor.daemon.device_worker import Output, Station
from monitor.daemon.operations.hooks import Hooks
from monitor.daemon.operations.live_reconcile import Job, Reconciler
from monitor.daemon.operations.log_level import LEVEL
from monitor.daemon.operations.systemd import Unit
from monitor.daemon.outputs import HistoryOutput, TableOutput, ViewerOutput, ZenohOutput
from monitor.daemon.pipeline import Ready
from monitor.daemon.reload import Change
from monitor.daemon.storage.recorder import Recorder, origin
from monitor.history import reading as past
from monitor.history.query import question
from monitor.history.reading import Past
from monitor.history.sqlite_store import FILE, reading
from monitor.history.time_ranges import Span
from monitor.history.writer import Writer
from monitor.publishing.messages import encoding, history
from monitor.publishing.rerun.viewer_settings import DeviceInfo, ViewerSettings
from monitor.publishing.terminal.queued_writer import QueuedWriter
from monitor.publishing.zenoh.publisher import Command, ZenohOut
from monitor.settings.loading import Config, Device, Storage, VirtualTable

if TYPE_CHECKING:
    from monitor.daemon.operations.metrics import MetricsOutput
    from monitor.publishing.rerun.view import RerunView
    from monitor.simulator import VirtualImu

IDLE_S: Final = 0.05
PACE_S: Final = 0.02
"""Between two rounds where no device wants every block published."""
STATUS_S: Final = 1.0
STARTING: Final = ("not open yet", "starting")
"""What outputs say that were not tried yet."""
READY_S: Final = 30.0
"""The service counts as started after so long, whatever its outputs do."""
JOIN_S: Final = 3.0

_log = structlog.get_logger("imu-monitor")


class Service:
    """Everything between a configuration and its outputs.

    Args:
        config: what to run
        more: further outputs, e.g. the table in the terminal
        reconciler: runs ``command/reconcile``
        unit: where systemd is told how it goes
        writers: text outputs by name, such as "terminal" and "log"; their states are part of the status
    Raises:
        ConfigError: a simulated sensor or a model in force that cannot be
    """

    def __init__(
        self,
        config: Config,
        more: Sequence[Output] = (),
        reconciler: Reconciler | None = None,
        unit: Unit | None = None,
        writers: Mapping[str, QueuedWriter] | None = None,
    ) -> None:
        self.config = config
        self._writers = dict(writers or {})
        self._unit = unit or Unit()
        self._started_s = time.monotonic()
        self._reconciler = reconciler or Reconciler()
        self._wake = threading.Event()
        self._ready = Ready()
        self._stop = threading.Event()
        self._reload_asked = False
        self.virtual: dict[str, VirtualImu] = {}
        self.recorder = _recorder(config)
        self.stations: list[Station] = []
        self._recorded: set[str] = set()  # devices whose times are not the host's
        for device in config.devices:
            self._take_on(*self._built(device))
        self.history = _history(config)
        recall = None if self.history is None else self._recall
        self.zenoh = ZenohOut(config.zenoh, [station.name for station in self.stations], recall)
        self.view = _viewer(config, self._last)
        self._page = ""  # where the viewer's page is, as it was said last
        self.hooks = Hooks(config.hooks, self.zenoh.put_on)
        self.outputs: list[Output] = [ZenohOutput(self.zenoh), self.hooks, *more]
        self.metrics = _metrics(config)
        if self.metrics is not None:
            self.outputs.append(self.metrics)
        if self.view is not None:
            self.outputs.append(ViewerOutput(self.view))
        self._kept = None if self.history is None else HistoryOutput(self.history)
        if self._kept is not None:
            self.outputs.append(self._kept)

    def stop(self) -> None:
        """Ask the loop to end; may be called from another thread."""
        self._stop.set()
        self._wake.set()

    def reload(self) -> None:
        """Ask the loop to read the configuration again; may be called from another thread."""
        self._reload_asked = True
        self._wake.set()

    def run(self, seconds: float | None = None) -> None:
        """Start, loop until stopped (or for so many seconds, or until all replays have ended), stop in order."""
        threading.Thread(target=self._warm_up, name="warm-up", daemon=True).start()
        try:
            self._start()
            self.loop(None if seconds is None else time.monotonic() + seconds)
        finally:
            self._close()

    def _start(self) -> None:
        if self.history is not None:
            self.history.start()
        self.zenoh.start()
        if self.metrics is not None:
            self.metrics.start()
        if self.view is not None:
            self.view.start()
        for imu in self.virtual.values():
            imu.start()
        for station in self.stations:
            station.start()
        if self.recorder is not None:
            self.recorder.start()
            threading.Thread(target=self._rebuild, args=(self.stations,), name="rebuild", daemon=True).start()

    def loop(self, until_s: float | None) -> None:
        """Rounds over all devices; status once a second."""
        status_s = 0.0
        while not self._stop.is_set():
            now_s = time.monotonic()
            self._work(now_s)
            self._answer()
            self._tell_reconciled()
            if now_s >= status_s:
                status_s = now_s + STATUS_S
                self._report()
            if until_s is not None and now_s >= until_s:
                return
            if all(station.ended for station in self.stations):
                return
            if self._reload_asked:
                self._reload_asked = False
                self._reload()
            self._wake.wait(IDLE_S)
            self._wake.clear()
            if not any(station.device.publish_s == 0.0 for station in self.stations):
                self._stop.wait(PACE_S)

    def _work(self, now_s: float) -> None:
        for station in self.stations:
            station.work(self.outputs, now_s)
            self.zenoh.alive(station.name, station.driver.state == "running")

    def states(self) -> dict[str, str]:
        """Output -> "ok" or what is wrong with it."""
        states = {"zenoh": self.zenoh.state}
        if self.view is not None:
            states["viewer"] = self.view.state
        if self.recorder is not None:
            states["recording"] = self.recorder.state
        if self.history is not None:
            states["history"] = self.history.state
        if self.metrics is not None:
            states["metrics"] = self.metrics.state
        if self.hooks.hooks:
            states["hook"] = self.hooks.state
        return states | {name: writer.state for name, writer in self._writers.items()}

    def _rebuild(self, stations: Sequence[Station]) -> None:
        """Windows from the recording, as soon as that can be computed."""
        self._ready.all.wait()
        for station in stations:
            station.rebuild()

    def _last(self, device: str) -> Past | None:
        """What the viewer opens on; called by its thread. A recording that is replayed brings its own past."""
        history_s = self.config.viewer.history
        if self.history is None or history_s is None or device in self._recorded:
            return None
        assert isinstance(history_s, float)
        now_s = time.time()
        try:
            with reading(self.history.path) as reader:
                return past.read(reader, device, Span(now_s - history_s, now_s))
        except (NotReady, RecordingError):  # nothing yet; what is wrong with the file the writer says
            return None

    def _recall(self, device: str, parameters: str) -> bytes:
        """The answer to a query of a device's history; called by a thread of its own.

        Raises:
            ImuError: the question is wrong, or there is nothing to answer it with
        """
        assert self.history is not None
        assert self._kept is not None
        asked = question(parameters, time.time())
        with reading(self.history.path) as reader:
            found = past.read(reader, device, asked.span, asked.wants, asked.step_s)
            newest_s = reader.newest_s(device)
        return history.history(found, asked, newest_s, self._kept.received.get(device, 0))

    def _warm_up(self) -> None:
        """Beside the loop, so that a first start's compilation holds up neither samples nor status."""
        begun_s = time.monotonic()
        flags = {kernel_compilation.WINDOW: self._ready.window, kernel_compilation.FIT: self._ready.fit}
        try:
            for part in kernel_compilation.prepare(kernel_compilation.SERVICE, self._tell_progress):
                if part in flags:
                    flags[part].set()
                    self._wake.set()
            if self._ready.progress:
                _log.info("kernels are compiled and kept for the next start", seconds=round(time.monotonic() - begun_s))
        except OSError as error:
            _log.warning("compiled kernels cannot be kept, the next start will be slow again", error=str(error))
        finally:
            self._ready.progress = ""
            # what has failed is compiled by the loop, or ends it; without this it would wait for ever
            for flag in (self._ready.window, self._ready.fit, self._ready.all):
                flag.set()
            self._wake.set()

    def _tell_progress(self, progress: kernel_compilation.Progress) -> None:
        if not self._ready.progress:
            _log.info("compiling kernels, as none are kept for this version on this machine")
        self._ready.progress = f"{progress} {progress.bar}"
        self._wake.set()

    def _built(self, device: Device) -> "tuple[Station, VirtualImu | None]":
        """A device, and the sensor where it is simulated; nothing of it is open."""
        link, imu = device.link, None
        if isinstance(link, VirtualTable):
            from monitor.simulator import VirtualImu

            imu = VirtualImu(link, device.decoder, device.name)
            link = imu.link
        return Station(device, link, device.decoder, self._wake, self._ready, self.recorder), imu

    def _take_on(self, station: Station, imu: "VirtualImu | None") -> None:
        self.stations = [*self.stations, station]
        if station.driver.times_are_unix:
            self._recorded.add(station.name)
        if imu is not None:
            self.virtual[station.name] = imu

    # --- another configuration

    def _reload(self) -> None:
        """What another reading of the file changes; where anything is wrong with it, nothing."""
        self._unit.reloading()
        try:
            change = reload.change(self.config, {station.name: station.model for station in self.stations})
            built = [self._built(device) for device in change.added]
        except ConfigError as error:
            _log.error("not reloaded, all goes on as it was", error=str(error))
        else:
            self._apply(change, built)
            (_log.warning if change.restart else _log.info)("reloaded", text=change.text())
        if self._unit.told_ready:
            self._unit.ready()

    def _apply(self, change: Change, built: "Sequence[tuple[Station, VirtualImu | None]]") -> None:
        leaving = [station for station in self.stations if station.name in change.removed]
        for station in leaving:
            station.stop()  # all at once: each may take a moment
        for station in leaving:
            self._remove(station)
        for device in change.limited:
            next(station for station in self.stations if station.name == device.name).limit(device)
        self.config = change.config
        self.hooks.hooks = change.config.hooks
        LEVEL.name = change.config.log.level
        for station, imu in built:
            self._take_on(station, imu)
        order = [device.name for device in change.config.devices]
        self.stations.sort(key=lambda station: order.index(station.name))
        if self.view is not None:
            self.view.show(_shown(change.config.devices))
        for station, imu in built:
            self._add(station, imu)

    def _add(self, station: Station, imu: "VirtualImu | None") -> None:
        """Start a device while the others run."""
        self.zenoh.add(station.name)
        if self.recorder is not None:
            self.recorder.add(_origins(self.config.storage, station.device))
        if imu is not None:
            imu.start()
        station.start()
        if self.recorder is not None:
            threading.Thread(target=self._rebuild, args=([station],), name="rebuild", daemon=True).start()

    def _remove(self, station: Station) -> None:
        """Part with a device that was asked to stop, and publish what it still brought, while the others run."""
        if station.name in self.virtual:
            self.virtual.pop(station.name).stop()
        if not self._meanwhile(lambda: station.join(0.0) and not station.rebuilding):
            _log.warning("reader did not end in time", device=station.name)
        station.work(self.outputs, time.monotonic(), drain=True)
        self.stations = [one for one in self.stations if one is not station]
        self.zenoh.remove(station.name)
        if self.recorder is not None:
            self.recorder.remove(station.name)
            self._meanwhile(lambda: self.recorder is None or not self.recorder.has(station.name))
        self._recorded.discard(station.name)
        for output in self.outputs:
            output.gone(station.name)

    def _meanwhile(self, done: Callable[[], bool]) -> bool:
        """Go on with all devices until something is done, JOIN_S at most; whether it is."""
        until_s = time.monotonic() + JOIN_S
        while not (ended := done()) and time.monotonic() < until_s:
            self._work(time.monotonic())
            time.sleep(PACE_S)
        return ended

    # --- telling

    def _report(self) -> None:
        self._tell_recording()
        states, memory = self.states(), memory_bytes()
        self._tell_page()
        healths = {station.name: station.report(self.outputs, states, memory) for station in self.stations}
        self._tell_unit(healths, states)

    def _tell_unit(self, healths: Mapping[str, Health], states: Mapping[str, str]) -> None:
        """systemd: whether all is up, how it goes, and that the readers move on."""
        now_s = time.monotonic()
        tried = not any(state in STARTING for state in states.values()) or now_s - self._started_s > READY_S
        if tried and not self._unit.told_ready:
            self._unit.ready()
        turns = {station.name: station.turns for station in self.stations}
        stuck = self._unit.alive({name: count for name, count in turns.items() if count is not None}, now_s)
        self._unit.status(sentence(healths, states, stuck))

    def _tell_recording(self) -> None:
        stations = {station.name: station for station in self.stations}
        for told in self.recorder.take() if self.recorder is not None else ():
            if told.device in stations:
                stations[told.device].announce(self.outputs, told.kind, told.text)

    def _tell_page(self) -> None:
        """Say where the viewer's page is, once for each place; a window needs no address."""
        url = self.view.url if self.view is not None else ""
        page = url if url.startswith("http://") else ""
        if page == self._page:
            return
        self._page = page
        if page:
            _log.info("viewer", url=page)
        for output in self.outputs:
            if isinstance(output, TableOutput):
                output.viewer_at(page)

    def _answer(self) -> None:
        """Commands that came over zenoh since the last round."""
        stations = {station.name: station for station in self.stations}
        while not self.zenoh.commands.empty():
            command = self.zenoh.commands.get_nowait()
            if command.device in stations:
                self._obey(command, stations[command.device])
            else:
                command.refuse("the device was taken out of the configuration")

    def _obey(self, command: Command, station: Station) -> None:
        match command.verb:
            case "reset":
                station.reset()
                received = station.driver.counts.received
                command.answer(encoding.reply(station.name, station.now_unix_s(), received, "the window is empty"))
                _log.info("reset", device=station.name)
            case "reconcile":
                self._reconcile(command, station)
            case other:
                command.refuse(f'unknown command "{other}"; known are reset, reconcile')

    def _reconcile(self, command: Command, station: Station) -> None:
        """Hand a copy of the window over; the answer comes from a thread of its own."""
        held = station.held()
        if held is None:
            command.refuse("no samples yet")
            return
        received, device = station.driver.counts.received, station.device
        newest_s = station.unix_s(station.chain.newest_ns)
        job = Job(station.name, newest_s, received, *held, device.model, device.reconcile_folder)
        self._reconciler.start(job, command)

    def _tell_reconciled(self) -> None:
        stations = {station.name: station for station in self.stations}
        for finished in self._reconciler.take():
            if finished.device in stations:
                stations[finished.device].announce(self.outputs, "reconciled", finished.text)

    def _close(self) -> None:
        self._unit.stopping()
        try:
            self._drain()
        finally:
            self._reconciler.close()
            self._tell_reconciled()
            if self.recorder is not None:
                self.recorder.close()
            self.hooks.close()
            if self.metrics is not None:
                self.metrics.close()
            if self.view is not None:
                self.view.close()
            self.zenoh.close()
            if self.history is not None and self._kept is not None:
                self._kept.end()
                self.history.close()

    def _drain(self) -> None:
        """End the readers, and publish what they still brought."""
        for station in self.stations:
            station.stop()
        if any(station.waits_for_all for station in self.stations):
            self._ready.all.wait()  # their samples are still in the ring
        for imu in self.virtual.values():
            imu.stop()
        for station in self.stations:
            until_s = time.monotonic() + JOIN_S
            while not (ended := station.join(PACE_S)) and time.monotonic() < until_s:
                station.work(self.outputs, time.monotonic())  # a replay waits for room
            if not ended:
                _log.warning("reader did not end in time", device=station.name)
            station.work(self.outputs, time.monotonic(), drain=True)
            self.zenoh.alive(station.name, False)
        self._report()


def _recorder(config: Config) -> Recorder | None:
    storage = config.storage
    origins = [one for device in config.devices for one in _origins(storage, device)]
    return Recorder(storage, origins) if storage is not None and origins else None


def _origins(storage: Storage | None, device: Device) -> list[Origin]:
    """What of a device is wanted in the recording; a replay is one already."""
    if storage is None or isinstance(device.link, ReplayLink):
        return []
    origins = [origin(device.name, device.axes)] if storage.record else []
    return origins + ([origin(device.name, device.axes, "raw", device.decoder.carrier)] if storage.raw else [])


def memory_bytes() -> int:
    """Resident memory of this process."""
    try:
        pages = int(Path("/proc/self/statm").read_text("ascii").split()[1])
    except OSError:  # no Linux: the peak is the nearest there is
        import resource
        import sys

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else peak * 1024
    import resource

    return pages * resource.getpagesize()


def _history(config: Config) -> Writer | None:
    if config.storage is None or not config.storage.history:
        return None
    return Writer(config.storage.folder / FILE, time.time)


def _metrics(config: Config) -> "MetricsOutput | None":
    if config.metrics is None:
        return None
    from monitor.daemon.operations.metrics import MetricsOutput  # with http.server

    return MetricsOutput(config.metrics)


def _viewer(config: Config, recall: Callable[[str], Past | None]) -> "RerunView | None":
    if config.viewer.mode == "none":
        return None
    from monitor.publishing.rerun.view import RerunView

    own = config.viewer
    return RerunView(ViewerSettings(own.mode, own.port, own.web_port, own.memory), _shown(config.devices), recall)


def _shown(devices: Sequence[Device]) -> list[DeviceInfo]:
    return [
        DeviceInfo(
            device.name, _about(device), device.model is not None, device.thermal_s is not None, device.compensate
        )
        for device in devices
    ]


def _about(device: Device) -> str:
    return "simulated" if isinstance(device.link, VirtualTable) else device.link.name
