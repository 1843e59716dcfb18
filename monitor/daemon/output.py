"""Base class of the receivers of the results: zenoh, viewer, history, log, table, metrics and hooks."""

from typing import Any

from drivers.sample import Event, Ints, SampleBlock
from monitor.common.health import Health


class Output:
    """Receiver of the results of the devices; a subclass overrides the methods for the results that it uses.

    No method may block. Every ``unix_s`` is a time in seconds on the timeline of the device's own samples. A recording,
    or a device that stamps its samples itself, may be years away from the host clock, so its timeline is unknown before
    its first sample. Until then no event is passed on, and ``health`` receives None as time.

    Several methods have the same parameters. ``device`` is the name of the device. ``received`` is the number of
    samples of the device since the start, up to the result.
    """

    def publish_samples(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
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

    def publish_result(self, device: str, unix_s: float, received: int, result: Any) -> None:
        """Receive a result of one of the kinds in ``monitor.publishing.result_kinds``.

        Estimates arrive at the configured rate. A device without a model in force has no ``ModelGap``, and a device
        without a thermal model has no ``ThermalIntervalResult``. A ``DriftUpdate`` arrives every second of drift
        compensation.
        ``SlowStatistics`` arrive when their step by step computation is complete.

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

    def publish_compensated_samples(
        self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int
    ) -> None:
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

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
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

    def publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
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

    def remove_device(self, device: str) -> None:
        """Forget a device that was removed from the configuration. A device with the same name may be added later."""
