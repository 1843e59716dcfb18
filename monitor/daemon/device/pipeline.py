"""Processing pipeline of one device: motion detection, noise estimation, thermal model and drift compensation.

``DevicePipeline.process_blocks`` processes blocks of samples in order of time. The newest results are in ``estimator``,
``thermal``, ``compensation`` and ``motion_and_change_monitor``, and ``take_events`` returns the detected events. The
pipeline publishes no results and reads no clock.
"""

from collections import deque
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Final

import numpy as np

from drivers.data_types import AXES, Event, Floats, SampleBlock
from drivers.errors import ConfigError
from monitor.common.compiled import interpret_uncompiled_kernels
from monitor.daemon.device.arma_worker import ArmaWorker
from monitor.daemon.kernels.kernel_readiness import KernelReadiness
from monitor.drift.compensation.live_compensation import LiveDriftCompensation
from monitor.drift.thermal.live_thermal import LiveThermalModels, ThermalIntervalResult
from monitor.estimation.detection.comparison_with_noise_model import NoiseModelComparator
from monitor.estimation.detection.motion_and_change_monitor import MotionAndChangeMonitor
from monitor.estimation.estimator import Estimator
from monitor.estimation.window_sample_snapshot import TemperatureRing, WindowSnapshot
from monitor.noise.model import NoiseModel
from monitor.settings.loading import Device

MAX_PIECE_SAMPLES: Final = 512
"""Maximum number of samples between two tests for changed noise."""


