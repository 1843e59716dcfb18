"""Base class of the receivers of the results: zenoh, viewer, history, log, table, metrics and hooks."""

from typing import Any

from drivers.data_types import Event, Ints, SampleBlock
from monitor.common.device_health import Health


class Output:
    """Receiver of the results of the devices. A subclass overrides the methods for the results that it publishes.

    No method may block. All times are on the timeline of the samples of the device. The samples of a recording, or of a
    device with its own time stamps, may be years away from the host clock, so this timeline is unknown before the first
    sample. Until then, no event is published.

    Parameters
    ----------
    device : str
        Parameter of all methods: name of the device.
    unix_s : float
        Parameter of most methods: Unix time of the result in seconds.
    received : int
        Parameter of most methods: number of samples of the device up to the result, since the start.
    samples : SampleBlock
        Parameter of two methods: samples in SI units, with times in nanoseconds.
    offset_ns : array of int64, shape (n,), or int
        Parameter of two methods: difference of Unix time and the times of the samples, in nanoseconds.
    """

    def publish_samples(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """Publish a block of samples."""

    def publish_compensated_samples(
        self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int
    ) -> None:
        """Publish a block of samples without the drift of the gyroscopes."""

    def publish_result(self, device: str, unix_s: float, received: int, result: Any) -> None:
        """Publish a result of one of the kinds in ``monitor.publishing.result_kinds``.

        ``unix_s`` is the time of the newest sample in the window, or of the end of the interval of the result.
        """

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Publish an event of the device."""

    def publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Publish the status of the device, once a second.

        ``unix_s`` is the present time on the timeline of the samples; None while this timeline is unknown.
        """

    def remove_device(self, device: str) -> None:
        """Remove the data of a device that is no longer configured. A device with the same name may be added later."""
