"""One device inside the service: its reader thread, ring and estimate, and when what of it is published.

``work`` is one round of the main loop for this device: take, update, publish what is due. Outputs are called in order
and none of them waits: each has a queue or drops.
"""

import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from drivers.clock import Before, SampleClock
from drivers.decoders.base import Decoder
from drivers.driver import Driver
from drivers.errors import ImuError, NotReady
from drivers.links.base import Link
from drivers.links.replay_link import ReplayLink
from drivers.recording.segment import State
from drivers.sample import Chunk, Event, Floats, Ints, SampleBlock, unbroken
from monitor import rebuilding
from monitor.chain import Chain, Ready
from monitor.drift.live import ThermalLook
from monitor.drift.live_compensation import DriftLook, LiveCompensation
from monitor.estimate.agreement import Agreement
from monitor.estimate.estimate import Estimate
from monitor.estimate.hadamard import HadamardCurve
from monitor.estimate.held import Held
from monitor.estimate.model_gap import ModelGap
from monitor.estimate.total import TotalCurve
from monitor.health import Health
from monitor.limits import Limits, model_of
from monitor.recorder import Recorder, Tail
from monitor.ring import RingBuffer
from monitor.settings import Device, VirtualTable
from monitor.wall import EASE, WallClock

RING_SECONDS: Final = 10.0
RING_SAMPLES: Final = (65_536, 1_000_000)
PATIENCE_S: Final = 0.002
SAMPLES_EVERY_S: Final = 0.1
"""Raw samples travel in batches of at most this long, unless every block is wanted."""
CHOOSING_S: Final = 0.001
"""In a round, that choosing a model of temperature may take for a sensor; a recording waits for it, and has longer."""
CHOOSING_RECORDED_S: Final = 0.02
CHOOSING_SHARE: Final = 0.02
"""Of a processor, that it may take for a device."""
TOTAL_EVERY_S: Final = 0.1
TOTAL_SHARE: Final = 0.005
"""Of a processor, that total and Hadamard deviations may take for a device."""
SLOW_REFIT_S: Final = 1.0
"""Minimum time between interpreted fits, because the compilation needs the processors."""
UNTIMED_KEPT: Final = 100
"""Events that wait for the first sample's time; the oldest are dropped."""
SET_S: Final = 1.0
"""A host's clock that is set by more is told, and so are times that are further from it."""


