"""Worker of one device: reader thread, ring buffer, processing pipeline and publication of the results.

``DeviceWorker.work`` is one round of the main loop for the device. It takes the new samples, updates the estimate and
publishes the results that are due. It calls the outputs in order. No output blocks: each has a queue, or drops data.
"""

import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from drivers.decoders.base import Decoder
from drivers.driver import Driver
from drivers.errors import ImuError, NotReady
from drivers.links.base import Link
from drivers.links.replay_link import ReplayLink
from drivers.recordings.segment import DaemonState
from drivers.sample import Chunk, Event, Floats, Ints, SampleBlock, merge_contiguous_blocks
from drivers.timing.sample_clock import LastSample, SampleClock
from monitor.common.health import Health
from monitor.daemon import window_restore
from monitor.daemon.operations.limits import LimitMonitor, read_model_in_force
from monitor.daemon.pipeline import DevicePipeline, KernelReadiness
from monitor.daemon.ring_buffer import RingBuffer
from monitor.daemon.slewed_clock import MAX_SLEW_RATE, SlewedClock
from monitor.daemon.storage.recorder import Recorder, RecordingTail
from monitor.drift.compensation.live_compensation import LiveCompensation
from monitor.estimation.detection.model_agreement import ModelAgreement
from monitor.estimation.detection.model_gap import ModelGap
from monitor.estimation.estimate import Estimate
from monitor.estimation.window_snapshot import WindowSnapshot
from monitor.publishing.messages.results import SlowStatistics
from monitor.settings.loading import Device, VirtualTable

RING_S: Final = 10.0
"""Capacity of the ring buffer, in seconds of samples, within the bounds of RING_SAMPLES_RANGE."""
RING_SAMPLES_RANGE: Final = (65_536, 1_000_000)
"""Smallest and largest capacity of the ring buffer."""
PATIENCE_S: Final = 0.002
"""Pause after which a replayed recording checks again for space in a queue."""
MAX_BATCH_S: Final = 0.1
"""Longest time that raw samples are collected before they are published as one batch."""
MODEL_SELECTION_S: Final = 0.001
"""Processor time in a round for the selection of a thermal model, for a live sensor."""
MODEL_SELECTION_REPLAY_S: Final = 0.02
"""The same for a replayed recording, which waits for the selection and may use more time."""
MODEL_SELECTION_CPU_SHARE: Final = 0.02
"""Share of one processor that the selection of a thermal model may use for a device."""
TOTAL_INTERVAL_S: Final = 0.1
"""Shortest interval between two steps of the total and Hadamard deviations."""
TOTAL_CPU_SHARE: Final = 0.005
"""Share of one processor that the total and Hadamard deviations may use for a device."""
INTERPRETED_REFIT_S: Final = 1.0
"""Minimum time between fits while their kernels are interpreted, because the compilation needs the processors."""
MAX_UNTIMED_EVENTS: Final = 100
"""Largest number of events that wait for the time of the first sample. The oldest are dropped."""
MIN_CLOCK_STEP_S: Final = 1.0
"""Smallest step of the host clock, and smallest offset of the sample times from it, that is reported."""


