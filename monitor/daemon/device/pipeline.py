"""Processing pipeline of one device: motion detection, noise estimation, thermal model and drift compensation.

``DevicePipeline.advance`` processes blocks of samples in order of time. The newest results are in ``estimator``,
``thermal``, ``compensation`` and ``signal_monitor``. ``take_events`` returns the detections.

The pipeline publishes nothing and reads no clock. The device worker decides when to call the pipeline and what to
publish. After a restart of the program, ``replay_samples`` processes the end of the recording without events.
"""

from collections import deque
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Final

import numpy as np

from drivers.data_types import AXES, Event, Floats, SampleBlock
from drivers.errors import ConfigError
from monitor.common.compiled import interpreted
from monitor.daemon.device.arma_worker import ArmaWorker
from monitor.daemon.kernels.kernel_readiness import KernelReadiness
from monitor.drift.compensation.live_compensation import LiveCompensation
from monitor.drift.thermal.live_thermal import LiveThermal, ThermalIntervalResult
from monitor.estimation.detection.model_comparison import PreparedModel
from monitor.estimation.detection.signal_monitor import SignalMonitor
from monitor.estimation.estimator import Estimator
from monitor.estimation.window_snapshot import TemperatureRing, WindowSnapshot
from monitor.noise.model import NoiseModel
from monitor.settings.loading import Device

MAX_PIECE_SAMPLES: Final = 512
"""Largest number of samples between two tests for changed noise. A fast replay passes thousands at a time."""


