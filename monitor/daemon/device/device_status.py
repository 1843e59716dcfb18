"""Status report of one device, with sample counts, latency, and a message about a problem."""

import time
from typing import TYPE_CHECKING

from drivers.secret_masking import mask_secrets
from monitor.common.device_health import Health
from monitor.daemon.device.latency_meter import LatencyMeter

if TYPE_CHECKING:
    from monitor.daemon.device.device_worker import DeviceWorker


class DeviceStatus:
    """Status report of one device.

    Parameters
    ----------
    worker : DeviceWorker
        Worker of the device.
    """

    def __init__(self, worker: "DeviceWorker") -> None:
        self.latency = LatencyMeter()
        self._worker = worker
        self._started_s = time.monotonic()

    def build_health(self, states: dict[str, str], memory_bytes: int) -> Health:
        """Return the current status of the device.

        Parameters
        ----------
        states : dict of str to str
            State of each output of the service, by name.
        memory_bytes : int
            Resident memory of the process.
        """
        worker, driver, clock = self._worker, self._worker.driver, self._worker.clock
        motion_and_change_monitor = worker.pipeline.motion_and_change_monitor
        median_s, high_s = self.latency.take_latency_quantiles()
        return Health(
            state=driver.state,
            rate_hz=clock.measured_hz if driver.state == "running" else None,
            received=driver.counts.received,
            lost=driver.counts.lost,
            bad=driver.counts.bad,
            overflowed=worker.ring.overflowed,
            latency_p50_s=median_s,
            latency_p99_s=high_s,
            memory_bytes=memory_bytes,
            outputs=dict(states),
            text=mask_secrets(self._text()),
            uptime_s=time.monotonic() - self._started_s,
            repeated=clock.dropped_repeated_rows,
            late=clock.dropped_late_rows + driver.counts.late,
            moving=motion_and_change_monitor is not None and motion_and_change_monitor.is_moving,
            moved=motion_and_change_monitor.samples_in_motion if motion_and_change_monitor is not None else 0,
            crossed=worker.publisher.limits.coefficients_beyond_limits,
            loss=worker.loss_of_samples(),
        )

    def build_health_of_failed_device(self, states: dict[str, str], memory_bytes: int) -> Health:
        """Return the status of a device whose estimation has failed, from the counts of the reader only."""
        driver = self._worker.driver
        counts, uptime_s = driver.counts, time.monotonic() - self._started_s
        return Health(
            state=driver.state,
            rate_hz=None,
            received=counts.received,
            lost=counts.lost,
            bad=counts.bad,
            overflowed=self._worker.ring.overflowed,
            latency_p50_s=None,
            latency_p99_s=None,
            memory_bytes=memory_bytes,
            outputs=dict(states),
            text=f"{self._worker.failure}; the estimation is being started again",
            uptime_s=uptime_s,
        )

    def _text(self) -> str:
        """Return the status message of the device, or "" if there is no problem."""
        worker, driver, ready = self._worker, self._worker.driver, self._worker.pipeline.ready
        if driver.state == "running":
            if worker.restore.active and ready.all.is_set():
                return "the window is being rebuilt from the recording; no sample is lost"
            if ready.progress:
                lacking = "" if worker.pipeline.fit_kernels_can_run else "no coefficients yet, "
                return f"{ready.progress}; {lacking}no sample is lost"
            if not worker.pipeline.fit_kernels_can_run:
                return "compiling the estimator; no coefficients yet, no sample is lost"
        about = self._estimate_text() if driver.state in ("running", "ended") else ""
        if driver.text or driver.state != "running":
            return f"{driver.text.rstrip('.')}; {about}" if about else driver.text
        offset_text = worker.timeline.host_clock_offset_text()
        return about or driver.late_frames_hint or offset_text or driver.on_board_filter_note

    def _estimate_text(self) -> str:
        """Return the reason why coefficients cannot be estimated or do not describe one noise, or ""."""
        worker, clock = self._worker, self._worker.clock
        measured_hz = clock.contradicting_rate_hz
        if measured_hz is not None:
            return (
                f"measured rate {measured_hz:.4g} Hz differs from the configured "
                f"{worker.device.rate_hz:g} Hz; coefficients are withheld: correct `rate` or remove it"
            )
        if (
            worker.pipeline.estimator is None
            and worker.publisher.published
            and clock.configured_or_measured_rate_hz is None
        ):
            return "no estimate: the times of the samples do not show a rate; set `rate`"
        return worker.pipeline.refusal_reason or worker.pipeline.mixed_noise_text()
