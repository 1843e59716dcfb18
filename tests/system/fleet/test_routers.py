"""Test that the shipped router configurations limit the message rate of each device, but not the events."""

import time
from collections import Counter
from pathlib import Path
from typing import Any

import zenoh

from drivers.zenoh.session_config import build_session_config
from monitor.common.shipped_config_paths import CONFIG_FOLDER
from tests.support.ports import free_endpoint
from tests.support.waiting import wait_for
from tests.support.zenoh_sessions import open_session

DEVICES = ("nose", "tail")


def load_router_config(folder: Path, name: str, **replacements: str) -> Any:
    text = (CONFIG_FOLDER / "router" / name).read_text("utf-8")
    for old, new in replacements.items():
        assert old in text
        text = text.replace(old, new)
    (folder / name).write_text(text)
    return build_session_config({}, folder / name)


def count_messages(subscriber: Any) -> Counter[str]:
    return Counter(str(sample.key_expr) for sample in iter(subscriber.handler.try_recv, None))


def test_leaf_router_limits_status_messages_per_device_and_passes_all_events(tmp_path: Path) -> None:
    up, site = free_endpoint(), free_endpoint()
    endpoints = {"tcp/127.0.0.1:7447": up, "tcp/127.0.0.1:7448": site}
    root = load_router_config(tmp_path, "root.json5", **{"tcp/127.0.0.1:7447": up})
    leaf = load_router_config(tmp_path, "leaf.json5", **endpoints, eth0="lo")
    with (
        zenoh.open(root),
        zenoh.open(leaf),
        open_session(mode="peer", connect=[site]) as daemon,
        open_session(connect=[up]) as remote_client,
    ):
        watcher = remote_client.declare_subscriber("imu/**", zenoh.handlers.RingChannel(10_000))
        wait_for(lambda: daemon.put("imu/ready/event", b"") or count_messages(watcher))
        begun_s = time.monotonic()
        sent = 0
        while time.monotonic() - begun_s < 5.0:
            for device in DEVICES:
                for topic in ("status", "event"):
                    daemon.put(f"imu/{device}/{topic}", b"x", congestion_control=zenoh.CongestionControl.BLOCK)
            sent += 1
            time.sleep(0.1)
        received: Counter[str] = Counter()
        wait_for(lambda: received.update(count_messages(watcher)) or received["imu/tail/event"] >= sent)
        took_s = time.monotonic() - begun_s  # until then the routers limit the rate by their own clock
        for device in DEVICES:
            assert received[f"imu/{device}/event"] == sent
            assert 1 <= received[f"imu/{device}/status"] <= 0.5 * took_s + 2  # of ten per second that were sent
