"""Table of all zenoh topics on which the program publishes data or answers queries.

The zenoh key of a topic is ``<prefix>/<device>/<name>``. The default prefix is ``imu``.
"""

from dataclasses import dataclass
from typing import Final, Literal

ENDPOINT: Final = "tcp/127.0.0.1:7450"
"""Default address on which a daemon listens. Port 7447 is avoided, because the zenoh router of ROS 2 uses it."""
JSON: Final = "application/json"
MSGPACK: Final = "application/msgpack"


@dataclass(frozen=True, slots=True)
class ZenohTopic:
    """Zenoh topic with name, encoding and time of publication."""

    name: str
    encoding: str
    when: Literal["batches", "publish", "rounds", "intervals", "event", "1 Hz", "presence", "query"]
    kept: int = 0  # number of messages that a daemon keeps for late subscribers

    def key(self, prefix: str, device: str) -> str:
        """Return the zenoh key expression of a topic for one device.

        Parameters
        ----------
        prefix : str
            Prefix of the daemon's keys.
        device : str
            Name of the device, or a wildcard.
        """
        return f"{prefix}/{device}/{self.name}"

    def schema_name(self) -> str:
        """Return the text of the ``schema`` field in all messages of a topic."""
        return f"imu-monitor/{self.name.split('/')[-1]}/1"


SAMPLES: Final = ZenohTopic("samples", MSGPACK, "batches")
COMPENSATED: Final = ZenohTopic("compensated", MSGPACK, "batches")
ALLAN: Final = ZenohTopic("allan", JSON, "publish", kept=1)
COEFFICIENTS: Final = ZenohTopic("coefficients", JSON, "publish", kept=1)
TOTAL: Final = ZenohTopic("total", JSON, "rounds")
GAP: Final = ZenohTopic("gap", JSON, "publish", kept=1)
THERMAL: Final = ZenohTopic("thermal", JSON, "intervals", kept=1)
EVENT: Final = ZenohTopic("event", JSON, "event", kept=10)
STATUS: Final = ZenohTopic("status", JSON, "1 Hz", kept=1)
ALIVE: Final = ZenohTopic("alive", "", "presence")
HISTORY: Final = ZenohTopic("history", JSON, "query")
RESET: Final = ZenohTopic("command/reset", JSON, "query")
RECONCILE: Final = ZenohTopic("command/reconcile", JSON, "query")

TOPICS: Final = tuple(value for value in tuple(vars().values()) if isinstance(value, ZenohTopic))