class Output:
    """Receiver of the results of the devices; a subclass overrides the methods for the results that it uses.

    No method may block. Every ``unix_s`` is a time in seconds on the timeline of the device's own samples. A recording,
    or a device that stamps its samples itself, may be years away from the host clock, so its timeline is unknown before
    its first sample. Until then no event is passed on, and ``health`` receives None as time.

    Several methods have the same parameters. ``device`` is the name of the device. ``received`` is the number of
    samples of the device since the start, up to the result.
    """

    def samples(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """Receive a block of samples.

        Parameters
        ----------
        device : str
            Name of the device.
        received : int
            Number of samples of the device up to the end of this block, since the start.
        samples : SampleBlock
            Samples in SI units, with times in nanoseconds.
        offset_ns : array of int64, shape (n,), or int
            Offset that converts the times to Unix time, in nanoseconds.
        """

    def result(self, device: str, unix_s: float, received: int, result: Any) -> None:
        """Receive a result of one of the kinds in ``monitor.publishing.result_kinds``.

        Estimates arrive at the configured rate. A device without a model in force has no ``ModelGap``, and a device
        without a thermal model no ``ThermalUpdate``. ``DriftUpdate`` arrives every second of drift compensation, and
        ``SlowStatistics`` when its step by step computation is complete.

        Parameters
        ----------
        device : str
            Name of the device.
        unix_s : float
            Time of the result: of the newest sample in the window, or of the end of the interval.
        received : int
            Number of samples of the device since the start.
        result : object
            The result.
        """

    def compensated(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """Receive a block of samples without the drift of the gyroscopes.

        Parameters
        ----------
        device : str
            Name of the device.
        received : int
            Number of samples of the device up to the end of this block, since the start.
        samples : SampleBlock
            Compensated samples in SI units, with times in nanoseconds.
        offset_ns : array of int64, shape (n,), or int
            Offset that converts the times to Unix time, in nanoseconds.
        """

    def event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Receive an event of the device.

        Parameters
        ----------
        device : str
            Name of the device.
        unix_s : float
            Time of the event.
        received : int
            Number of samples of the device since the start.
        event : Event
            Kind, axis and text of the event.
        """

    def health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Receive the status of the device, once a second.

        Parameters
        ----------
        device : str
            Name of the device.
        unix_s : float or None
            Present time on the device's timeline; None while it is unknown.
        health : Health
            Status of the device.
        """

    def device_removed(self, device: str) -> None:
        """Forget a device that was removed from the configuration. A device with the same name may be added later."""


class DeviceWorker:
    """Worker of one device of the service.

    Parameters
    ----------
    device : Device
        Settings of the device.
    link : Link
        Link from which the samples are read.
    decoder : Decoder
        Decoder of the device's wire format.
    wake : threading.Event
        Set whenever samples have arrived.
    ready : Ready
        Flags of the compiled kernels. Samples wait in order until the kernels that the device needs are compiled.
    recorder : Recorder, optional
        Records samples and raw bytes, and provides the samples from before a restart.

    Raises
    ------
    ConfigError
        The model in force cannot be read.
    """

    def __init__(
        self,
        device: Device,
        link: Link,
        decoder: Decoder,
        wake: threading.Event,
        ready: KernelReadiness,
        recorder: Recorder | None = None,
    ) -> None:
        self.device = device
        self.name = device.name
        rate = device.rate_hz or 1000.0
        low, high = RING_SAMPLES_RANGE
        self.ring = RingBuffer(int(min(max(rate * RING_S, low), high)))
        self.clock = SampleClock(decoder.timing, device.rate_hz, _arrivals_are_timed(device, link))
        self._recorder = recorder
        keep = None if recorder is None else self._record_chunks
        self.driver = Driver(device.name, link, decoder, self.clock, self._push, device.axes, device.silence_s, keep)
        self.latest: Estimate | None = None
        self.model = read_model_in_force(device)
        self._agreement = ModelAgreement()
        self._limits = LimitMonitor(device.limits, self.model)
        self.published = 0  # samples handed to the outputs
        self._wake = wake
        self._ready = ready
        # a short recording may end before the kernels of the change detection are compiled
        self.waits_for_all = device.refit_s == 0.0 or device.leave_out_motion or isinstance(link, ReplayLink)
        self._patient = link.epoch == "unix"
        live = device.refit_s != 0.0 and _arrivals_are_timed(device, link) and not isinstance(link, ReplayLink)
        self.chain = DevicePipeline(device, self.model, ready, self._patient, self.waits_for_all, live)
        self._slewed_clock = SlewedClock(time.monotonic_ns(), time.time_ns())
        self._thread = threading.Thread(target=self.driver.run, name=f"reader of {device.name}", daemon=True)
        self._unpublished: list[SampleBlock] = []  # samples that were taken and not published yet
        self._waiting_since_ns = 0
        self._unpublished_since_ns = 0  # arrival of the oldest sample in it
        self._latencies: list[float] = []
        self._started_s = time.monotonic()
        self._before = DaemonState()  # state of the estimate before a restart
        self._pending_events: list[Event] = []
        self._untimed: deque[tuple[str, str]] = deque(maxlen=MAX_UNTIMED_EVENTS)  # kind and text, see ``_store_event``
        self._tail: RecordingTail | None = None  # end of the recording, until the window has been rebuilt from it
        self._next_s = dict.fromkeys(("refit", "publish", "samples", "total", "thermal"), 0.0)
        self._refitted = False  # True if the fit was updated since the last publication
        self._rate_doubts = (False, False)  # True if the configured rate is contradicted; True if it is not checked yet
        self._newest_ns: int | None = None  # time of the newest sample that was taken from the ring buffer
        self._taken_ns = 0  # host monotonic time at which this sample was taken

    # --- start and stop

    def start(self) -> None:
        """Start the reader thread; if the recording ended less than a window ago, resume from its end."""
        if self._recorder is not None and not self._patient:
            self._resume(self._recorder.tail(self.name))
        self._thread.start()

    def rebuild(self) -> None:
        """Fill the window from the recording while new samples wait in the ring buffer; call it in a thread."""
        tail = self._tail
        if tail is None:
            return
        rate_hz = self.clock.rate_hz or tail.newest.state.rate or 0.0
        offset_ns = self._offset_ns(time.monotonic_ns())
        try:
            text = window_restore.restore_window(self.chain, tail, rate_hz, self.device.window_s, offset_ns)
        except (ImuError, OSError) as error:
            text = f"the window could not be rebuilt: {error}"
            self.chain.reset()
        finally:
            t_ns = int(tail.newest.samples.t_ns[-1]) - offset_ns
            self._pending_events.append(Event("window_rebuilt", t_ns, text))
            self._tail = None
            self._wake.set()

    @property
    def rebuilding(self) -> bool:
        """True while the window is being filled from the recording."""
        return self._tail is not None

    def stop(self) -> None:
        """Stop the reader thread. Samples in the ring buffer stay there until ``work`` processes them."""
        self.driver.stop()

    def join(self, timeout_s: float) -> bool:
        """Wait for the reader thread; return False if it does not end within ``timeout_s`` seconds."""
        if self._thread.is_alive():
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    @property
    def ended(self) -> bool:
        """True if a replay has ended and all its samples have been processed."""
        if self.driver.state != "ended" or self._thread.is_alive() or not self._ready.all.is_set():
            return False
        return not self.chain.waiting and (not self._waiting_since_ns or self.clock.rate_hz is None)

    @property
    def read_attempts(self) -> int | None:
        """Number of read attempts of the reader thread, see ``Driver.iterations``.

        None for a replayed recording, whose reader may block while the ring buffer is full, and for a reader that has
        ended.
        """
        return None if self._patient or self.driver.state == "ended" else self.driver.iterations

    # --- one round

    def work(self, outputs: Sequence[Output], now_s: float, drain: bool = False) -> None:
        """Process the new samples and publish the results that are due.

        Parameters
        ----------
        outputs : sequence of Output
            Receivers of the results.
        now_s : float
            Present time on the monotonic clock, in seconds.
        drain : bool, optional
            True if all samples are to be processed and all results published now, because the device stops.
        """
        with self.chain.interpreted(self.clock.rate_hz):
            self._work(outputs, now_s, drain)

    def _work(self, outputs: Sequence[Output], now_s: float, drain: bool) -> None:
        happened = self.driver.take_events()
        if self._tail is not None:  # until the window is rebuilt, the rebuilding thread owns the pipeline
            self._publish_events(outputs, self._take_timed_events() + happened)
            return
        blocks = self._take() if drain or self._can_take() else []
        if blocks:
            self._newest_ns, self._taken_ns = int(blocks[-1].t_ns[-1]), time.monotonic_ns()
            self._unpublished += blocks
        happened = self._take_timed_events() + happened  # only now is the time of the first sample known
        self.chain.advance(blocks, self.clock.rate_hz, drain)
        if drain:
            self.chain.flush()
        if self.chain.thermal is not None and any(event.kind == "link_back" for event in happened):
            self.chain.thermal.learn_new_offset()
        published = self._publish_samples(outputs, now_s, drain)
        self._publish_events(outputs, happened + self.chain.take_events())
        self._publish_thermal(outputs, now_s)
        published |= self._publish_estimate(outputs, now_s, drain)
        self._publish_total(outputs, now_s)
        if published and self._unpublished_since_ns:
            self._latencies.append((time.monotonic_ns() - self._unpublished_since_ns) / 1e9)
            self._unpublished_since_ns = 0

    def reset(self) -> None:
        """Empty the window, unless it is being rebuilt."""
        if self._tail is None:
            self.chain.reset()

    def window_snapshot(self) -> tuple[WindowSnapshot, Floats] | None:
        """Return a copy of the window and its temperature, float64 [n] in °C; None if the window is empty."""
        return None if self._tail is not None else self.chain.window_snapshot()

    def set_limits(self, device: Device) -> None:
        """Replace the limits by those of new settings. Limits that both settings have keep their state.

        Raises
        ------
        ConfigError
            A limit is relative to a coefficient that the model in force does not have.
        """
        limits = LimitMonitor(device.limits, self.model)
        limits.take_over(self._limits)
        self.device, self._limits = device, limits

    def publish_event(self, outputs: Sequence[Output], kind: str, text: str) -> None:
        """Publish an event of the present moment, such as a stopped recording.

        The event waits while the timeline of the device is unknown.

        Parameters
        ----------
        outputs : sequence of Output
            Receivers of the event.
        kind : str
            Kind of the event, for example "recording_stopped".
        text : str
            Message of the event.
        """
        self._store_event(kind, text)
        self._publish_events(outputs, self._take_timed_events())

    def publish_status(self, outputs: Sequence[Output], states: dict[str, str], memory_bytes: int) -> Health:
        """Publish the status of the device, and move its slewed clock towards the host clock.

        Parameters
        ----------
        outputs : sequence of Output
            Receivers of the status.
        states : dict of str to str
            State of each output of the service, by its name.
        memory_bytes : int
            Resident memory of the process.

        Returns
        -------
        Health
            The published status.
        """
        self._slew_to_host(outputs)
        self._update_rate()
        if self._recorder is not None:
            self._recorder.set_state(self.name, self._restart_state())
        health = self.health(states, memory_bytes)
        for output in outputs:
            output.health(self.name, self.now_unix_s(), health)
        return health

    def health(self, states: dict[str, str], memory_bytes: int) -> Health:
        """Return the present status of the device.

        Parameters
        ----------
        states : dict of str to str
            State of each output of the service, by its name.
        memory_bytes : int
            Resident memory of the process.
        """
        counts, latencies, watch = self.driver.counts, np.array(self._latencies), self.chain.signal_monitor
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
            repeated=self.clock.repeated_rows,
            late=self.clock.late_rows + counts.late,
            moving=watch is not None and watch.moving,
            moved=watch.moved_samples if watch is not None else 0,
            crossed=self._limits.crossed,
        )

    def unix_s(self, t_ns: int) -> float:
        """Convert a sample time in nanoseconds to Unix time in seconds."""
        return (t_ns + self._offset_ns(t_ns)) / 1e9

    def now_unix_s(self) -> float | None:
        """Return the present time on the timeline of the device's samples, in Unix seconds.

        Returns
        -------
        float or None
            The time of the newest sample. While the device waits or is lost, the time advances from there with the host
            clock. None if the samples bring their own times (a recording, or a decoder that reads times from the
            payload) and no sample has arrived yet. The host clock does not show such a timeline.
        """
        now_ns = self._now_ns()
        return None if now_ns is None else self.unix_s(now_ns)

    # --- restart

    def _resume(self, tail: RecordingTail | None) -> None:
        """Continue after the end of the recording, so that the samples since then count as missing."""
        if tail is None:
            return
        newest, state = tail.newest.samples, tail.newest.state
        now_ns = time.monotonic_ns()
        t_ns = int(newest.t_ns[-1]) - self._offset_ns(now_ns)
        ago_s = (self._slewed_clock.unix_ns(now_ns) - int(newest.t_ns[-1])) / 1e9
        rate = self.device.rate_hz or state.rate
        if rate is None or not 0.0 <= ago_s <= self.device.window_s:
            text = f"the recording ends {ago_s:.4g} s ago: the window begins anew"
            if ago_s < 0.0:
                text = "the recording ends after the host's clock: the window begins anew"
            self._store_event("window_rebuilt", text)
            return
        self.clock.resume(LastSample(t_ns, int(newest.ticks[-1]), rate, state.tick_step))
        self._tail, self._before = tail, state
        if self._recorder is not None:
            self._recorder.set_state(self.name, state)  # the next restart may come before a new estimate exists

    def _restart_state(self) -> DaemonState:
        """Return the state of the estimate that is recorded together with the samples."""
        if self._tail is not None:
            return self._before
        offset_ns = self._offset_ns(self.chain.newest_ns)
        return window_restore.known(self.chain, self._before, self.clock.rate_hz, self.clock.tick_step, offset_ns)

    # --- private methods

    def _now_ns(self) -> int | None:
        """Return the present time on the timeline of the samples, in nanoseconds; None if it is unknown."""
        newest_ns, now_ns = self._newest_ns, time.monotonic_ns()
        if newest_ns is not None and (self._patient or self.driver.state in ("running", "ended")):
            return newest_ns
        if not self.driver.times_are_unix:
            return now_ns
        if newest_ns is None:  # samples may wait in the ring buffer; only the first time is not ahead of them
            return self.driver.first_t_ns
        return newest_ns + now_ns - self._taken_ns

    def _store_event(self, kind: str, text: str) -> None:
        """Store an event of the present moment; it gets its time as soon as the device's timeline is known."""
        now_ns = self._now_ns()
        if now_ns is None:
            self._untimed.append((kind, text))
        else:
            self._pending_events.append(Event(kind, now_ns, text))

    def _take_timed_events(self) -> list[Event]:
        """Return the stored events since the last call, except those that still wait for the device's timeline."""
        now_ns = self._now_ns() if self._untimed else None
        if now_ns is not None:
            self._pending_events += [Event(kind, now_ns, text) for kind, text in self._untimed]
            self._untimed.clear()
        noted, self._pending_events = self._pending_events, []
        return noted

    def _slew_to_host(self, outputs: Sequence[Output]) -> None:
        """Move the slewed clock towards the host clock, and publish an event if the host clock was set."""
        now_ns = time.monotonic_ns()
        set_s = self._slewed_clock.slew_to(now_ns, time.time_ns()) / 1e9
        if abs(set_s) < MIN_CLOCK_STEP_S or self.driver.times_are_unix:
            return
        text = (
            f"the host's clock was set {'on' if set_s > 0.0 else 'back'} by {abs(set_s):.6g} s; times follow by "
            f"{MAX_SLEW_RATE * 3600.0:g} s an hour, a restart takes the new time over at once"
        )
        self._publish_events(outputs, [Event("clock_jumped", now_ns, text)])

    def _record_chunks(self, chunks: Sequence[Chunk]) -> None:
        """Record raw bytes. The reader thread calls this function."""
        if self._recorder is not None:
            self._recorder.chunks(self.name, chunks, self._offset_ns(chunks[0].t_ns) if chunks else 0)

    def _push(self, samples: SampleBlock) -> None:
        """Record decoded samples and put them into the ring buffer. The reader thread calls this function.

        A live sensor never waits: a full ring buffer overwrites its oldest samples. A replayed recording waits for
        space.
        """
        if self._recorder is not None:
            if self.chain.estimator is None:  # the program may crash before the first status is published
                self._recorder.set_state(self.name, self._restart_state())
            self._recorder.samples(self.name, samples, self._offsets_ns(samples))
            while self._patient and self._recorder.is_queue_filling(self.name):
                time.sleep(PATIENCE_S)
        while self._patient and self.ring.room < len(samples) < self.ring.capacity:
            time.sleep(PATIENCE_S)
        self.ring.push(samples)
        if not self._waiting_since_ns:
            self._waiting_since_ns = time.monotonic_ns()
        self._wake.set()

    def _offset_ns(self, t_ns: int) -> int:
        """Return the difference of Unix time and a time of the samples, in nanoseconds."""
        return 0 if self.driver.times_are_unix else self._slewed_clock.offset_ns(t_ns)

    def _offsets_ns(self, samples: SampleBlock) -> Ints | int:
        """Return the same for each sample. The Unix times increase even if the host's clock was set back."""
        return 0 if self.driver.times_are_unix else self._slewed_clock.offsets_ns(samples.t_ns)

    def _can_take(self) -> bool:
        """Return True if samples may be taken; they wait in the ring buffer until rate and kernels are available."""
        chain = self.chain
        if chain.waiting or self._tail is not None:
            return False
        if chain.estimator is not None or chain.refusal_reason:
            return True
        if self.clock.rate_hz is None:  # samples are published even if their times do not show a rate
            return self.ring.room < self.ring.capacity // 2
        return chain.can_begin(self.clock.rate_hz)

    def _take(self) -> list[SampleBlock]:
        """Take all samples from the ring buffer."""
        came_ns, self._waiting_since_ns = self._waiting_since_ns, 0
        self._unpublished_since_ns = self._unpublished_since_ns or came_ns
        return self.ring.take()

    def _publish_samples(self, outputs: Sequence[Output], now_s: float, drain: bool) -> bool:
        """Publish the collected samples as a batch if it is due; return True if samples were published."""
        every_s = min(self.device.publish_s, MAX_BATCH_S)
        if not self._unpublished or not (self._due("samples", every_s, now_s) or drain):
            return False
        blocks, self._unpublished = self._unpublished, []
        for samples in merge_contiguous_blocks(blocks):
            self.published += len(samples)
            offsets_ns = self._offsets_ns(samples)
            for output in outputs:
                output.samples(self.name, self.published, samples, offsets_ns)
            if self.chain.compensation is not None and np.isfinite(samples.values[:, :3]).any():
                self._publish_compensated(outputs, self.chain.compensation, samples)
        return True

    def _publish_compensated(self, outputs: Sequence[Output], live: LiveCompensation, samples: SampleBlock) -> None:
        """Publish the samples without gyroscope drift, and the state of the drift compensation."""
        at = 0
        while at < len(samples):
            piece = samples[at : at + live.compensator.samples_to_interval_end]
            at += len(piece)
            without = live.update(piece)
            self.chain.update_drift_models()
            offsets_ns = self._offsets_ns(without)
            for output in outputs:
                output.compensated(self.name, self.published - len(samples) + at, without, offsets_ns)
        for look in live.take():
            self._publish_result(outputs, look.t_ns, look)

    def _publish_estimate(self, outputs: Sequence[Output], now_s: float, drain: bool) -> bool:
        """Update the fit and publish the estimate if it is due; return True if it was published."""
        # a refit at every sample needs no interval here; ``get`` empties the per-sample history, so it is called only
        # for a publication
        every_s = self.device.refit_s or self.device.publish_s
        self._check_rate(drain)
        estimator = self.chain.estimator
        if estimator is not None and self.chain.advanced and (self._due("refit", every_s, now_s) or drain):
            fitted = self.chain.can_fit
            self.chain.advanced = not fitted  # a curve without coefficients is fitted as soon as the kernels are ready
            try:
                latest = estimator.get(fitted=fitted)
            except NotReady:
                return False
            if self.chain.fits_slowly:
                self._next_s["refit"] = max(self._next_s["refit"], now_s + INTERPRETED_REFIT_S)
            self.latest = latest.without_coefficients() if any(self._rate_doubts) else latest
            self._refitted = True
        if self.latest is None or not self._refitted:
            return False
        if not (self._due("publish", self.device.publish_s, now_s) or drain):
            return False
        self._refitted = False
        self._publish_result(outputs, self.latest.t_ns, self.latest)
        if self.chain.model_in_force is not None:
            look = self.chain.model_in_force.compare(self.latest)
            self._publish_gap(outputs, replace(look, axes={}) if any(self._rate_doubts) else look)
        self._publish_events(outputs, self._limits.update(self.latest))
        return True

    def _check_rate(self, drain: bool) -> None:
        """Withhold the coefficients while the configured rate is contradicted by the data, or is not checked yet."""
        if drain:
            self.clock.end()
        doubts = (self.clock.contradicted_hz is not None, self.clock.rate_check_pending)
        if doubts != self._rate_doubts:
            self._rate_doubts = doubts
            self._update_rate()
            self.chain.advanced = True  # the newest estimate must be computed again

    def _update_rate(self) -> None:
        """Pass the best known sample rate to the pipeline."""
        rate_hz = self.clock.rate_hz
        if rate_hz is not None and self._tail is None:
            self.chain.set_rate(rate_hz)

    def _publish_gap(self, outputs: Sequence[Output], look: ModelGap) -> None:
        """Publish the comparison of the window with the model in force, and its events."""
        events = self._agreement.update(look)
        look = replace(look, agrees=self._agreement.verdicts)
        self._publish_result(outputs, look.t_ns, look)
        self._publish_events(outputs, events)

    def _publish_result(self, outputs: Sequence[Output], t_ns: int, result: Any) -> None:
        """Publish a result that belongs to the host time ``t_ns``."""
        for output in outputs:
            output.result(self.name, self.unix_s(t_ns), self.driver.counts.received, result)

    def _publish_events(self, outputs: Sequence[Output], events: Sequence[Event]) -> None:
        """Publish events."""
        for event in events:
            for output in outputs:
                output.event(self.name, self.unix_s(event.t_ns), self.driver.counts.received, event)

    def _publish_total(self, outputs: Sequence[Output], now_s: float) -> None:
        """Compute one step of the total and Hadamard deviations, and publish them when complete."""
        estimator = self.chain.estimator
        if estimator is None or not self._ready.all.is_set() or now_s < self._next_s["total"]:
            return
        begun_s = time.perf_counter()
        found = estimator.step_slow_statistics()
        self._next_s["total"] = now_s + max(TOTAL_INTERVAL_S, (time.perf_counter() - begun_s) / TOTAL_CPU_SHARE)
        if found is not None:
            self._publish_result(outputs, self.chain.newest_ns, SlowStatistics(*found))

    def _publish_thermal(self, outputs: Sequence[Output], now_s: float) -> None:
        """Publish the finished thermal intervals, and continue the selection of a thermal model."""
        for look in self.chain.take_thermal_intervals():
            self._publish_result(outputs, look.t_ns, look)
        thermal = self.chain.thermal
        if thermal is None or not thermal.choosing or now_s < self._next_s["thermal"]:
            return
        begun_s = time.perf_counter()
        until_s = begun_s + (MODEL_SELECTION_REPLAY_S if self._patient else MODEL_SELECTION_S)
        while thermal.step() and time.perf_counter() < until_s:
            pass
        if self._patient:
            self._wake.set()  # the waiting samples of the recording can be processed
        else:
            self._next_s["thermal"] = now_s + (time.perf_counter() - begun_s) / MODEL_SELECTION_CPU_SHARE

    def _due(self, what: str, every_s: float, now_s: float) -> bool:
        """Return True if a periodic task is due, and schedule its next run."""
        if now_s < self._next_s[what]:
            return False
        # keep the period, but do not catch up after a pause
        self._next_s[what] = max(self._next_s[what] + every_s, now_s + 0.5 * every_s)
        return True

    def _text(self) -> str:
        """Return the status message of the device; empty if there is nothing to report."""
        if self._tail is not None and self._ready.all.is_set() and self.driver.state == "running":
            return "the window is being rebuilt from the recording; no sample is lost"
        if self._ready.progress and self.driver.state == "running":
            lacking = "" if self.chain.can_fit else "no coefficients yet, "
            return f"{self._ready.progress}; {lacking}no sample is lost"
        if not self.chain.can_fit and self.driver.state == "running":
            return "compiling the estimator; no coefficients yet, no sample is lost"
        lacking = self._missing_estimate_text() if self.driver.state in ("running", "ended") else ""
        if self.driver.text or self.driver.state != "running":
            return f"{self.driver.text.rstrip('.')}; {lacking}" if lacking else self.driver.text
        return lacking or self.driver.late_hint or self._clock_text()

    def _missing_estimate_text(self) -> str:
        """Return the reason why there are no coefficients; empty if there are coefficients, or will be."""
        measured_hz = self.clock.contradicted_hz
        if measured_hz is not None:
            return (
                f"measured rate {measured_hz:.4g} Hz differs from the configured {self.device.rate_hz:g} Hz; "
                "coefficients are withheld: correct `rate` or remove it"
            )
        if self.chain.estimator is None and self.published and self.clock.rate_hz is None:
            return "no estimate: the times of the samples do not show a rate; set `rate`"
        return self.chain.refusal_reason

    def _clock_text(self) -> str:
        """Return a message about the offset of the sample times from the host clock; empty if the offset is small."""
        behind_s = 0.0 if self.driver.times_are_unix else self._slewed_clock.behind_ns / 1e9
        if abs(behind_s) < MIN_CLOCK_STEP_S:
            return ""
        where = "behind" if behind_s > 0.0 else "ahead of"
        return f"times are {abs(behind_s):.6g} s {where} the host's clock, which was set"


def _arrivals_are_timed(device: Device, link: Link) -> bool:
    """Return True if arrival times show the sample rate of the device.

    They do not if a file is read or a sensor is simulated faster than in real time.
    """
    simulated = isinstance(device.link, VirtualTable) and device.link.speed != 1.0
    captured = isinstance(link, ReplayLink) and link.epoch == "monotonic"
    return not simulated and not captured
