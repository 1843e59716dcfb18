"""A router and a client in this process, on loopback, found by nobody else."""

import contextlib
import json
import socket
import time
from collections.abc import Callable, Iterator
from typing import Any

import zenoh


def free_endpoint() -> str:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"tcp/127.0.0.1:{server.getsockname()[1]}"


@contextlib.contextmanager
def session(**keys: Any) -> Iterator[Any]:
    """A session that neither scouts nor listens but where ``listen`` and ``connect`` say so."""
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/gossip/enabled", "false")
    config.insert_json5("mode", json.dumps(keys.get("mode", "client")))
    config.insert_json5("listen/endpoints", json.dumps(keys.get("listen", [])))
    config.insert_json5("connect/endpoints", json.dumps(keys.get("connect", [])))
    with zenoh.open(config) as opened:
        yield opened


def router(endpoint: str) -> contextlib.AbstractContextManager[Any]:
    return session(mode="router", listen=[endpoint])


def eventually(true: Callable[[], Any], within_s: float = 15.0) -> Any:
    """What ``true`` returns, once that is something; fails when it stays nothing."""
    until_s = time.monotonic() + within_s
    while time.monotonic() < until_s:
        if found := true():
            return found
        time.sleep(0.02)
    raise AssertionError("it did not come to that in time")
