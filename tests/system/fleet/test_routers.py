"""The shipped routers: what goes up is thinned device by device, events are not."""

import time
from collections import Counter
from pathlib import Path
from typing import Any

import zenoh

from drivers.zenoh.session_config import build_session_config
from monitor.common.shipped_config_paths import CONFIG_FOLDER
from tests.support.ports import free_endpoint
from tests.support.waiting import wait_for
from tests.support.zenoh_sessions import session

DEVICES = ("nose", "tail")


def shipped(folder: Path, name: str, **swaps: str) -> Any:
    text = (CONFIG_FOLDER / "router" / name).read_text("utf-8")
    for old, new in swaps.items():
        assert old in text
        text = text.replace(old, new)
    (folder / name).write_text(text)
    return build_session_config({}, folder / name)


def counted(subscriber: Any) -> Counter[str]:
    return Counter(str(sample.key_expr) for sample in iter(subscriber.handler.try_recv, None))


def test_what_goes_up_is_thinned_device_by_device(tmp_path: Path) -> None:
    up, site = free_endpoint(), free_endpoint()
    places = {"tcp/127.0.0.1:7447": up, "tcp/127.0.0.1:7448": site}
    root = shipped(tmp_path, "root.json5", **{"tcp/127.0.0.1:7447": up})
    leaf = shipped(tmp_path, "leaf.json5", **places, eth0="lo")
    with (
        zenoh.open(root),
        zenoh.open(leaf),
        session(mode="peer", connect=[site]) as daemon,
        session(connect=[up]) as far,
    ):
        watcher = far.declare_subscriber("imu/**", zenoh.handlers.RingChannel(10_000))
        wait_for(lambda: daemon.put("imu/ready/event", b"") or counted(watcher))
        begun_s = time.monotonic()
        sent = 0
        while time.monotonic() - begun_s < 5.0:
            for device in DEVICES:
                for topic in ("status", "event"):
                    daemon.put(f"imu/{device}/{topic}", b"x", congestion_control=zenoh.CongestionControl.BLOCK)
            sent += 1
            time.sleep(0.1)
        got: Counter[str] = Counter()
        wait_for(lambda: got.update(counted(watcher)) or got["imu/tail/event"] >= sent)
        took_s = time.monotonic() - begun_s  # the routers thin out what they pass on by their own clock until then
        for device in DEVICES:
            assert got[f"imu/{device}/event"] == sent
            assert 1 <= got[f"imu/{device}/status"] <= 0.5 * took_s + 2  # of ten a second
