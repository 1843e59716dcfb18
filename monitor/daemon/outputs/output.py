"""Base class of the receivers of the results: zenoh, viewer, history, log, table, metrics, InfluxDB, ROS 2, hooks."""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

from drivers.data_types import Event, Ints, SampleBlock
from monitor.common.device_health import Health
from monitor.common.unexpected_errors import RecentFailure
from monitor.settings.loading import Device


class Output:
    """Receiver of the results of all devices. Subclasses override methods, which must not block.

    All times are on the timeline of the samples. For a recording, the timeline may differ from the host clock by years,
    and the present time is unknown before the first sample.

    Parameters
    ----------
    device : str
        Name of the device.
    unix_s : float
        Unix time of the result in seconds.
    received : int
        Number of samples that the device has received since the start.
    samples : SampleBlock
        Samples in SI units.
    offset_ns : array of int64, shape (n,), or int
        Offset that converts the times of the samples to Unix time, in nanoseconds.
    """

    name = "other"
    """Name of the output in the status."""

    @cached_property
    def failure(self) -> RecentFailure:
        """Unexpected exception of the output."""
        return RecentFailure()

    def publish_samples(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """Publish a block of samples."""

    def publish_drift_compensated_samples(
        self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int
    ) -> None:
        """Publish a block of samples after compensation of the gyroscope drift."""

    def publish_result(self, device: str, unix_s: float, received: int, result: Any) -> None:
        """Publish a result of one of the kinds in ``monitor.publishing.result_kinds``."""

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Publish an event of the device."""

    def publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Publish the status of the device once a second; ``unix_s`` is None if the present time is unknown."""

    def set_alive(self, device: str, samples_arrive: bool) -> None:
        """Publish a notification that samples of a device have started or stopped arriving."""

    def set_viewer_url(self, url: str) -> None:
        """Show the URL of the web viewer, or remove the URL if it is ""."""

    def finish_round(self) -> None:
        """Send the results of one round of the main loop, if they have been collected."""

    def add_device(self, device: Device) -> None:
        """Add a device that was added to the configuration."""

    def remove_device(self, device: str) -> None:
        """Remove the data of a device that was removed from the configuration."""


def call_outputs(outputs: Sequence[Output], method: str, *arguments: Any) -> None:
    """Call a method of all outputs. An unexpected exception in one output does not affect the others.

    Parameters
    ----------
    outputs : sequence of Output
        Receivers of the call.
    method : str
        Name of the method.
    *arguments
        Arguments of the method.
    """
    for output in outputs:
        try:
            getattr(output, method)(*arguments)
        except Exception as error:  # noqa: BLE001 - the status of the output shows the error
            output.failure.note(f"output {output.name}", error)