class DevicePipeline:
    """Processing pipeline of one device.

    Parameters
    ----------
    device : Device
        Settings of the device.
    model : NoiseModel or None
        Noise model with which the samples are compared.
    ready : KernelReadiness
        Flags of the compiled kernels.
    replayed : bool
        True for a replayed recording, whose samples can wait while a thermal model is being selected.
    needs_all : bool
        True if samples wait until all kernels are compiled.
    live : bool
        True if samples arrive in real time, so that kernels can be interpreted at a low rate.
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
        self.motion_and_change_monitor: MotionAndChangeMonitor | None = None
        self.thermal: LiveThermalModels | None = None
        self.compensation: LiveDriftCompensation | None = None
        self.noise_model_comparator: NoiseModelComparator | None = None
        self.refusal_reason = ""
        """Reason why an estimate is not possible, or ""."""
        self.advanced = False
        """True if samples have been processed since the last refit."""
        self.since_ns: list[int | None] = [None] * len(AXES)
        """Time of the first sample after the last restart of each axis in nanoseconds, or None."""
        self._changed_ns: list[int | None] = [None] * len(AXES)  # the noise changed, and the axis was not restarted
        self.newest_ns = 0
        """Time of the newest processed sample in nanoseconds, or 0."""
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
        self._handled = 0  # last seen value of ``motion_and_change_monitor.orientation_changes``
        self._pieces: deque[SampleBlock] = deque()  # samples of a recording that wait for a thermal model
        self._replaying = False

    def required_kernels_ready(self, rate_hz: float) -> bool:
        """Return True if the required kernels are compiled or can be interpreted."""
        if not self._interprets and not self._needs.is_set():
            self._interprets = self._live and self.ready.reserve_interpreted_rate(rate_hz)
        return self._interprets or self._needs.is_set()

    @property
    def fit_kernels_can_run(self) -> bool:
        """True if the kernels of the fit are compiled or can be interpreted."""
        return self._interprets or self.ready.fit.is_set()

    @property
    def fit_kernels_run_uncompiled(self) -> bool:
        """True if Python interprets the kernels of the fit, which then takes about 0.1 s."""
        return self._interprets and not self.ready.fit.is_set()

    @property
    def detection_kernels_ready(self) -> bool:
        """True if the kernels of motion and change detection are compiled or can be interpreted."""
        return self._interprets or self.ready.all.is_set()

    def interpret_kernels_if_uncompiled(self, rate_hz: float | None) -> AbstractContextManager[None]:
        """Return a context manager in which kernels that are not compiled are interpreted."""
        if rate_hz is not None and self.estimator is None:
            self.required_kernels_ready(rate_hz)
        return interpret_uncompiled_kernels() if self._interprets and not self.ready.all.is_set() else nullcontext()

    @property
    def awaits_thermal_model(self) -> bool:
        """True while samples of a recording wait for the selection of a thermal model."""
        return bool(self._pieces)

    def process_blocks(self, blocks: Sequence[SampleBlock], rate_hz: float | None, drain: bool) -> None:
        """Process blocks of samples. Samples are discarded while the sample rate is unknown.

        Parameters
        ----------
        blocks : sequence of SampleBlock
            New samples, in order of time.
        rate_hz : float or None
            Sample rate in Hz, or None if the sample rate is unknown.
        drain : bool
            True to process all samples without waiting for a thermal model.
        """
        if blocks:
            self.newest_ns = int(blocks[-1].t_ns[-1])
        if self.estimator is None and (rate_hz is None or not self._create_estimator(rate_hz)):
            return
        if self.motion_and_change_monitor is None and self.detection_kernels_ready:
            self._create_detectors()
        self._pieces += [
            samples[at : at + MAX_PIECE_SAMPLES]
            for samples in blocks
            for at in range(0, len(samples), MAX_PIECE_SAMPLES)
        ]
        while self._pieces and (
            drain or not self._replayed or self.thermal is None or not self.thermal.is_selecting_model
        ):
            piece = self._pieces.popleft()
            self._update_estimator(
                self.motion_and_change_monitor.process_samples(piece)
                if self.motion_and_change_monitor is not None
                else [piece]
            )
            self._restart_changed_axes()
            self._update_thermal()

    def process_samples_held_by_motion_detector(self) -> None:
        """After the last sample, process the samples that the motion detector still holds back."""
        self._update_estimator(
            self.motion_and_change_monitor.flush_delayed_samples() if self.motion_and_change_monitor is not None else []
        )
        self._restart_changed_axes()
        self._update_thermal()

    def adopt_and_identify_drift_models(self) -> None:
        """Adopt identified drift models at the end of an interval, and start identifications that are due."""
        live = self.compensation
        if live is None or not self.ready.all.is_set():  # otherwise, the identification would compile kernels
            return
        if live.compensator.samples_to_interval_end == live.compensator.interval_samples:
            self.arma_worker.adopt_results_and_start_next_identification(live)

    def replay_samples(self, samples: SampleBlock, rate_hz: float) -> None:
        """Process recorded samples without reporting events, to rebuild the window after a restart of the program.

        A noise change does not restart any axis, because the start of each axis is read from the recording.

        Parameters
        ----------
        samples : SampleBlock
            Recorded samples, in order of time.
        rate_hz : float
            Sample rate in Hz.
        """
        self._replaying = True
        self.process_blocks([samples], rate_hz, drain=True)
        self._replaying = False
        live = self.compensation
        if live is not None and np.isfinite(samples.values[:, :3]).any():
            for at in range(0, len(samples), MAX_PIECE_SAMPLES):
                live.compensate_block(samples[at : at + MAX_PIECE_SAMPLES])
            self.arma_worker.adopt_results_and_start_next_identification(live)
            live.take_drift_updates()
        self.take_events()
        self.take_thermal_intervals()

    def empty_window(self) -> None:
        """Discard all samples of the window."""
        if self.estimator is not None:
            self.estimator.empty_window()
            self.since_ns = [self.newest_ns + 1] * len(AXES)

    def restart_at_new_rate(self) -> None:
        """Discard all samples and models after a change of the sample rate. The next samples create new stages."""
        self.estimator = self.motion_and_change_monitor = self.thermal = self.compensation = None
        self.noise_model_comparator, self._temperatures = None, None
        self.refusal_reason, self._handled = "", 0
        self.since_ns = [self.newest_ns + 1] * len(AXES)

    def refine_rate(self, rate_hz: float) -> None:
        """Replace the sample rate of all stages by a more accurate value."""
        if self.estimator is None or rate_hz == self.estimator.rate_hz:
            return
        self.estimator.refine_rate(rate_hz)
        for one in (self.motion_and_change_monitor, self.thermal, self.compensation):
            if one is not None:
                one.set_rate(rate_hz)

    def mixed_noise_text(self) -> str:
        """Return which axes have samples from before a change of the noise in their window, or ""."""
        if self.estimator is None:
            return ""
        begin_ns = self.newest_ns - round(self.estimator.samples_in_window / self.estimator.rate_hz * 1e9)
        mixed = [
            axis for axis, at_ns in zip(AXES, self._changed_ns, strict=True) if at_ns is not None and at_ns > begin_ns
        ]
        if not mixed:
            return ""
        return f"the noise of {', '.join(mixed)} changed within the window, which is not restarted (`restart = false`)"

    def copy_window_and_temperature(self) -> tuple[WindowSnapshot, Floats] | None:
        """Return a copy of the window and the temperatures [n] in °C, or None if the window is empty."""
        if self.estimator is None or self._temperatures is None or not self.estimator.samples_in_window:
            return None
        return self.estimator.copy_window(), self._temperatures.newest_temperatures(self.estimator.samples_in_window)

    def take_events(self) -> list[Event]:
        """Return the events that were detected since the last call."""
        found = [
            source.take_events()
            for source in (self.motion_and_change_monitor, self.thermal, self.compensation)
            if source is not None
        ]
        return [event for events in found for event in events]

    def take_thermal_intervals(self) -> list[ThermalIntervalResult]:
        """Return the thermal intervals that were completed since the last call."""
        intervals, self._thermal_intervals = self._thermal_intervals, []
        return intervals

    # --- private methods

    def _create_estimator(self, rate_hz: float) -> bool:
        """Create the estimator for a sample rate; return False if the settings do not allow an estimate."""
        if self.refusal_reason or not self.required_kernels_ready(rate_hz):
            return False
        device = self._device
        try:
            self.estimator = Estimator(rate_hz, device.window_s, device.tau, every_sample=device.refit_s == 0.0)
            self._temperatures = TemperatureRing(self.estimator.window_length_samples)
            if self._model is not None:
                self.noise_model_comparator = NoiseModelComparator(self._model, self.estimator.window_length_samples)
        except ConfigError as error:  # the averaging times do not fit the measured rate
            self.refusal_reason = f"no estimate: {error}"
            return False
        return True

    def _create_detectors(self) -> None:
        if self.estimator is None:
            return
        device, rate_hz = self._device, self.estimator.rate_hz
        wanted = device.thermal_s is not None
        self.motion_and_change_monitor = MotionAndChangeMonitor(
            rate_hz, device.leave_out_motion, device.alarms_per_day, keep_samples_at_rest=wanted
        )
        self.thermal = None if device.thermal_s is None else LiveThermalModels(rate_hz, device.thermal_s)
        self.compensation = LiveDriftCompensation(rate_hz) if device.compensate else None

    def _update_estimator(self, blocks: Sequence[SampleBlock]) -> None:
        if self.estimator is None or self._temperatures is None:
            return
        for samples in blocks:
            self.estimator.add_samples(samples)
            self._temperatures.push_temperatures(samples.lost, samples.temperature_c)
            self.advanced = True

    def _restart_changed_axes(self) -> None:
        restarts = (
            self.motion_and_change_monitor.take_restart_requests() if self.motion_and_change_monitor is not None else []
        )
        if self.estimator is None or self._replaying:
            return
        for restart in restarts:
            at_ns = self.newest_ns - round((restart.samples - 0.5) / self.estimator.rate_hz * 1e9)
            if self._device.restart:
                self.estimator.restart_axis(restart.axis, restart.samples)
                self.since_ns[restart.axis] = at_ns
            else:
                self._changed_ns[restart.axis] = at_ns

    def _update_thermal(self) -> None:
        if self.motion_and_change_monitor is None or self.thermal is None:
            return
        if self.motion_and_change_monitor.orientation_changes != self._handled:
            self._handled = self.motion_and_change_monitor.orientation_changes
            self.thermal.learn_new_offset()
        for samples in self.motion_and_change_monitor.take_samples_with_motion_masked():
            self._thermal_intervals += self.thermal.process_block(samples)
