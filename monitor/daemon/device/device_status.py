"""Status report of one device, with sample counts, latency, and a message about a problem."""

import time

from drivers.secret_masking import mask_secrets
from monitor.common.device_health import Health
from monitor.daemon.device.latency_meter import LatencyMeter
from monitor.daemon.device.ring_buffer import RingBuffer
from monitor.daemon.device.window_restore import WindowRestore
from monitor.daemon.result_publisher import ResultPublisher


class DeviceStatus:
    """Status report of one device.

    Parameters
    ----------
    publisher : ResultPublisher
        Publisher of the results, with the driver, the pipeline and the user limits.
    ring : RingBuffer
        Ring buffer of the device.
    restore : WindowRestore
        Restore of the window after a restart of the program.
    """

    def __init__(self, publisher: ResultPublisher, ring: RingBuffer, restore: WindowRestore) -> None:
        self.latency = LatencyMeter()
        self._publisher = publisher
        self._driver = publisher.driver
        self._pipeline = publisher.pipeline
        self._ring = ring
        self._restore = restore
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
        driver, clock, motion_and_change_monitor = (
            self._driver,
            self._driver.clock,
            self._pipeline.motion_and_change_monitor,
        )
        median_s, high_s = self.latency.take_latency_quantiles()
        return Health(
            state=driver.state,
            rate_hz=clock.measured_hz if driver.state == "running" else None,
            received=driver.counts.received,
            lost=driver.counts.lost,
            bad=driver.counts.bad,
            overflowed=self._ring.overflowed,
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
            crossed=self._publisher.limits.coefficients_beyond_limits,
        )

    def _text(self) -> str:
        """Return the status message of the device, or "" if there is no problem."""
        driver, ready = self._driver, self._pipeline.ready
        if driver.state == "running":
            if self._restore.active and ready.all.is_set():
                return "the window is being rebuilt from the recording; no sample is lost"
            if ready.progress:
                lacking = "" if self._pipeline.fit_kernels_can_run else "no coefficients yet, "
                return f"{ready.progress}; {lacking}no sample is lost"
            if not self._pipeline.fit_kernels_can_run:
                return "compiling the estimator; no coefficients yet, no sample is lost"
        lacking = self._missing_estimate_text() if driver.state in ("running", "ended") else ""
        if driver.text or driver.state != "running":
            return f"{driver.text.rstrip('.')}; {lacking}" if lacking else driver.text
        offset_text = self._publisher.timeline.host_clock_offset_text()
        return lacking or driver.late_frames_hint or offset_text or driver.on_board_filter_note

    def _missing_estimate_text(self) -> str:
        """Return the reason why coefficients cannot be estimated, or ""."""
        clock = self._driver.clock
        measured_hz = clock.contradicting_rate_hz
        if measured_hz is not None:
            return (
                f"measured rate {measured_hz:.4g} Hz differs from the configured "
                f"{self._publisher.device.rate_hz:g} Hz; coefficients are withheld: correct `rate` or remove it"
            )
        if (
            self._pipeline.estimator is None
            and self._publisher.published
            and clock.configured_or_measured_rate_hz is None
        ):
            return "no estimate: the times of the samples do not show a rate; set `rate`"
        return self._pipeline.refusal_reason
