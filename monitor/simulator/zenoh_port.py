"""Port of a simulated sensor that publishes samples over zenoh on the loopback interface."""

import socket
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from drivers.data_types import Chunk
from drivers.errors import LinkUnavailable
from drivers.links import zenoh_link
from drivers.zenoh.session_config import build_session_config, format_zenoh_error
from monitor.simulator.port import Port

if TYPE_CHECKING:
    import zenoh

KEY: Final = "imu-monitor/virtual/samples"
"""Zenoh key of the published samples."""


class ZenohPort(Port):
    """Port of a simulated sensor with a separate zenoh session.

    The link is lost after ``link_lost_after_s`` seconds without messages.
    """

    def __init__(self, link_lost_after_s: float) -> None:
        self._endpoint = f"tcp/127.0.0.1:{_free_port()}"
        settings = zenoh_link.Settings(key=KEY, connect=(self._endpoint,), silence=link_lost_after_s)
        super().__init__(zenoh_link.build(settings))
        self._session: zenoh.Session | None = None
        self._publisher: Any = None

    def plug(self) -> None:
        """Open the zenoh session of the simulated sensor."""
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
        """Close the zenoh session of the simulated sensor."""
        with self._plugging:
            session, self._session = self._session, None
            if session is not None:
                session.close()  # type: ignore[no-untyped-call]

    def send_and_count_chunks(self, chunks: Sequence[Chunk]) -> int:
        """Publish each chunk as one zenoh message, and return the number of published chunks."""
        with self._plugging:
            if self._session is None:
                return 0
            for chunk in chunks:
                self._publisher.put(chunk.data, attachment=chunk.attachment or None)
        return len(chunks)


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port: int = server.getsockname()[1]
        return port
