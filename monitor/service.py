"""The daemon: builds and wires everything, runs the loop, stops in order.

``Service.loop`` is a corridor: take, update, publish, for each device in turn; it decides nothing. It sleeps until a
reader has pushed samples. An output that cannot start or does not keep up is shown in the status of every device;
samples go on. systemd, where it asks, is told once all outputs are up or were tried. Stopping: readers first, then what
is in the rings is worked off and published, then the outputs close.
"""

import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import structlog

from drivers.links.replay_link import ReplayLink
from monitor.drift import compensator, heat
from monitor.estimate.estimator import warm_up
from monitor.health import Health, sentence
from monitor.hooks import Hooks
from monitor.live_reconcile import Job, Reconciler
from monitor.outputs import TableOutput, ViewerOutput, ZenohOutput
from monitor.publish import message
from monitor.publish.viewer import DeviceInfo, ViewerSettings
from monitor.publish.zenoh_out import Command, ZenohOut
from monitor.recorder import Recorder, origin
from monitor.settings import Config, Device, VirtualTable
from monitor.station import Output, Ready, Station
from monitor.systemd import Unit
from monitor.virtual import VirtualImu

if TYPE_CHECKING:
    from monitor.publish.rerun_view import RerunView

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
    Raises:
        ConfigError: a simulated sensor or a model in force that cannot be
    """

    def __init__(
        self,
        config: Config,
        more: Sequence[Output] = (),
        reconciler: Reconciler | None = None,
        unit: Unit | None = None,
    ) -> None:
        self.config = config
        self._unit = unit or Unit()
        self._started_s = time.monotonic()
        self._reconciler = reconciler or Reconciler()
        self._wake = threading.Event()
        self._ready = Ready()
        self._stop = threading.Event()
        self.virtual: dict[str, VirtualImu] = {}
        self.recorder = _recorder(config)
        self.stations = [self._station(device) for device in config.devices]
        self.zenoh = ZenohOut(config.zenoh, [station.name for station in self.stations])
        self.view = _viewer(config)
        self._page = ""  # where the viewer's page is, as it was said last
        self.hooks = Hooks(config.hooks, self.zenoh.put_on)
        self.outputs: list[Output] = [ZenohOutput(self.zenoh), self.hooks, *more]
        if self.view is not None:
            recorded = {station.name for station in self.stations if station.driver.times_are_unix}
            self.outputs.append(ViewerOutput(self.view, recorded))
        every_block = any(device.publish_s == 0.0 for device in config.devices)
        self._pace_s = 0.0 if every_block else PACE_S

    def stop(self) -> None:
        """Ask the loop to end; may be called from another thread."""
        self._stop.set()
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
        self.zenoh.start()
        if self.view is not None:
            self.view.start()
        for imu in self.virtual.values():
            imu.start()
        for station in self.stations:
            station.start()
        if self.recorder is not None:
            self.recorder.start()
            threading.Thread(target=self._rebuild, name="rebuild", daemon=True).start()

    def loop(self, until_s: float | None) -> None:
        """Rounds over all devices; status once a second."""
        status_s = 0.0
        while not self._stop.is_set():
            now_s = time.monotonic()
            for station in self.stations:
                station.work(self.outputs, now_s)
                self.zenoh.alive(station.name, station.driver.state == "running")
            self._answer()
            self._tell_reconciled()
            if now_s >= status_s:
                status_s = now_s + STATUS_S
                self._report()
            if until_s is not None and now_s >= until_s:
                return
            if all(station.ended for station in self.stations):
                return
            self._wake.wait(IDLE_S)
            self._wake.clear()
            if self._pace_s:
                self._stop.wait(self._pace_s)

    def states(self) -> dict[str, str]:
        """Output -> "ok" or what is wrong with it."""
        states = {"zenoh": self.zenoh.state}
        if self.view is not None:
            states["viewer"] = self.view.state
        if self.recorder is not None:
            states["recording"] = self.recorder.state
        if self.hooks.hooks:
            states["hook"] = self.hooks.state
        return states

    def _rebuild(self) -> None:
        """Windows from the recording, as soon as that can be computed."""
        self._ready.all.wait()
        for station in self.stations:
            station.rebuild()

    def _warm_up(self) -> None:
        """Beside the loop, so that a first start's compilation holds up neither samples nor status."""
        try:
            for kernel in warm_up():
                if kernel == "all":
                    heat.warm_up()
                    compensator.warm_up()
                getattr(self._ready, kernel).set()
                self._wake.set()
        except OSError as error:
            _log.warning("compiled kernels cannot be kept, the next start will be slow again", error=str(error))
        finally:
            # what has failed is compiled by the loop, or ends it; without this it would wait for ever
            for kernels in (self._ready.window, self._ready.fit, self._ready.all):
                kernels.set()
            self._wake.set()

    def _station(self, device: Device) -> Station:
        link = device.link
        if isinstance(link, VirtualTable):
            imu = VirtualImu(link, device.decoder, device.name)
            self.virtual[device.name] = imu
            link = imu.link
        return Station(device, link, device.decoder, self._wake, self._ready, self.recorder)

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
            self._obey(command, stations[command.device])

    def _obey(self, command: Command, station: Station) -> None:
        match command.verb:
            case "reset":
                station.reset()
                received = station.driver.counts.received
                command.answer(message.reply(station.name, station.now_unix_s(), received, "the window is empty"))
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
        job = Job(station.name, station.now_unix_s(), received, *held, device.model, device.reconcile_folder)
        self._reconciler.start(job, command)

    def _tell_reconciled(self) -> None:
        stations = {station.name: station for station in self.stations}
        for finished in self._reconciler.take():
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
            if self.view is not None:
                self.view.close()
            self.zenoh.close()

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
    """What is wanted of the recording; a replay is one already."""
    storage = config.storage
    if storage is None:
        return None
    devices = [device for device in config.devices if not isinstance(device.link, ReplayLink)]
    origins = [origin(device.name, device.axes) for device in devices] if storage.record else []
    if storage.raw:
        carriers = [device.decoder.carrier for device in devices]
        origins += [origin(one.name, one.axes, "raw", carrier) for one, carrier in zip(devices, carriers, strict=True)]
    return Recorder(storage, origins) if origins else None


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


def _viewer(config: Config) -> "RerunView | None":
    if config.viewer.mode == "none":
        return None
    from monitor.publish.rerun_view import RerunView

    own = config.viewer
    devices = [
        DeviceInfo(
            device.name, _about(device), device.model is not None, device.thermal_s is not None, device.compensate
        )
        for device in config.devices
    ]
    return RerunView(ViewerSettings(own.mode, own.port, own.web_port, own.memory), devices)


def _about(device: Device) -> str:
    return "simulated" if isinstance(device.link, VirtualTable) else device.link.name
