"""Tests of the zenoh keys and liveliness tokens of ROS 2, parsed by the layout that rmw_zenoh documents."""

from dataclasses import dataclass

import pytest
from rosbags.typesys import get_typestore

from monitor.publishing.ros2 import rmw_zenoh_names
from monitor.publishing.ros2.rmw_zenoh_names import DIAGNOSTICS, RosTopic, imu_topic, node_token, publisher_token
from tests.support import ros2_messages

SESSION = "8a1f2c"


@dataclass(frozen=True)
class Token:
    """Fields of a liveliness token."""

    domain: int
    session_id: str
    node_id: int
    entity_id: int
    kind: str
    enclave: str
    namespace: str
    node: str
    endpoint: tuple[str, ...]  # topic, type, type hash and quality of service; empty for a node


def parse_token(text: str) -> Token:
    """Parse a token as ``Entity::make`` of rmw_zenoh does, which refuses empty parts."""
    root, domain, session_id, node_id, entity_id, kind, *names = text.split("/")
    assert root == "@ros2_lv"
    assert all(names)
    enclave, namespace, node, *endpoint = (name.replace("%", "/") for name in names)
    return Token(int(domain), session_id, int(node_id), int(entity_id), kind, enclave, namespace, node, tuple(endpoint))


def parse_qos(text: str) -> dict[str, int]:
    """Parse the quality of service as ``keyexpr_to_qos`` of rmw_zenoh does; 0 is the default of a field."""
    reliability, durability, history, deadline, lifespan, liveliness = text.split(":")
    kind, depth = history.split(",")
    texts = {"reliability": reliability, "durability": durability, "history": kind, "depth": depth}
    texts |= {f"deadline {i}": part for i, part in enumerate(deadline.split(","))}
    texts |= {f"lifespan {i}": part for i, part in enumerate(lifespan.split(","))}
    texts |= {f"liveliness {i}": part for i, part in enumerate(liveliness.split(","))}
    return {name: int(part or 0) for name, part in texts.items()}


@pytest.mark.parametrize("store", ros2_messages.STORES, ids=lambda store: store.value)
def test_type_hashes_are_those_of_the_release(store: object) -> None:
    types = get_typestore(store)
    for known, name in (
        (rmw_zenoh_names.IMU, ros2_messages.IMU),
        (rmw_zenoh_names.DIAGNOSTIC_ARRAY, ros2_messages.DIAGNOSTIC_ARRAY),
    ):
        package, _, message = name.split("/")
        assert known.name == f"{package}::msg::dds_::{message}_"
        assert known.type_hash == types.hash_rihs01(name)


@pytest.mark.parametrize(
    ("namespace", "name"), [("/", "/bench_1/imu/data_raw"), ("/robot1/arm", "/robot1/arm/bench_1/imu/data_raw")]
)
def test_topic_and_key_of_the_samples(namespace: str, name: str) -> None:
    topic = imu_topic(namespace, "bench-1", "raw")
    assert topic.name == name
    assert topic.zenoh_key(7) == f"7{name}/sensor_msgs::msg::dds_::Imu_/{rmw_zenoh_names.IMU.type_hash}"


@pytest.mark.parametrize("namespace", ["/", "/robot1", "/robot1/arm"])
def test_node_token(namespace: str) -> None:
    found = parse_token(node_token(7, SESSION, namespace))
    assert found == Token(7, SESSION, 0, 0, "NN", "/", namespace, "imu_monitor", ())


@pytest.mark.parametrize("topic", [DIAGNOSTICS, imu_topic("/robot1", "front", "compensated")])
def test_publisher_token(topic: RosTopic) -> None:
    found = parse_token(publisher_token(7, SESSION, "/robot1", 3, topic))
    qos = found.endpoint[-1]
    endpoint = (topic.name, topic.message_type.name, topic.message_type.type_hash, qos)
    assert found == Token(7, SESSION, 0, 3, "MP", "/", "/robot1", "imu_monitor", endpoint)
    assert {name: value for name, value in parse_qos(qos).items() if value} == {"depth": 10}
