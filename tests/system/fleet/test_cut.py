"""Test of a network connection that is interrupted and restored between a daemon and a watcher."""

import subprocess
import threading
import time
from pathlib import Path

from tests.support.waiting import PATIENCE_S, wait_for
from tests.system.fleet.namespaces import INSIDE, create_namespaces

CONFIG = f"""
[[device]]
name = "nose"
rate = 100.0
driver = {{ link = "virtual" }}
[zenoh]
listen = ["tcp/{INSIDE}:7450"]
[viewer]
mode = "none"
"""
WATCH = """
import contextlib, sys, time
from monitor.publishing.remote_device_states import RemoteDeviceRegistry
from monitor.publishing.zenoh.subscriber import ZenohSubscriber

registry = RemoteDeviceRegistry()
with contextlib.closing(ZenohSubscriber("imu/**", [sys.argv[1]])) as subscriber:
    subscriber.start()
    while True:
        for message in subscriber.take(0.2):
            if message.payload is None:
                registry.set_liveliness_token(message.key, message.token_exists)
            else:
                registry.process_message(message.key, message.payload)
        now_s = time.monotonic()
        devices = registry.devices_with_problems_first(now_s)
        states = [device.state(now_s) for device in devices] or ["no device"]
        received = [device.status.received for device in devices if device.status] or [0]
        print(states[0], received[0], subscriber.state, flush=True)
"""


def test_daemon_and_watcher_reconnect_after_an_interrupted_network(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text(CONFIG)
    with create_namespaces() as namespaces:
        daemon = namespaces.start_python(namespaces.inside, "-m", "imu_monitor", "run", str(path))
        watcher = namespaces.start_python(namespaces.outside, "-c", WATCH, f"tcp/{INSIDE}:7450")
        newest = [""]

        def listen() -> None:
            assert watcher.stdout is not None
            for line in watcher.stdout:
                newest[0] = line

        def drain() -> None:
            assert daemon.stdout is not None
            for _ in daemon.stdout:
                pass

        readers = [threading.Thread(target=listen), threading.Thread(target=drain)]
        for reader in readers:
            reader.start()
        try:
            wait_for(lambda: newest[0].startswith("running"))
            before = int(newest[0].split()[1])
            namespaces.set_cable("down")
            wait_for(lambda: newest[0].startswith(("silent", "gone")))
            cut_s = time.monotonic()
            # zenoh's lease is 10 s, after which both sides close the session
            wait_for(lambda: time.monotonic() > cut_s + 12.0, "the end of the lease")
            namespaces.set_cable("up")
            # the daemon has also received the samples during the interruption
            wait_for(lambda: newest[0].startswith("running") and int(newest[0].split()[1]) > before + 1000)
            wait_for(lambda: newest[0].rstrip().endswith("ok"))
        finally:
            _terminate(daemon, watcher)
            for reader in readers:
                reader.join(PATIENCE_S)
            for pipe in (daemon.stdout, daemon.stderr, watcher.stdout, watcher.stderr):
                assert pipe is not None
                pipe.close()


def _terminate(*children: "subprocess.Popen[str]") -> None:
    for child in children:
        child.terminate()
        try:
            child.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
