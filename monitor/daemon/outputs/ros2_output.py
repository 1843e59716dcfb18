"""Output of the daemon that publishes diagnostics and samples for ROS 2, if ``[ros2] domain`` is set."""

import time
from collections.abc import Sequence
from functools import partial

import numpy as np

from drivers.data_types import Event, Floats, Ints, SampleBlock
from drivers.zenoh.ros2_imu_message import UNKNOWN_VARIANCES, encode_imu_messages
from monitor.daemon.outputs.newest_metrics import NewestMetrics
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS
from monitor.publishing.ros2.diagnostics import build_device_status, encode_diagnostic_array
from monitor.publishing.ros2.publisher import Ros2Publisher
from monitor.publishing.ros2.rmw_zenoh_names import DIAGNOSTICS, RosTopic, imu_topic
from monitor.settings.loading import Device, Ros2Table


class Ros2Output(NewestMetrics):
    """Output that publishes the status of all devices once a second, and their samples.

    Parameters
    ----------
    settings : Ros2Table
        Settings of the output.
    devices : sequence of Device
        Settings of the devices.
    """

    name = "ros2"

    def __init__(self, settings: Ros2Table, devices: Sequence[Device]) -> None:
        super().__init__()
        assert settings.domain is not None
        self._settings = settings
        self._publisher = Ros2Publisher(settings.connect, settings.domain, settings.namespace)
        self._publisher.add_topic(DIAGNOSTICS)
        self._imu_topics: dict[str, RosTopic] = {}
        self._frame_ids: dict[str, str] = {}
        self._last_events: dict[str, tuple[Event, float]] = {}  # with the Unix time in seconds
        for device in devices:
            self.add_device(device)

    @property
    def state(self) -> str:
        """Status message: ``ok``, or a description of the problem."""
        return self._publisher.state

    def start(self) -> None:
        """Start the thread that sends the messages."""
        self._publisher.start()

    def close(self) -> None:
        """Send the queued messages and close the session."""
        self._publisher.close()

    def add_device(self, device: Device) -> None:
        """Add a device and its topic."""
        self._frame_ids[device.name] = device.frame_id
        if self._settings.imu != "none":
            self._imu_topics[device.name] = imu_topic(self._settings.namespace, device.name, self._settings.imu)
            self._publisher.add_topic(self._imu_topics[device.name])

    def remove_device(self, device: str) -> None:
        """Remove a device and its topic."""
        super().remove_device(device)
        self._last_events.pop(device, None)
        self._frame_ids.pop(device, None)
        if device in self._imu_topics:
            self._publisher.remove_topic(self._imu_topics.pop(device))

    def publish_samples(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """Publish samples as received, if this is configured."""
        if self._settings.imu == "raw":
            self._publish_imu(device, samples, offset_ns)

    def publish_drift_compensated_samples(
        self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int
    ) -> None:
        """Publish samples without gyroscope drift, if this is configured."""
        if self._settings.imu == "compensated":
            self._publish_imu(device, samples, offset_ns)

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Store the newest event of a device."""
        self._last_events[device] = event, unix_s

    def publish_diagnostics(self) -> None:
        """Publish the newest status of all devices as one message."""
        statuses = []
        for device, newest in self._healths.items():
            found = self._estimates.get(device)
            event, event_s = self._last_events.get(device, (None, 0.0))
            coefficients = None if found is None else found.estimate.coefficients
            statuses.append(build_device_status(device, newest.health, coefficients, event, event_s))
        self._publisher.publish(DIAGNOSTICS, 1, lambda: [encode_diagnostic_array(time.time_ns(), statuses)])

    def _publish_imu(self, device: str, samples: SampleBlock, offset_ns: Ints | int) -> None:
        found = self._estimates.get(device)
        variances = UNKNOWN_VARIANCES if found is None else white_noise_variances(found.estimate)
        if self._settings.imu == "compensated":  # their noise is not white and depends on the motion
            variances = np.concatenate((UNKNOWN_VARIANCES[:3], variances[3:]))
        encode = partial(
            encode_imu_messages, samples.t_ns + offset_ns, samples.values, self._frame_ids[device], variances
        )
        self._publisher.publish(self._imu_topics[device], len(samples), encode)


def white_noise_variances(estimate: Estimate) -> Floats:
    """Return the variances of the white noise of the received samples [6], in rad²/s² and m²/s⁴.

    The Allan variance of white noise at the sample period T is its variance, N² / T (IEEE Std 952, angle random walk).
    The variances of a sensor are 0, which means unknown in ROS, until N is estimated on its three axes. Otherwise, a
    filter could take an axis with the variance 0 for an axis without noise.
    """
    variances = (estimate.coefficients.value[SYMBOLS.index("N")] ** 2 * estimate.rate_hz).reshape(2, 3)
    return np.where(np.isfinite(variances).all(axis=1, keepdims=True), variances, 0.0).reshape(6)
