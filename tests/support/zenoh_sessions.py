"""zenoh sessions and routers in the test process. They use only loopback, so other processes do not find them."""

import contextlib
import json
from pathlib import Path
from typing import Any

import zenoh

DROP_WAIT = "transport/link/tx/queue/congestion_control/drop/wait_before_drop"
"""Time for which a message waits in front of a full queue before zenoh drops it.

The default is 1 ms. On a busy machine, the thread that empties the queue may need longer, so tests wait longer.
"""
PATIENT_US = 5_000_000


def session_config(
    mode: str = "client", listen: tuple[str, ...] | list[str] = (), connect: tuple[str, ...] | list[str] = ()
) -> zenoh.Config:
    """Return the configuration of a session that neither scouts nor listens beyond the given endpoints."""
    config = zenoh.Config()
    keys: dict[str, Any] = {
        "mode": mode,
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        DROP_WAIT: PATIENT_US,
    }
    for key, value in keys.items():
        config.insert_json5(key, json.dumps(value))
    return config


def patient_file(folder: Path) -> Path:
    """Write a zenoh file for a program under test, with the same waiting time for full queues as ``session_config``."""
    *tables, key = DROP_WAIT.split("/")
    path = folder / "patient.json5"
    path.write_text("".join(f"{{{table}:" for table in tables) + f"{{{key}:{PATIENT_US}}}" + "}" * len(tables))
    return path


def open_session(
    mode: str = "client", listen: tuple[str, ...] | list[str] = (), connect: tuple[str, ...] | list[str] = ()
) -> contextlib.AbstractContextManager[Any]:
    """Open a session that neither scouts nor listens beyond the given endpoints."""
    opened: contextlib.AbstractContextManager[Any] = zenoh.open(session_config(mode, listen, connect))
    return opened


def open_router(endpoint: str) -> contextlib.AbstractContextManager[Any]:
    """Open a router that listens on ``endpoint``."""
    return open_session(mode="router", listen=[endpoint])
