"""Publication of the results of one device to all outputs.

The main loop calls the outputs, which must not block.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from drivers.data_types import Event, SampleBlock, merge_contiguous_blocks
from drivers.driver import Driver
from drivers.errors import NotReady
from drivers.secret_masking import mask_secrets
from monitor.daemon.device.pipeline import DevicePipeline
from monitor.daemon.device.unix_timeline import DeviceTimeline
from monitor.daemon.operations.coefficient_limits import LimitMonitor
from monitor.daemon.outputs.output import Output, call_outputs
from monitor.daemon.schedule import Schedule
from monitor.drift.compensation.live_compensation import LiveDriftCompensation
from monitor.estimation.detection.comparison_with_noise_model import ModelAgreementMonitor, ModelComparison
from monitor.estimation.estimate import Estimate
from monitor.publishing.messages.results import TotalAndHadamardCurves
from monitor.settings.loading import Device

MAX_BATCH_S: Final = 0.1
"""Maximum duration of a batch of samples in seconds."""
TOTAL_INTERVAL_S: Final = 0.1
"""Minimum interval between two steps of the total and Hadamard deviations."""
TOTAL_CPU_SHARE: Final = 0.002
"""Maximum fraction of one processor that is spent on the total and Hadamard deviations of a device."""
INTERPRETED_REFIT_S: Final = 1.0
"""Minimum interval between two fits with interpreted kernels."""


class ResultPublisher:
    """Publisher of the results of one device.

    Parameters
    ----------
    device : Device
        Settings of the device.
    driver : Driver
        Driver of the device.
    timeline : DeviceTimeline
        Timeline of the samples.
    pipeline : DevicePipeline
        Pipeline that computes the results.
    limits : LimitMonitor
        User limits on the coefficients.
    outputs : sequence of Output
        Receivers of the results.
    """

    def __init__(
        self,
        device: Device,
        driver: Driver,
        timeline: DeviceTimeline,
        pipeline: DevicePipeline,
        limits: LimitMonitor,
        outputs: Sequence[Output],
    ) -> None:
        self.device = device
        self.driver = driver
        self.timeline = timeline
        self.pipeline = pipeline
        self.limits = limits
        self.outputs = outputs
        self.schedule = Schedule()
        self.latest: Estimate | None = None
        self.published = 0
        """Number of published samples."""
        self.withholds_coefficients = False
        """True while coefficients are withheld because the sample rate is uncertain."""
        self._agreement = ModelAgreementMonitor()
        self._batch: list[SampleBlock] = []  # samples that are not published yet
        self._refitted = False  # True if the fit has been updated since the last publication

    def publish_events(self, events: Sequence[Event]) -> None:
        """Publish events to all outputs."""
        for event in events:
            unix_s = self.timeline.to_unix_s(event.t_ns)
            masked = replace(event, text=mask_secrets(event.text))
            call_outputs(self.outputs, "publish_event", self.device.name, unix_s, self._received, masked)

    def batch_samples_and_publish_if_due(self, blocks: Sequence[SampleBlock]) -> bool:
        """Add samples to the batch, and publish the batch if it is due; return True if it was published."""
        self._batch += blocks
        interval_s = min(self.device.publish_s, MAX_BATCH_S)
        if not self._batch or not self.schedule.claim_if_due("samples", interval_s):
            return False
        batch, self._batch = self._batch, []
        compensation = self.pipeline.compensation
        for samples in merge_contiguous_blocks(batch):
            self.published += len(samples)
            offsets_ns = self.timeline.unix_offsets_ns(samples)
            call_outputs(self.outputs, "publish_samples", self.device.name, self.published, samples, offsets_ns)
            if compensation is not None and np.isfinite(samples.values[:, :3]).any():
                self._compensated(compensation, samples)
        return True

    def publish_estimate_if_due(self) -> bool:
        """Update the fit and publish the estimate if they are due; return True if the estimate was published."""
        self._refit()
        if (
            self.latest is None
            or not self._refitted
            or not self.schedule.claim_if_due("publish", self.device.publish_s)
        ):
            return False
        self._refitted = False
        self._result(self.latest.t_ns, self.latest)
        if self.pipeline.noise_model_comparator is not None:
            self._model_gap(self.pipeline.noise_model_comparator.compare_with_estimate(self.latest))
        self.publish_events(self.limits.check_estimate(self.latest))
        return True

    def advance_total_and_hadamard(self) -> None:
        """Compute one step of the total and Hadamard deviations, and publish the completed deviations."""
        estimator = self.pipeline.estimator
        if estimator is None or not self.pipeline.ready.all.is_set() or not self.schedule.is_due("total"):
            return
        begun_s = time.perf_counter()
        deviations = estimator.step_slow_statistics()
        used_s = time.perf_counter() - begun_s
        self.schedule.postpone("total", max(TOTAL_INTERVAL_S, used_s / TOTAL_CPU_SHARE))
        if deviations is not None:
            self._result(self.pipeline.newest_ns, TotalAndHadamardCurves(*deviations))

    def publish_thermal_intervals(self) -> None:
        """Publish the thermal intervals that have been completed since the last call."""
        for interval in self.pipeline.take_thermal_intervals():
            self._result(interval.t_ns, interval)

    @property
    def _received(self) -> int:
        return self.driver.counts.received

    def _result(self, t_ns: int, result: Any) -> None:
        unix_s = self.timeline.to_unix_s(t_ns)
        call_outputs(self.outputs, "publish_result", self.device.name, unix_s, self._received, result)

    def _compensated(self, live: LiveDriftCompensation, samples: SampleBlock) -> None:
        """Publish samples after drift compensation, and the state of the drift compensation."""
        at = 0
        while at < len(samples):
            piece = samples[at : at + live.compensator.samples_to_interval_end]
            at += len(piece)
            compensated = live.compensate_block(piece)
            self.pipeline.adopt_and_identify_drift_models()
            offsets_ns = self.timeline.unix_offsets_ns(compensated)
            call_outputs(
                self.outputs,
                "publish_drift_compensated_samples",
                self.device.name,
                self.published - len(samples) + at,
                compensated,
                offsets_ns,
            )
        for drift in live.take_drift_updates():
            self._result(drift.t_ns, drift)

    def _refit(self) -> None:
        # with a refit at every sample, ``get`` empties the history, so ``get`` is only called for a publication
        interval_s = self.device.refit_s or self.device.publish_s
        pipeline = self.pipeline
        if pipeline.estimator is None or not pipeline.advanced or not self.schedule.claim_if_due("refit", interval_s):
            return
        fitted = pipeline.fit_kernels_can_run
        pipeline.advanced = not fitted  # the curve is fitted as soon as the kernels are ready
        try:
            latest = pipeline.estimator.get_estimate(fit_coefficients=fitted)
        except NotReady:
            return
        if pipeline.fit_kernels_run_uncompiled:
            self.schedule.postpone("refit", INTERPRETED_REFIT_S)
        if pipeline.thermal is not None:
            latest = replace(latest, temperature_shares=pipeline.thermal.temperature_shares)
        self.latest = latest.without_coefficients() if self.withholds_coefficients else latest
        self._refitted = True

    def _model_gap(self, gap: ModelComparison) -> None:
        if self.withholds_coefficients:
            gap = replace(gap, axes={})
        events = self._agreement.update_decisions(gap)
        gap = replace(gap, agrees=self._agreement.agreement_by_axis)
        self._result(gap.t_ns, gap)
        self.publish_events(events)
