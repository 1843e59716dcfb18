"""Base class of the receivers of the results: zenoh, viewer, history, log, table, metrics and hooks."""

from drivers.sample import Event, Ints, SampleBlock
from monitor.common.health import Health
from monitor.drift.compensation.live_compensation import DriftUpdate
from monitor.drift.thermal.live_thermal import ThermalUpdate
from monitor.estimation.allan.hadamard import HadamardCurve
from monitor.estimation.allan.total import TotalCurve
from monitor.estimation.detection.model_gap import ModelGap
from monitor.estimation.estimate import Estimate


class Output:
    """Receiver of the results of the devices; a subclass overrides the methods for the results that it uses.

    No method may block. Every ``unix_s`` is a time in seconds on the timeline of the device's own samples. A recording,
    or a device that stamps its samples itself, may be years away from the host clock, so its timeline is unknown before
    its first sample. Until then no event is passed on, and ``health`` receives None as time.

    Several methods have the same parameters. ``device`` is the name of the device. ``received`` is the number of
    samples of the device since the start, up to the result.
    """

    def samples(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
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

    def estimate(self, device: str, unix_s: float, estimate: Estimate) -> None:
        """Receive a new estimate.

        Parameters
        ----------
        device : str
            Name of the device.
        unix_s : float
            Time of the newest sample in the window.
        estimate : Estimate
            Allan curve and noise coefficients.
        """

    def model_gap(self, device: str, unix_s: float, gap: ModelGap) -> None:
        """Receive the comparison of the window with the model in force. Not called for a device without a model.

        Parameters
        ----------
        device : str
            Name of the device.
        unix_s : float
            Time of the newest sample in the window.
        gap : ModelGap
            Comparison of the window with the model.
        """

    def thermal(self, device: str, unix_s: float, received: int, look: ThermalUpdate) -> None:
        """Receive the mean of an interval and its prediction from temperature. Not called without a thermal model.

        Parameters
        ----------
        device : str
            Name of the device.
        unix_s : float
            Time of the interval.
        received : int
            Number of samples of the device since the start.
        look : ThermalUpdate
            Mean of the interval and its prediction.
        """

    def compensated(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
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

    def drift(self, device: str, unix_s: float, look: DriftUpdate) -> None:
        """Receive the state of the drift compensation after an interval of one second.

        Parameters
        ----------
        device : str
            Name of the device.
        unix_s : float
            Time of the interval.
        look : DriftUpdate
            Drift, innovations and models.
        """

    def total(self, device: str, unix_s: float, received: int, total: TotalCurve, hadamard: HadamardCurve) -> None:
        """Receive the total and Hadamard deviations, which are computed step by step and published when complete.

        Parameters
        ----------
        device : str
            Name of the device.
        unix_s : float
            Time of the newest sample.
        received : int
            Number of samples of the device since the start.
        total : TotalCurve
            Total deviations.
        hadamard : HadamardCurve
            Hadamard deviations.
        """

    def event(self, device: str, unix_s: float, received: int, event: Event) -> None:
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

    def health(self, device: str, unix_s: float | None, health: Health) -> None:
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

    def device_removed(self, device: str) -> None:
        """Forget a device that was removed from the configuration. A device with the same name may be added later."""
