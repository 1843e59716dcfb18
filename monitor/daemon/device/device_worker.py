"""Worker of one device: reader thread, ring buffer, processing pipeline and publication of the results.

In each round of the main loop, ``DeviceWorker.process_new_samples`` takes the new samples, advances the pipeline
(``DevicePipeline``) and publishes the results that are due (``ResultPublisher``).
"""

import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

from drivers.data_types import Chunk, Floats, SampleBlock
from drivers.driver import Driver
from drivers.errors import ImuError
from drivers.host.wake_signal import WakeSignal
from drivers.links.base import BatchingLink, Link
from drivers.links.replay_link import ReplayLink
from drivers.timing.sample_clock import SampleClock
from monitor.common.device_health import Health
from monitor.common.loss_of_samples import NO_LOSS, LossOfSamples
from monitor.common.unexpected_errors import log_unexpected_error
from monitor.daemon.device.device_status import DeviceStatus
from monitor.daemon.device.pipeline import DevicePipeline
from monitor.daemon.device.ring_buffer import RingBuffer
from monitor.daemon.device.unix_timeline import DeviceTimeline
from monitor.daemon.device.window_restore import WindowRestore
from monitor.daemon.kernels.kernel_readiness import KernelReadiness
from monitor.daemon.operations.coefficient_limits import LimitMonitor, read_model_in_force
from monitor.daemon.outputs.output import Output, call_outputs
from monitor.daemon.result_publisher import ResultPublisher
from monitor.daemon.storage.recorder import Recorder
from monitor.estimation.window_sample_snapshot import WindowSnapshot
from monitor.settings.loading import Device, VirtualTable

if TYPE_CHECKING:
    from monitor.simulator.simulated_device import SimulatedDevice

RING_S: Final = 65.536
"""Capacity of the ring buffer in seconds, limited to RING_SAMPLES_RANGE. Samples wait while kernels are compiled."""
RING_SAMPLES_RANGE: Final = (4096, 1_000_000)
"""Minimum and maximum capacity of the ring buffer in samples."""
MIN_REPLAY_RING_SAMPLES: Final = 65_536
"""Minimum capacity for a replayed recording, whose blocks of up to 4096 samples wait for space in the ring buffer."""
UNKNOWN_RATE_HZ: Final = 1000.0
"""Assumed sample rate for the capacity of the ring buffer if no rate is configured."""
READ_TIMEOUT_RANGE_S: Final = (0.004, 0.1)
"""Shortest and longest time for which received bytes wait for more bytes, by default the interval of publication.

A read takes about as much processor time for one sample as for 50 samples. Each read wakes the main loop, which
publishes at once, so that the wait does not delay the newest sample of a result.
"""
REPLAY_PAUSE_S: Final = 0.002
"""Interval at which the reader of a replayed recording checks a full queue."""
MIN_RESTART_PAUSE_S: Final = 1.0
"""Pause before the estimation is started anew after an unexpected exception. The pause doubles with each exception."""
MAX_RESTART_PAUSE_S: Final = 32.0
"""Longest pause before the estimation is started anew. The ring buffer holds the samples of this time."""
MODEL_SELECTION_S: Final = 0.001
"""Processor time per round for the selection of a thermal model of a live sensor."""
MODEL_SELECTION_REPLAY_S: Final = 0.02
"""Processor time per round for the selection of a thermal model of a replayed recording."""
MODEL_SELECTION_CPU_SHARE: Final = 0.02
"""Maximum fraction of one processor for the selection of a thermal model."""