class Output:
    """Where a station's results go; no call waits for anyone. What an output does not override it does not show.

    Every ``unix_s`` is a time on the timeline of the device's own samples. A recording, or a device that stamps its
    samples itself, may be years away from the host's clock, so its timeline is unknown before its first sample: no
    event is passed on until then, and ``health`` has None for its time.
    """

    def samples(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """A block, and how many samples had come with it; ``offset_ns`` [n] makes its times Unix time."""

    def estimate(self, device: str, unix_s: float, estimate: Estimate) -> None:
        """One refit."""

    def gap(self, device: str, unix_s: float, gap: ModelGap) -> None:
        """The window beside the model in force, with each estimate; never where there is no model."""

    def thermal(self, device: str, unix_s: float, received: int, look: ThermalLook) -> None:
        """An interval beside what temperature let expect of it; never where none is measured."""

    def compensated(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """As ``samples``, the gyros' drift taken out."""

    def drift(self, device: str, unix_s: float, look: DriftLook) -> None:
        """What an interval of a second taught of the gyros' drift."""

    def total(self, device: str, unix_s: float, received: int, total: TotalCurve, hadamard: HadamardCurve) -> None:
        """Total and Hadamard deviations, renewed in rounds."""

    def event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Something happened."""

    def health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Once a second. ``unix_s`` is None while the time on the device's timeline is unknown."""

    def gone(self, device: str) -> None:
        """The device was taken out of the configuration; one of its name may come again."""


class Station:
    """One device of the service.

    Args:
        device: its settings
        link: what its samples come by
        wake: set whenever samples have come
        ready: which of the estimator's kernels are compiled; samples wait in order until they are
        recorder: keeps what comes, and has what came before
    Raises:
        ConfigError: the model in force is none
    """

    def __init__(
        self,
        device: Device,
        link: Link,
        decoder: Decoder,
        wake: threading.Event,
        ready: Ready,
        recorder: Recorder | None = None,
    ) -> None:
        self.device = device
        self.name = device.name
        rate = device.rate_hz or 1000.0
        low, high = RING_SAMPLES
        self.ring = RingBuffer(int(min(max(rate * RING_SECONDS, low), high)))
        self.clock = SampleClock(decoder.timing, device.rate_hz, _arrivals_are_timed(device, link))
        self._recorder = recorder
        keep = None if recorder is None else self._keep
        self.driver = Driver(device.name, link, decoder, self.clock, self._push, device.axes, device.silence_s, keep)
        self.latest: Estimate | None = None
        self.model = model_of(device)
        self._agreement = Agreement()
        self._limits = Limits(device.limits, self.model)
        self.published = 0  # samples handed to the outputs
        self._wake = wake
        self._ready = ready
        # a recording is over before its changes could be looked for
        self.waits_for_all = device.refit_s == 0.0 or device.leave_out_motion or isinstance(link, ReplayLink)
        self._patient = link.epoch == "unix"
        live = device.refit_s != 0.0 and _arrivals_are_timed(device, link) and not isinstance(link, ReplayLink)
        self.chain = Chain(device, self.model, ready, self._patient, self.waits_for_all, live)
        self._wall = WallClock(time.monotonic_ns(), time.time_ns())
        self._thread = threading.Thread(target=self.driver.run, name=f"reader of {device.name}", daemon=True)
        self._batch: list[SampleBlock] = []  # not published yet
        self._waiting_since_ns = 0
        self._unpublished_since_ns = 0  # of the oldest sample that was taken and not published yet
        self._latencies: list[float] = []
        self._started_s = time.monotonic()
        self._before = State()  # what was known before a restart
        self._happened: list[Event] = []
        self._untimed: deque[tuple[str, str]] = deque(maxlen=UNTIMED_KEPT)  # kind and text, see ``_note``
        self._tail: Tail | None = None  # of the recording, that the window is rebuilt from first
        self._next_s = dict.fromkeys(("refit", "publish", "samples", "total", "thermal"), 0.0)
        self._refitted = False  # a refit since the last publication
        self._doubts = (False, False)  # of the configured rate: it is contradicted, it has not been checked yet
        self._newest_ns: int | None = None  # of the samples that were taken
        self._taken_ns = 0  # host monotonic, when the newest was taken

    # --- life

    def start(self) -> None:
        """Start reading; where the recording ends less than a window ago, the samples go on from it."""
        if self._recorder is not None and not self._patient:
            self._resume(self._recorder.tail(self.name))
        self._thread.start()

    def rebuild(self) -> None:
        """Fill the window from the recording, while samples wait in the ring; to be called in a thread of its own."""
        tail = self._tail
        if tail is None:
            return
        rate_hz = self.clock.rate_hz or tail.newest.state.rate or 0.0
        offset_ns = self._offset_ns(time.monotonic_ns())
        try:
            text = rebuilding.rebuild(self.chain, tail, rate_hz, self.device.window_s, offset_ns)
        except (ImuError, OSError) as error:
            text = f"the window could not be rebuilt: {error}"
            self.chain.reset()
        finally:
            t_ns = int(tail.newest.samples.t_ns[-1]) - offset_ns
            self._happened.append(Event("window_rebuilt", t_ns, text))
            self._tail = None
            self._wake.set()

    @property
    def rebuilding(self) -> bool:
        """Whether the window is still being filled from the recording."""
        return self._tail is not None

    def stop(self) -> None:
        """Stop reading; what is in the ring stays there to be worked off."""
        self.driver.stop()

    def join(self, timeout_s: float) -> bool:
        """Wait for the reader; False when it did not end in time."""
        if self._thread.is_alive():
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    @property
    def ended(self) -> bool:
        """A replay that has given all it had, and all of it is worked off."""
        if self.driver.state != "ended" or self._thread.is_alive() or not self._ready.all.is_set():
            return False
        return not self.chain.waiting and (not self._waiting_since_ns or self.clock.rate_hz is None)

    @property
    def turns(self) -> int | None:
        """Of its reader, see ``Driver.turns``; None where it may stand still: a recording waits for room, and ends."""
        return None if self._patient or self.driver.state == "ended" else self.driver.turns

    # --- one round

    def work(self, outputs: Sequence[Output], now_s: float, drain: bool = False) -> None:
        """Take what came, advance the estimate, publish what is due; all of it when draining."""
        with self.chain.interpreted(self.clock.rate_hz):
            self._work(outputs, now_s, drain)

    def _work(self, outputs: Sequence[Output], now_s: float, drain: bool) -> None:
        happened = self.driver.take_events()
        if self._tail is not None:  # the chain is another thread's until the window is rebuilt
            self._tell(outputs, self._take_noted() + happened)
            return
        blocks = self._take() if drain or self._can_take() else []
        if blocks:
            self._newest_ns, self._taken_ns = int(blocks[-1].t_ns[-1]), time.monotonic_ns()
            self._batch += blocks
        happened = self._take_noted() + happened  # now that the first sample's time is known
        self.chain.advance(blocks, self.clock.rate_hz, drain)
        if drain:
            self.chain.flush()
        if self.chain.thermal is not None and any(event.kind == "link_back" for event in happened):
            self.chain.thermal.offset_is_new()
        published = self._publish_samples(outputs, now_s, drain)
        self._tell(outputs, happened + self.chain.take_events())
        self._publish_thermal(outputs, now_s)
        published |= self._publish_estimate(outputs, now_s, drain)
        self._publish_total(outputs, now_s)
        if published and self._unpublished_since_ns:
            self._latencies.append((time.monotonic_ns() - self._unpublished_since_ns) / 1e9)
            self._unpublished_since_ns = 0

    def reset(self) -> None:
        """Empty the window."""
        if self._tail is None:
            self.chain.reset()

    def held(self) -> tuple[Held, Floats] | None:
        """The samples in the window and their temperature [n], as of now; None while there are none."""
        return None if self._tail is not None else self.chain.held()

    def limit(self, device: Device) -> None:
        """From now on the limits of these settings, which are otherwise those that it runs with.

        Raises:
            ConfigError: a limit that cannot be
        """
        limits = Limits(device.limits, self.model)
        limits.take_over(self._limits)
        self.device, self._limits = device, limits

    def announce(self, outputs: Sequence[Output], kind: str, text: str) -> None:
        """Pass on an event of this moment that the samples do not tell; it waits while their timeline is unknown."""
        self._note(kind, text)
        self._tell(outputs, self._take_noted())

    def report(self, outputs: Sequence[Output], states: dict[str, str], memory_bytes: int) -> Health:
        """Tell the outputs how the device does, and ease its wall clock."""
        self._follow_host(outputs)
        self._relabel()
        if self._recorder is not None:
            self._recorder.know(self.name, self._known())
        health = self.health(states, memory_bytes)
        for output in outputs:
            output.health(self.name, self.now_unix_s(), health)
        return health

    def health(self, states: dict[str, str], memory_bytes: int) -> Health:
        """How the device does now."""
        counts, latencies, watch = self.driver.counts, np.array(self._latencies), self.chain.watch
        self._latencies = []
        return Health(
            state=self.driver.state,
            rate_hz=self.clock.measured_hz if self.driver.state == "running" else None,
            received=counts.received,
            lost=counts.lost,
            bad=counts.bad,
            overflowed=self.ring.overflowed,
            latency_p50_s=float(np.quantile(latencies, 0.5)) if latencies.size else None,
            latency_p99_s=float(np.quantile(latencies, 0.99)) if latencies.size else None,
            memory_bytes=memory_bytes,
            outputs=dict(states),
            text=self._text(),
            uptime_s=time.monotonic() - self._started_s,
            repeated=self.clock.repeated,
            late=self.clock.late + counts.late,
            moving=watch is not None and watch.moving,
            moved=watch.moved_samples if watch is not None else 0,
            crossed=self._limits.crossed,
        )

    def unix_s(self, t_ns: int) -> float:
        """Unix time of a sample time."""
        return (t_ns + self._offset_ns(t_ns)) / 1e9

    def now_unix_s(self) -> float | None:
        """Return the present time on the timeline of the device's samples, in Unix seconds.

        Returns
        -------
        float or None
            The time of the newest sample. While the device waits or is lost, time goes on from there. None if the
            samples bring their own times (a recording, or a decoder that reads times from the payload) and none has
            come yet: such a timeline cannot be guessed from the host's clock.
        """
        now_ns = self._now_ns()
        return None if now_ns is None else self.unix_s(now_ns)

    # --- going on after a restart

    def _resume(self, tail: Tail | None) -> None:
        """Let samples count as missing that came since the recording's end."""
        if tail is None:
            return
        newest, state = tail.newest.samples, tail.newest.state
        now_ns = time.monotonic_ns()
        t_ns = int(newest.t_ns[-1]) - self._offset_ns(now_ns)
        ago_s = (self._wall.unix_ns(now_ns) - int(newest.t_ns[-1])) / 1e9
        rate = self.device.rate_hz or state.rate
        if rate is None or not 0.0 <= ago_s <= self.device.window_s:
            text = f"the recording ends {ago_s:.4g} s ago: the window begins anew"
            if ago_s < 0.0:
                text = "the recording ends after the host's clock: the window begins anew"
            self._note("window_rebuilt", text)
            return
        self.clock.resume(Before(t_ns, int(newest.ticks[-1]), rate, state.tick_step))
        self._tail, self._before = tail, state
        if self._recorder is not None:
            self._recorder.know(self.name, state)  # the next restart may come before anything else is known

    def _known(self) -> State:
        """What goes into the recording beside the samples."""
        if self._tail is not None:
            return self._before
        offset_ns = self._offset_ns(self.chain.newest_ns)
        return rebuilding.known(self.chain, self._before, self.clock.rate_hz, self.clock.tick_step, offset_ns)

    # --- inside

    def _now_ns(self) -> int | None:
        """Present time in the epoch of the samples; None where ``now_unix_s`` is None."""
        newest_ns, now_ns = self._newest_ns, time.monotonic_ns()
        if newest_ns is not None and (self._patient or self.driver.state in ("running", "ended")):
            return newest_ns
        if not self.driver.times_are_unix:
            return now_ns
        if newest_ns is None:  # samples may wait in the ring; only the first may be stamped without running ahead
            return self.driver.first_t_ns
        return newest_ns + now_ns - self._taken_ns

    def _note(self, kind: str, text: str) -> None:
        """Keep an event of this moment; it is stamped as soon as the time on the device's timeline is known."""
        now_ns = self._now_ns()
        if now_ns is None:
            self._untimed.append((kind, text))
        else:
            self._happened.append(Event(kind, now_ns, text))

    def _take_noted(self) -> list[Event]:
        """Return the events that were noted since the last call, as far as they can be stamped."""
        now_ns = self._now_ns() if self._untimed else None
        if now_ns is not None:
            self._happened += [Event(kind, now_ns, text) for kind, text in self._untimed]
            self._untimed.clear()
        noted, self._happened = self._happened, []
        return noted

    def _follow_host(self, outputs: Sequence[Output]) -> None:
        now_ns = time.monotonic_ns()
        set_s = self._wall.follow(now_ns, time.time_ns()) / 1e9
        if abs(set_s) < SET_S or self.driver.times_are_unix:
            return
        text = (
            f"the host's clock was set {'on' if set_s > 0.0 else 'back'} by {abs(set_s):.6g} s; times follow by "
            f"{EASE * 3600.0:g} s an hour, a restart takes the new time over at once"
        )
        self._tell(outputs, [Event("clock_jumped", now_ns, text)])

    def _keep(self, chunks: Sequence[Chunk]) -> None:
        """Called by the reader's thread."""
        if self._recorder is not None:
            self._recorder.chunks(self.name, chunks, self._offset_ns(chunks[0].t_ns) if chunks else 0)

    def _push(self, samples: SampleBlock) -> None:
        """Called by the reader's thread. A sensor is never kept waiting; a recording waits for room."""
        if self._recorder is not None:
            if self.chain.estimator is None:  # a crash may come before the first report
                self._recorder.know(self.name, self._known())
            self._recorder.samples(self.name, samples, self._offsets_ns(samples))
            while self._patient and self._recorder.full(self.name):
                time.sleep(PATIENCE_S)
        while self._patient and self.ring.room < len(samples) < self.ring.capacity:
            time.sleep(PATIENCE_S)
        self.ring.push(samples)
        if not self._waiting_since_ns:
            self._waiting_since_ns = time.monotonic_ns()
        self._wake.set()

    def _offset_ns(self, t_ns: int) -> int:
        return 0 if self.driver.times_are_unix else self._wall.offset_ns(t_ns)

    def _offsets_ns(self, samples: SampleBlock) -> Ints | int:
        """Return Unix time less the time of each sample [n]. Unix times increase even if the host's clock is set."""
        return 0 if self.driver.times_are_unix else self._wall.offsets_ns(samples.t_ns)

    def _can_take(self) -> bool:
        """Until the rate is known and the kernels are compiled, samples wait in the ring."""
        chain = self.chain
        if chain.waiting or self._tail is not None:
            return False
        if chain.estimator is not None or chain.refused:
            return True
        if self.clock.rate_hz is None:  # times from which no rate can be told must not stop the samples
            return self.ring.room < self.ring.capacity // 2
        return chain.can_begin(self.clock.rate_hz)

    def _take(self) -> list[SampleBlock]:
        came_ns, self._waiting_since_ns = self._waiting_since_ns, 0
        self._unpublished_since_ns = self._unpublished_since_ns or came_ns
        return self.ring.take()

    def _publish_samples(self, outputs: Sequence[Output], now_s: float, drain: bool) -> bool:
        every_s = min(self.device.publish_s, SAMPLES_EVERY_S)
        if not self._batch or not (self._due("samples", every_s, now_s) or drain):
            return False
        blocks, self._batch = self._batch, []
        for samples in unbroken(blocks):
            self.published += len(samples)
            offsets_ns = self._offsets_ns(samples)
            for output in outputs:
                output.samples(self.name, self.published, samples, offsets_ns)
            if self.chain.compensation is not None and np.isfinite(samples.values[:, :3]).any():
                self._publish_compensated(outputs, self.chain.compensation, samples)
        return True

    def _publish_compensated(self, outputs: Sequence[Output], live: LiveCompensation, samples: SampleBlock) -> None:
        """The same samples without drift, and what they taught of it."""
        at = 0
        while at < len(samples):
            piece = samples[at : at + live.compensator.ahead]
            at += len(piece)
            without = live.update(piece)
            self.chain.renew()
            offsets_ns = self._offsets_ns(without)
            for output in outputs:
                output.compensated(self.name, self.published - len(samples) + at, without, offsets_ns)
        for look in live.take():
            for output in outputs:
                output.drift(self.name, self.unix_s(look.t_ns), look)

    def _publish_estimate(self, outputs: Sequence[Output], now_s: float, drain: bool) -> bool:
        # at every sample the course follows by itself: a look before that is published would take its samples away
        every_s = self.device.refit_s or self.device.publish_s
        self._follow_rate(drain)
        estimator = self.chain.estimator
        if estimator is not None and self.chain.advanced and (self._due("refit", every_s, now_s) or drain):
            fitted = self.chain.can_fit
            self.chain.advanced = not fitted  # a curve alone is fitted as soon as that can be
            try:
                latest = estimator.get(fitted=fitted)
            except NotReady:
                return False
            if self.chain.fits_slowly:
                self._next_s["refit"] = max(self._next_s["refit"], now_s + SLOW_REFIT_S)
            self.latest = latest.without_coefficients() if any(self._doubts) else latest
            self._refitted = True
        if self.latest is None or not self._refitted:
            return False
        if not (self._due("publish", self.device.publish_s, now_s) or drain):
            return False
        self._refitted = False
        for output in outputs:
            output.estimate(self.name, self.unix_s(self.latest.t_ns), self.latest)
        if self.chain.in_force is not None:
            look = self.chain.in_force.look(self.latest)
            self._publish_gap(outputs, replace(look, axes={}) if any(self._doubts) else look)
        self._tell(outputs, self._limits.update(self.latest))
        return True

    def _follow_rate(self, drain: bool) -> None:
        """Withhold the coefficients while the configured rate is contradicted, or has not been checked yet."""
        if drain:
            self.clock.end()
        doubts = (self.clock.contradicted_hz is not None, self.clock.unchecked)
        if doubts != self._doubts:
            self._doubts = doubts
            self._relabel()
            self.chain.advanced = True  # the newest estimate is to be made anew

    def _relabel(self) -> None:
        rate_hz = self.clock.rate_hz
        if rate_hz is not None and self._tail is None:
            self.chain.relabel(rate_hz)

    def _publish_gap(self, outputs: Sequence[Output], look: ModelGap) -> None:
        events = self._agreement.update(look)
        look = replace(look, agrees=self._agreement.verdicts)
        for output in outputs:
            output.gap(self.name, self.unix_s(look.t_ns), look)
        self._tell(outputs, events)

    def _tell(self, outputs: Sequence[Output], events: Sequence[Event]) -> None:
        for event in events:
            for output in outputs:
                output.event(self.name, self.unix_s(event.t_ns), self.driver.counts.received, event)

    def _publish_total(self, outputs: Sequence[Output], now_s: float) -> None:
        """One step of the slow statistics, as often as they may take their share of the time."""
        estimator = self.chain.estimator
        if estimator is None or not self._ready.all.is_set() or now_s < self._next_s["total"]:
            return
        begun_s = time.perf_counter()
        found = estimator.step()
        self._next_s["total"] = now_s + max(TOTAL_EVERY_S, (time.perf_counter() - begun_s) / TOTAL_SHARE)
        if found is not None:
            for output in outputs:
                output.total(self.name, self.unix_s(self.chain.newest_ns), self.driver.counts.received, *found)

    def _publish_thermal(self, outputs: Sequence[Output], now_s: float) -> None:
        """Intervals that are over; and a piece of choosing models."""
        for look in self.chain.take_looks():
            for output in outputs:
                output.thermal(self.name, self.unix_s(look.t_ns), self.driver.counts.received, look)
        thermal = self.chain.thermal
        if thermal is None or not thermal.choosing or now_s < self._next_s["thermal"]:
            return
        begun_s = time.perf_counter()
        until_s = begun_s + (CHOOSING_RECORDED_S if self._patient else CHOOSING_S)
        while thermal.step() and time.perf_counter() < until_s:
            pass
        if self._patient:
            self._wake.set()  # what waits in the ring goes on
        else:
            self._next_s["thermal"] = now_s + (time.perf_counter() - begun_s) / CHOOSING_SHARE

    def _due(self, what: str, every_s: float, now_s: float) -> bool:
        if now_s < self._next_s[what]:
            return False
        # keep the beat, but do not make up for a pause
        self._next_s[what] = max(self._next_s[what] + every_s, now_s + 0.5 * every_s)
        return True

    def _text(self) -> str:
        if self._tail is not None and self._ready.all.is_set() and self.driver.state == "running":
            return "the window is being rebuilt from the recording; no sample is lost"
        if self._ready.progress and self.driver.state == "running":
            lacking = "" if self.chain.can_fit else "no coefficients yet, "
            return f"{self._ready.progress}; {lacking}no sample is lost"
        if not self.chain.can_fit and self.driver.state == "running":
            return "compiling the estimator; no coefficients yet, no sample is lost"
        lacking = self._lacking_text() if self.driver.state in ("running", "ended") else ""
        if self.driver.text or self.driver.state != "running":
            return f"{self.driver.text.rstrip('.')}; {lacking}" if lacking else self.driver.text
        return lacking or self.driver.late_hint or self._wall_text()

    def _lacking_text(self) -> str:
        """Return why there are no coefficients; empty if they are there or will come."""
        measured_hz = self.clock.contradicted_hz
        if measured_hz is not None:
            return (
                f"measured rate {measured_hz:.4g} Hz differs from the configured {self.device.rate_hz:g} Hz; "
                "coefficients are withheld: correct `rate` or remove it"
            )
        if self.chain.estimator is None and self.published and self.clock.rate_hz is None:
            return "no estimate: the times of the samples do not show a rate; set `rate`"
        return self.chain.refused

    def _wall_text(self) -> str:
        behind_s = 0.0 if self.driver.times_are_unix else self._wall.behind_ns / 1e9
        if abs(behind_s) < SET_S:
            return ""
        where = "behind" if behind_s > 0.0 else "ahead of"
        return f"times are {abs(behind_s):.6g} s {where} the host's clock, which was set"


def _arrivals_are_timed(device: Device, link: Link) -> bool:
    """Return True if arrival times show the device's rate, and not how fast a file is read or a sensor simulated."""
    simulated = isinstance(device.link, VirtualTable) and device.link.speed != 1.0
    captured = isinstance(link, ReplayLink) and link.epoch == "monotonic"
    return not simulated and not captured
