"""Names of the ROS 2 graph in rmw_zenoh: topics, zenoh keys, and liveliness tokens of a node and its publishers.

The layout of the tokens is in ``liveliness_utils.cpp`` of ros2/rmw_zenoh. In a token, ``%`` replaces each slash of a
name.
"""

from dataclasses import dataclass
from typing import Final, Literal

from monitor.settings.ros2_table import ros_name

NODE: Final = "imu_monitor"
NODE_ID: Final = 0
ENCLAVE: Final = "/"
QOS: Final = "::,10:,:,:,,"
"""Quality of service as encoded in a token: reliable, volatile, the last 10 messages. A field is empty if its value is
the default."""


@dataclass(frozen=True, slots=True)
class MessageType:
    """Type of a ROS 2 message."""

    name: str  # as in DDS
    type_hash: str  # REP 2011; the same in Jazzy and later releases


IMU: Final = MessageType(
    "sensor_msgs::msg::dds_::Imu_", "RIHS01_7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b"
)
DIAGNOSTIC_ARRAY: Final = MessageType(
    "diagnostic_msgs::msg::dds_::DiagnosticArray_",
    "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
)


@dataclass(frozen=True, slots=True)
class RosTopic:
    """Topic of ROS 2."""

    name: str  # begins with a slash
    message_type: MessageType

    def zenoh_key(self, domain: int) -> str:
        """Return the zenoh key on which the messages of the topic are published."""
        return f"{domain}{self.name}/{self.message_type.name}/{self.message_type.type_hash}"


DIAGNOSTICS: Final = RosTopic("/diagnostics", DIAGNOSTIC_ARRAY)


def imu_topic(namespace: str, device: str, kind: Literal["raw", "compensated"]) -> RosTopic:
    """Return the topic of the samples of a device.

    REP 145 defines ``imu/data_raw`` for samples as received. It reserves ``imu/data`` for messages with an orientation,
    which the messages of this program do not contain.

    Parameters
    ----------
    namespace
        Namespace of the node, such as "/robot1", or "/".
    device
        Name of the device.
    kind
        Samples as received, or without gyroscope drift.
    """
    return RosTopic(f"{namespace.rstrip('/')}/{ros_name(device)}/imu/data_{kind}", IMU)


def node_token(domain: int, session_id: str, namespace: str) -> str:
    """Return the liveliness token of the node.

    Parameters
    ----------
    domain
        Domain of ROS 2.
    session_id
        Identifier of the zenoh session.
    namespace
        Namespace of the node, such as "/robot1", or "/".
    """
    return _token(domain, session_id, NODE_ID, "NN", namespace)


def publisher_token(domain: int, session_id: str, namespace: str, publisher_id: int, topic: RosTopic) -> str:
    """Return the liveliness token of a publisher. The other parameters are those of ``node_token``.

    Parameters
    ----------
    publisher_id
        Number of the publisher, unique in the session and different from NODE_ID.
    topic
        Topic of the publisher.
    """
    owner = _token(domain, session_id, publisher_id, "MP", namespace)
    return f"{owner}/{_without_slashes(topic.name)}/{topic.message_type.name}/{topic.message_type.type_hash}/{QOS}"


def _token(domain: int, session_id: str, entity_id: int, kind: str, namespace: str) -> str:
    names = f"{_without_slashes(ENCLAVE)}/{_without_slashes(namespace)}/{NODE}"
    return f"@ros2_lv/{domain}/{session_id}/{NODE_ID}/{entity_id}/{kind}/{names}"


def _without_slashes(name: str) -> str:
    return name.replace("/", "%")
