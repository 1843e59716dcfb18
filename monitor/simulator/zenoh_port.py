"""Port of a simulated sensor that publishes over zenoh on the loopback interface; its link connects only to this
session.
"""

import socket
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from drivers.errors import LinkUnavailable
from drivers.links import zenoh_link
from drivers.sample import Chunk
from drivers.zenoh.session_config import build_session_config, format_zenoh_error

if TYPE_CHECKING:
    import zenoh

KEY: Final = "imu-monitor/virtual/samples"
"""Key of the published samples."""


class ZenohPort:
    """Port that publishes over a zenoh session of its own while it is connected.

    Parameters
    ----------
    silence_s : float
        Time in seconds without messages after which the link counts as lost.
    """

    def __init__(self, silence_s: float) -> None:
        self._endpoint = f"tcp/127.0.0.1:{_free_port()}"
        self.link = zenoh_link.build(zenoh_link.Settings(key=KEY, connect=(self._endpoint,), silence=silence_s))
        self._session: zenoh.Session | None = None
        self._publisher: Any = None
        self._plugging = threading.Lock()

    def plug(self) -> None:
        """Open the session.

        Raises
        ------
        LinkUnavailable
            Another program uses the network port.
        """
        import zenoh

        with self._plugging:
            if self._session is not None:
                return
            try:
                self._session = zenoh.open(build_session_config({"listen/endpoints": [self._endpoint]}))
                self._publisher = self._session.declare_publisher(KEY)
            except zenoh.ZError as error:
                raise LinkUnavailable(f"simulated sensor at {self._endpoint}: {format_zenoh_error(error)}") from error

    def unplug(self) -> None:
        """Close the session."""
        with self._plugging:
            session, self._session = self._session, None
            if session is not None:
                session.close()  # type: ignore[no-untyped-call]

    def send_chunks(self, chunks: Sequence[Chunk]) -> int:
        """Publish each chunk as one message; return the number of published chunks. Zenoh drops messages for slow
        readers.
        """
        with self._plugging:
            if self._session is None:
                return 0
            for chunk in chunks:
                self._publisher.put(chunk.data, attachment=chunk.attachment or None)
        return len(chunks)

    def close(self) -> None:
        """Close the session permanently."""
        self.unplug()


def _free_port() -> int:
    """Return a free TCP port of the loopback interface."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port: int = server.getsockname()[1]
        return port
