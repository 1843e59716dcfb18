"""Output of the daemon that publishes results as zenoh messages.

``monitor.publishing.result_kinds`` lists the messages and drawings of each kind of result.
"""

from typing import Any

from drivers.data_types import Event, Ints, SampleBlock
from drivers.zenoh.sample_message import encode_samples
from monitor.common import topics
from monitor.common.device_health import Health
from monitor.daemon.outputs.output import Output
from monitor.publishing.result_kinds import kind_of
from monitor.publishing.zenoh.publisher import ZenohPublisher
from monitor.settings.loading import Device


class ZenohOutput(Output):
    """Output that publishes the results as zenoh messages."""

    name = "zenoh"

    def __init__(self, zenoh: ZenohPublisher) -> None:
        self._zenoh = zenoh

    def publish_samples(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """Publish a block of samples as one msgpack message."""
        self._zenoh.put(topics.SAMPLES, device, encode_samples(device, received, samples, offset_ns))

    def publish_drift_compensated_samples(
        self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int
    ) -> None:
        """Publish a block of compensated samples as one msgpack message."""
        schema = topics.COMPENSATED.schema_name()
        self._zenoh.put(topics.COMPENSATED, device, encode_samples(device, received, samples, offset_ns, schema))

    def publish_result(self, device: str, unix_s: float, received: int, result: Any) -> None:
        """Publish a result as JSON messages."""
        self._publish_messages(device, unix_s, received, result)

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Publish an event as a JSON message."""
        self._publish_messages(device, unix_s, received, event)

    def publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Publish the status as a JSON message."""
        self._publish_messages(device, unix_s, health.received, health)

    def set_alive(self, device: str, samples_arrive: bool) -> None:
        """Declare or remove the liveliness token of a device."""
        self._zenoh.set_alive(device, samples_arrive)

    def add_device(self, device: Device) -> None:
        """Declare the zenoh keys of a device."""
        self._zenoh.add_device(device.name)

    def remove_device(self, device: str) -> None:
        """Remove the zenoh keys of a device."""
        self._zenoh.remove_device(device)

    def _publish_messages(self, device: str, unix_s: float | None, received: int, result: Any) -> None:
        for message in kind_of(result).messages:
            self._zenoh.put(message.topic, device, message.from_result(device, unix_s, received, result).encode())