class DevicePipeline:
    """Processing pipeline of one device.

    Parameters
    ----------
    device : Device
        Settings of the device.
    model : NoiseModel or None
        Noise model in force, with which the samples are compared.
    ready : KernelReadiness
        Flags of the compiled kernels. ``advance`` compiles no kernel, because compilation would delay all devices.
    replayed : bool
        True for the samples of a recording. They can wait while a thermal model is being selected.
    needs_all : bool
        True if processing must wait until all kernels can be called.
    live : bool
        True if samples arrive at the device's sample rate, so that kernels can be interpreted at a low rate.
    """

    def __init__(
        self,
        device: Device,
        model: NoiseModel | None,
        ready: KernelReadiness,
        replayed: bool,
        needs_all: bool,
        live: bool,
    ) -> None:
        self.estimator: Estimator | None = None
        self.signal_monitor: SignalMonitor | None = None
        self.thermal: LiveThermal | None = None
        self.compensation: LiveCompensation | None = None
        self.model_in_force: PreparedModel | None = None
        self.refusal_reason = ""
        """Reason why an estimate is not possible; empty if it is possible."""
        self.advanced = False
        """True if samples were processed since the publisher last set this attribute to False."""
        self.since_ns: list[int | None] = [None] * len(AXES)
        """Time of the first sample after the restart of each axis, in nanoseconds; None without a restart."""
        self.newest_ns = 0
        """Time of the newest sample that entered the pipeline, in nanoseconds; 0 before the first."""
        self.arma_worker = ArmaWorker(f"drift of {device.name}", synchronous=replayed)
        self._device = device
        self._model = model
        self.ready = ready
        self._replayed = replayed
        self._needs = ready.all if needs_all else ready.window
        self._live = live
        self._interprets = False
        self._temperatures: TemperatureRing | None = None  # of the samples in the window
        self._thermal_intervals: list[ThermalIntervalResult] = []  # thermal intervals that were not taken yet
        self._handled = 0  # last seen value of ``signal_monitor.orientation_changes``
        self._pieces: deque[SampleBlock] = deque()  # samples of a recording that wait for a thermal model
        self._replaying = False

    def required_kernels_ready(self, rate_hz: float) -> bool:
        """Return True if the kernels that the first samples need are compiled or can be interpreted."""
        if not self._interprets and not self._needs.is_set():
            self._interprets = self._live and self.ready.reserve_interpreted_rate(rate_hz)
        return self._interprets or self._needs.is_set()

    @property
    def fit_kernels_ready(self) -> bool:
        """True if the kernels that fit the noise coefficients can be called."""
        return self._interprets or self.ready.fit.is_set()

    @property
    def fit_is_interpreted(self) -> bool:
        """True if Python interprets the kernels of the fit. A fit then takes about 0.1 s."""
        return self._interprets and not self.ready.fit.is_set()

    @property
    def detection_kernels_ready(self) -> bool:
        """True if the kernels of motion and change detection can be called."""
        return self._interprets or self.ready.all.is_set()

    def kernel_context(self, rate_hz: float | None) -> AbstractContextManager[None]:
        """Return the context manager for calls of the kernels, which interprets kernels if necessary."""
        if rate_hz is not None and self.estimator is None:
            self.required_kernels_ready(rate_hz)
        return interpreted() if self._interprets and not self.ready.all.is_set() else nullcontext()

    @property
    def awaits_thermal_model(self) -> bool:
        """True while samples of a recording wait for the selection of a thermal model."""
        return bool(self._pieces)

    def process_blocks(self, blocks: Sequence[SampleBlock], rate_hz: float | None, drain: bool) -> None:
        """Process blocks of samples. While the sample rate is unknown, the samples are discarded.

        Parameters
        ----------
        blocks : sequence of SampleBlock
            New samples, in order of time.
        rate_hz : float or None
            Sample rate; None if it is unknown.
        drain : bool
            True if all samples are to be processed now, without a wait for the thermal model.
        """
        if blocks:
            self.newest_ns = int(blocks[-1].t_ns[-1])
        if self.estimator is None and (rate_hz is None or not self._create_estimator(rate_hz)):
            return
        if self.signal_monitor is None and self.detection_kernels_ready:
            self._create_detectors()
        self._pieces += [
            samples[at : at + MAX_PIECE_SAMPLES]
            for samples in blocks
            for at in range(0, len(samples), MAX_PIECE_SAMPLES)
        ]
        while self._pieces and (drain or not self._replayed or self.thermal is None or not self.thermal.choosing):
            piece = self._pieces.popleft()
            self._update_estimator(self.signal_monitor.update(piece) if self.signal_monitor is not None else [piece])
            self._restart_changed_axes()
            self._update_thermal()

    def process_held_samples(self) -> None:
        """Process the samples that the motion detector holds back. Called after the last sample."""
        self._update_estimator(self.signal_monitor.flush() if self.signal_monitor is not None else [])
        self._restart_changed_axes()
        self._update_thermal()

    def update_drift_models(self) -> None:
        """At the end of an interval, adopt new drift models, and start to identify the models that are due."""
        live = self.compensation
        if live is None or not self.ready.all.is_set():  # the thread that identifies models would compile kernels
            return
        if live.compensator.samples_to_interval_end == live.compensator.interval_samples:
            self.arma_worker.adopt_and_start_models(live)

    def replay_samples(self, samples: SampleBlock, rate_hz: float) -> None:
        """Process a recorded block after a restart of the program, to rebuild the window.

        The events of these samples were published before the restart, so they are discarded. Changes of the noise
        restart no axis, because the recording states the start of each axis.

        Parameters
        ----------
        samples : SampleBlock
            Recorded samples, in order of time.
        rate_hz : float
            Sample rate.
        """
        self._replaying = True
        self.process_blocks([samples], rate_hz, drain=True)
        self._replaying = False
        live = self.compensation
        if live is not None and np.isfinite(samples.values[:, :3]).any():
            for at in range(0, len(samples), MAX_PIECE_SAMPLES):
                live.update(samples[at : at + MAX_PIECE_SAMPLES])
            self.arma_worker.adopt_and_start_models(live)
            live.take_updates()
        self.take_events()
        self.take_thermal_intervals()

    def empty_window(self) -> None:
        """Empty the window."""
        if self.estimator is not None:
            self.estimator.reset()
            self.since_ns = [self.newest_ns + 1] * len(AXES)

    def refine_rate(self, rate_hz: float) -> None:
        """Set the sample rate to a more accurate value."""
        if self.estimator is None or rate_hz == self.estimator.rate_hz:
            return
        self.estimator.refine_rate(rate_hz)
        for one in (self.signal_monitor, self.thermal, self.compensation):
            if one is not None:
                one.set_rate(rate_hz)

    def copy_window_and_temperature(self) -> tuple[WindowSnapshot, Floats] | None:
        """Return a copy of the window, and the temperature float64 [n] in °C; None if the window is empty."""
        if self.estimator is None or self._temperatures is None or not self.estimator.samples_in_window:
            return None
        return self.estimator.copy_window(), self._temperatures.newest_temperatures(self.estimator.samples_in_window)

    def take_events(self) -> list[Event]:
        """Return the events that were detected since the last call."""
        found = [
            source.take_events()
            for source in (self.signal_monitor, self.thermal, self.compensation)
            if source is not None
        ]
        return [event for events in found for event in events]

    def take_thermal_intervals(self) -> list[ThermalIntervalResult]:
        """Return the thermal intervals that were completed since the last call."""
        intervals, self._thermal_intervals = self._thermal_intervals, []
        return intervals

    # --- private methods

    def _create_estimator(self, rate_hz: float) -> bool:
        """Create the estimator for a sample rate; return False if this is not possible now."""
        if self.refusal_reason or not self.required_kernels_ready(rate_hz):
            return False
        device = self._device
        try:
            self.estimator = Estimator(rate_hz, device.window_s, device.tau, every_sample=device.refit_s == 0.0)
            self._temperatures = TemperatureRing(self.estimator.window_samples)
            if self._model is not None:
                self.model_in_force = PreparedModel(self._model, self.estimator.window_samples)
        except (
            ConfigError
        ) as error:  # the configured averaging times do not suit the measured rate; samples are still published
            self.refusal_reason = f"no estimate: {error}"
            return False
        return True

    def _create_detectors(self) -> None:
        """Create the configured parts: motion and change detection, thermal model and drift compensation."""
        if self.estimator is None:
            return
        device, rate_hz = self._device, self.estimator.rate_hz
        wanted = device.thermal_s is not None
        self.signal_monitor = SignalMonitor(
            rate_hz, device.leave_out_motion, device.alarms_per_day, keep_samples_at_rest=wanted
        )
        self.thermal = None if device.thermal_s is None else LiveThermal(rate_hz, device.thermal_s)
        self.compensation = LiveCompensation(rate_hz) if device.compensate else None

    def _update_estimator(self, blocks: Sequence[SampleBlock]) -> None:
        """Update the estimator with blocks of samples."""
        if self.estimator is None or self._temperatures is None:
            return
        for samples in blocks:
            self.estimator.update(samples)
            self._temperatures.push(samples.lost, samples.temperature_c)
            self.advanced = True

    def _restart_changed_axes(self) -> None:
        """Restart the axes in which a change of the noise was detected."""
        restarts = self.signal_monitor.take_restarts() if self.signal_monitor is not None else []
        if self.estimator is None or not self._device.restart or self._replaying:
            return
        for restart in restarts:
            self.estimator.restart(restart.axis, restart.samples)
            back_ns = round((restart.samples - 0.5) / self.estimator.rate_hz * 1e9)
            self.since_ns[restart.axis] = self.newest_ns - back_ns

    def _update_thermal(self) -> None:
        """Pass the samples at rest to the thermal model."""
        if self.signal_monitor is None or self.thermal is None:
            return
        if self.signal_monitor.orientation_changes != self._handled:
            self._handled = self.signal_monitor.orientation_changes
            self.thermal.learn_new_offset()
        for samples in self.signal_monitor.take_samples_at_rest():
            self._thermal_intervals += self.thermal.update(samples)
