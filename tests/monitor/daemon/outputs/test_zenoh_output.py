"""Test the output that publishes results as zenoh messages."""

from typing import Any, Final

import numpy as np

from drivers.data_types import Event, make_block
from monitor.daemon.outputs.zenoh_output import ZenohOutput

SAMPLES: Final = make_block(np.array([1_000_000_000]), np.zeros((1, 6)))


class RecordingPublisher:
    """Publisher that stores the topic and device of each sent message, and changes of the liveliness tokens."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, str]] = []

    def put(self, topic: Any, device: str, payload: bytes) -> None:
        assert payload
        self.sent.append((topic.name, device))

    def set_alive(self, device: str, samples_arrive: bool) -> None:
        self.sent.append(("alive" if samples_arrive else "silent", device))


def test_messages_of_one_device_are_sent_together_and_in_order() -> None:
    publisher: Any = RecordingPublisher()
    output = ZenohOutput(publisher)
    for device in ("first", "second"):
        output.publish_samples(device, 1, SAMPLES, 0)
        output.publish_event(device, 1.0, 1, Event("link_lost", 1, "unplugged"))
    first = [("samples", "first"), ("event", "first")]
    assert publisher.sent == first  # the messages of the second device wait
    output.finish_round()
    output.finish_round()
    assert publisher.sent == [*first, ("samples", "second"), ("event", "second")]


def test_a_liveliness_token_changes_after_the_messages_before_it() -> None:
    publisher: Any = RecordingPublisher()
    output = ZenohOutput(publisher)
    output.publish_samples("imu", 1, SAMPLES, 0)
    output.set_alive("imu", samples_arrive=False)
    assert publisher.sent == [("samples", "imu"), ("silent", "imu")]