class DeviceWorker:
    """Worker of one device of the service.

    Parameters
    ----------
    device : Device
        Settings of the device.
    link : Link
        Link from which the samples are read.
    outputs : sequence of Output
        Receivers of the results.
    wake : WakeSignal
        Signal that is set when samples have arrived.
    ready : KernelReadiness
        Flags of the compiled kernels. Samples wait until the required kernels are compiled.
    recorder : Recorder, optional
        Recorder of samples and raw bytes.
    simulated : SimulatedDevice, optional
        Simulated sensor that sends samples to the link.

    Raises
    ------
    ConfigError
        If the noise model of the device cannot be read.
    """

    def __init__(
        self,
        device: Device,
        link: Link,
        outputs: Sequence[Output],
        wake: WakeSignal,
        ready: KernelReadiness,
        recorder: Recorder | None = None,
        simulated: "SimulatedDevice | None" = None,
    ) -> None:
        self.device = device
        self.name = device.name
        self.model = read_model_in_force(device)
        self._replayed = link.epoch == "unix"
        low, high = RING_SAMPLES_RANGE
        low = MIN_REPLAY_RING_SAMPLES if self._replayed else low
        self.ring = RingBuffer(int(min(max((device.rate_hz or UNKNOWN_RATE_HZ) * RING_S, low), high)))
        timed = _arrivals_are_timed(device, link)
        if isinstance(link, BatchingLink):
            shortest_s, longest_s = READ_TIMEOUT_RANGE_S
            link.set_default_read_timeout(min(max(device.publish_s, shortest_s), longest_s))
        self.clock = SampleClock(device.decoder.timing, device.rate_hz, timed)
        keep = None if recorder is None else self._record_chunks
        self.driver = Driver(
            device.name, link, device.decoder, self.clock, self._push, device.axes, device.silence_s, keep
        )
        # otherwise, a short recording could end before the kernels of change detection are compiled
        self.waits_for_all = device.refit_s == 0.0 or device.leave_out_motion or isinstance(link, ReplayLink)
        self._live = device.refit_s != 0.0 and timed and not isinstance(link, ReplayLink)
        self.timeline = DeviceTimeline(self.driver)
        self.status = DeviceStatus(self)
        self.simulated = simulated
        self.failure = ""
        """Reason why the estimation must be started anew, or ""."""
        self._failures = 0
        self._restart_s: float | None = None  # monotonic time at which the estimation is started anew
        self._outputs = outputs
        self._ready = ready
        self._recorder = recorder
        self._wake = wake
        self._thread = threading.Thread(target=self.driver.run, name=f"reader of {device.name}", daemon=True)
        self._unstarted = [one for one in (simulated, self._thread) if one is not None]
        self._start_estimation(published=0)

    def _start_estimation(self, published: int) -> None:
        """Create the pipeline and the publisher of the device, with an empty window."""
        device = self.device
        self.pipeline = DevicePipeline(device, self.model, self._ready, self._replayed, self.waits_for_all, self._live)
        limits = LimitMonitor(device.limits, self.model)
        self.publisher = ResultPublisher(device, self.driver, self.timeline, self.pipeline, limits, self._outputs)
        self.publisher.published = published
        self.restore = WindowRestore(device, self.pipeline, self.clock, self.timeline)
        self._rate_doubts = (False, False)  # configured rate is contradicted; configured rate is not checked yet

    # --- start and stop

    def start_reader_and_resume_recording(self) -> None:
        """Start the reader thread, and continue a recording that ended less than one window ago."""
        with self._contain_errors():
            if self._recorder is not None and not self._replayed:
                self.restore.resume_from(self._recorder.find_last_recorded_samples(self.name))
                if self.restore.active:  # the program may restart before a new estimate is available
                    self._recorder.set_estimate_state(self.name, self.restore.state_to_record())
        with self._contain_errors():
            self._start_threads()

    def _start_threads(self) -> None:
        """Start the threads that could not be started yet, because the system allowed no more threads."""
        while self._unstarted:
            self._unstarted[0].start()
            del self._unstarted[0]

    def refill_window_from_recording(self) -> None:
        """Fill the window from the recording, while new samples wait in the ring buffer."""
        with self._contain_errors():
            self.restore.refill_window_from_recording()
        self._wake.set()

    @contextmanager
    def _contain_errors(self) -> Iterator[None]:
        """Start the estimation anew after an exception, so that the other devices continue."""
        try:
            yield
        except (ImuError, OSError) as error:
            self.failure = str(error)
        except Exception as error:  # noqa: BLE001 - the status of the device shows the error
            self.failure = log_unexpected_error(f"device {self.name}", error)

    def stop_reader_thread(self) -> None:
        """Stop the reader thread. Samples in the ring buffer are kept."""
        self._unstarted.clear()
        with self._contain_errors():
            self.driver.stop()
        with self._contain_errors():
            if self.simulated is not None:
                self.simulated.stop()

    def join_reader_thread(self, timeout_s: float) -> bool:
        """Wait for the end of the reader thread, and return False after a timeout."""
        if self._thread.is_alive():
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    @property
    def replay_finished(self) -> bool:
        """True if a replay has ended and all samples have been processed."""
        if self.driver.state != "ended" or self._thread.is_alive() or not self.pipeline.ready.all.is_set():
            return False
        return not self.pipeline.awaits_thermal_model and (
            self.ring.is_empty or self.clock.configured_or_measured_rate_hz is None
        )

    @property
    def reader_progress_count(self) -> int | None:
        """Number of read attempts of the reader thread, or None if the thread may block.

        A reader that has ended makes no attempts, and a replayed recording blocks while the ring buffer is full.
        """
        return None if self._replayed or self.driver.state == "ended" else self.driver.iterations

    # --- one round

    def process_new_samples(self, now_s: float, drain: bool = False) -> None:
        """Process the new samples and publish the results that are due.

        Parameters
        ----------
        now_s : float
            Present time on the monotonic clock, in seconds.
        drain : bool, optional
            True to process all samples and publish all results, because the device stops.
        """
        with self._contain_errors():
            if self.failure and not self._recover(now_s):
                return
            self.publisher.schedule.begin_round(now_s, drain)
            with self.pipeline.interpret_kernels_if_uncompiled(self.clock.configured_or_measured_rate_hz):
                self._process_new_samples(drain)

    def _recover(self, now_s: float) -> bool:
        """Start the estimation anew after a pause that doubles with each failure; return True if it was started."""
        if self._restart_s is None:
            self._restart_s = now_s + min(MIN_RESTART_PAUSE_S * 2**self._failures, MAX_RESTART_PAUSE_S)
        if now_s < self._restart_s:
            return False
        self._failures, self._restart_s = self._failures + 1, None
        failure, self.failure = self.failure, ""
        self._start_estimation(self.publisher.published)
        self._start_threads()
        self.timeline.add_event_now("estimation_restarted", f"{failure}; the window starts empty")
        return True

    def _process_new_samples(self, drain: bool) -> None:
        error, self.driver.unexpected_error = self.driver.unexpected_error, None
        if error is not None:
            log_unexpected_error(f"reader of {self.name}", error)
        events = self.driver.take_events()
        if self.restore.active:  # another thread uses the pipeline
            self.publisher.publish_events(self.timeline.take_events() + events)
            return
        blocks = self._take() if drain or self._can_take() else []
        events = self.timeline.take_events() + events  # the time of the first sample is known now
        self.pipeline.process_blocks(blocks, self.clock.configured_or_measured_rate_hz, drain)
        if any(event.kind == "rate_changed" for event in events):
            self.pipeline.restart_at_new_rate()
        if drain:
            self.pipeline.process_samples_held_by_motion_detector()
        if self.pipeline.thermal is not None and any(event.kind == "link_back" for event in events):
            self.pipeline.thermal.learn_new_offset()
        self._check_rate(drain)
        published = self.publisher.publish_estimate_if_due()
        published |= self.publisher.batch_samples_and_publish_if_due(blocks)
        if published:
            self.status.latency.note_publication()
        self.publisher.publish_events(events + self.pipeline.take_events())
        self.publisher.publish_thermal_intervals()
        self._select_thermal_model()
        self.publisher.advance_total_and_hadamard()

    def _can_take(self) -> bool:
        """Return True if the sample rate and the kernels are available to process samples."""
        pipeline = self.pipeline
        if pipeline.awaits_thermal_model or self.restore.active:
            return False
        if pipeline.estimator is not None or pipeline.refusal_reason:
            return True
        if (
            self.clock.configured_or_measured_rate_hz is None
        ):  # samples are also published if the sample rate stays unknown
            return self.ring.free_capacity < self.ring.capacity // 2
        return pipeline.required_kernels_ready(self.clock.configured_or_measured_rate_hz)

    def _take(self) -> list[SampleBlock]:
        self.status.latency.note_ring_buffer_emptied()
        blocks = self.ring.take_samples()
        if blocks:
            self.timeline.set_newest_sample_time(int(blocks[-1].t_ns[-1]))
        return blocks

    def _select_thermal_model(self) -> None:
        thermal, schedule = self.pipeline.thermal, self.publisher.schedule
        if thermal is None or not thermal.is_selecting_model or not schedule.is_due("thermal"):
            return
        begun_s = time.perf_counter()
        until_s = begun_s + (MODEL_SELECTION_REPLAY_S if self._replayed else MODEL_SELECTION_S)
        while thermal.run_selection_step_if_active() and time.perf_counter() < until_s:
            pass
        if self._replayed:
            self._wake.set()  # samples of the recording may wait
        else:
            schedule.postpone("thermal", (time.perf_counter() - begun_s) / MODEL_SELECTION_CPU_SHARE)

    def _check_rate(self, drain: bool) -> None:
        """Withhold the coefficients while the configured rate is contradicted or not yet confirmed."""
        if drain:
            self.clock.compare_rates_at_end()
        doubts = (self.clock.contradicting_rate_hz is not None, self.clock.rate_check_pending)
        if doubts != self._rate_doubts:
            self._rate_doubts = doubts
            self.publisher.withholds_coefficients = any(doubts)
            self._update_rate()
            self.pipeline.advanced = True  # the estimate must be computed again

    def _update_rate(self) -> None:
        rate_hz = self.clock.configured_or_measured_rate_hz
        if rate_hz is not None and not self.restore.active:
            self.pipeline.refine_rate(rate_hz)

    # --- commands and status

    def empty_window(self) -> None:
        """Discard all samples of the window, unless the window is being rebuilt."""
        if not self.restore.active:
            self.pipeline.empty_window()

    def copy_window_and_temperature(self) -> tuple[WindowSnapshot, Floats] | None:
        """Return a copy of the window and the temperatures [n] in °C, or None if the window is empty."""
        return None if self.restore.active else self.pipeline.copy_window_and_temperature()

    def loss_of_samples(self) -> LossOfSamples:
        """Return the missing samples of the window, unless the window is being rebuilt by another thread."""
        estimator = self.pipeline.estimator
        return NO_LOSS if estimator is None or self.restore.active else estimator.loss_of_samples()

    def replace_limits(self, device: Device) -> None:
        """Replace the user limits of the device. The states of unchanged limits are kept.

        Raises
        ------
        ConfigError
            If a limit is relative to a coefficient that the noise model does not contain.
        """
        limits = LimitMonitor(device.limits, self.model)
        limits.copy_states_from(self.publisher.limits)
        self.device, self.publisher.limits = device, limits

    def publish_event(self, kind: str, text: str) -> None:
        """Publish an event with the present time, as soon as the present time is known.

        Parameters
        ----------
        kind : str
            Kind of the event, for example "recording_stopped".
        text : str
            Message of the event.
        """
        self.timeline.add_event_now(kind, text)
        self.publisher.publish_events(self.timeline.take_events())

    def slew_and_publish_status(self, states: dict[str, str], memory_bytes: int) -> Health:
        """Slew the sample times towards the host clock, and publish the status of the device.

        Parameters
        ----------
        states : dict of str to str
            State of each output of the service, by name.
        memory_bytes : int
            Resident memory of the process.

        Returns
        -------
        Health
            Published status.
        """
        unix_s, health = None, None
        with self._contain_errors():
            self.timeline.slew_to_host_clock()
            self.publisher.publish_events(self.timeline.take_events())
            if not self.failure:
                self._update_rate()
                if self._recorder is not None:
                    self._recorder.set_estimate_state(self.name, self.restore.state_to_record())
                health = self.status.build_health(states, memory_bytes)
            unix_s = self.timeline.now_unix_s()
        health = health or self.status.build_health_of_failed_device(states, memory_bytes)
        call_outputs(self._outputs, "publish_health", self.name, unix_s, health)
        return health

    # --- called by the reader thread

    def _record_chunks(self, chunks: Sequence[Chunk]) -> None:
        if self._recorder is not None and chunks:
            self._recorder.queue_chunks(self.name, chunks, self.timeline.unix_offset_ns(chunks[0].t_ns))

    def _push(self, samples: SampleBlock) -> None:
        """Record decoded samples, and put them into the ring buffer; a replayed recording waits for space."""
        if self._recorder is not None:
            if self.pipeline.estimator is None:  # the program may crash before the first status is published
                self._recorder.set_estimate_state(self.name, self.restore.state_to_record())
            self._recorder.queue_samples(self.name, samples, self.timeline.unix_offsets_ns(samples))
            while self._replayed and self._recorder.is_queue_filling(self.name):
                time.sleep(REPLAY_PAUSE_S)
        while self._replayed and self.ring.free_capacity < len(samples) < self.ring.capacity:
            time.sleep(REPLAY_PAUSE_S)
        self.ring.push_samples(samples)
        self.status.latency.note_samples_arrived()
        self._wake.set()


def _arrivals_are_timed(device: Device, link: Link) -> bool:
    """Return True if the sample rate can be measured from the arrival times of the samples."""
    simulated = isinstance(device.link, VirtualTable) and device.link.speed != 1.0
    captured = isinstance(link, ReplayLink) and link.epoch == "monotonic"
    return not simulated and not captured
