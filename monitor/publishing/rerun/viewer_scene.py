"""Content of the Rerun viewer, which consists of panels that log results to one Rerun stream.

Only the viewer thread may use this module, because calls block while the viewer is not reading. Importing this module
imports Rerun.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeVar

import numpy as np
import rerun as rr

from drivers.data_types import Floats
from monitor.common.device_health import Health
from monitor.common.unit_formatting import DEFAULT_UNITS, UnitSystem
from monitor.history.bucketed_history import HistoryTable
from monitor.publishing.rerun import panels
from monitor.publishing.rerun.panels import Panel
from monitor.publishing.rerun.shared_views import TIMELINE, markdown_document
from monitor.publishing.rerun.viewer_settings_and_errors import ViewerDeviceDescription
from monitor.publishing.result_kinds import RESULT_KINDS, TimedResult

P = TypeVar("P", bound=Panel)
PANELS: tuple[type[Panel], ...] = tuple(
    getattr(panels, drawing.panel) for kind in RESULT_KINDS for drawing in kind.drawings
)
"""Classes of all panels."""
REPEAT_PERIOD_S: Final = 10.0
"""Interval at which unchanged entities are logged again [s].

A viewer that joins late receives the newest messages first, and the oldest messages may have been dropped. Each
repetition of the entities of one device takes about 100 kB.
"""


@dataclass(frozen=True, slots=True)
class _LoggedEntity:
    """Newest content of an entity that is not static."""

    unix_s: float  # Unix time under which the content was logged [s]
    logged_s: float  # monotonic time of the logging call [s]
    components: tuple[Any, ...]


class AllDevicesScene:
    """Panels of all devices in one Rerun stream. The class is not thread-safe, and its methods may block.

    Parameters
    ----------
    stream
        Rerun stream to which the panels log.
    fleet
        True if the device table also contains devices that are not shown in detail.
    units
        Units of tables and plots.
    """

    def __init__(self, stream: rr.RecordingStream, fleet: bool = False, units: UnitSystem = DEFAULT_UNITS) -> None:
        self.fleet = fleet
        self.units = units
        self.devices: dict[str, ViewerDeviceDescription] = {}  # devices that are shown
        self.healths: dict[str, Health] = {}  # newest health of each shown device
        self.entities: set[str] = set()  # paths of the entities that have data
        self._stream = stream
        self._panels: dict[tuple[str, type[Panel]], Panel] = {}
        self._static_texts: dict[str, str] = {}  # newest static text of each path
        self._log_time_s = 0.0  # Unix time of the following calls [s]
        self._newest: dict[str, _LoggedEntity] = {}  # newest content of each path

    def set_detailed_devices(self, devices: Sequence[ViewerDeviceDescription]) -> None:
        """Set the devices that have panels."""
        self.devices = {one.name: one for one in devices}
        self.healths = {name: health for name, health in self.healths.items() if name in self.devices}
        for name in self.devices:
            for kind in PANELS:
                self.get_or_create_panel(name, kind).log_styles()

    def get_or_create_panel(self, device: str, kind: type[P]) -> P:
        """Return the panel of a device with the given class. The panel is created if it does not exist.

        Parameters
        ----------
        device
            Name of the device.
        kind
            Class of the panel.
        """
        found = self._panels.get((device, kind))
        if not isinstance(found, kind):
            found = self._panels[device, kind] = kind(self, device)
        return found

    def draw(self, device: str, panel: str, results: Sequence[TimedResult]) -> None:
        """Draw results of a device in a panel.

        Parameters
        ----------
        device
            Name of the device.
        panel
            Name of the panel class.
        results
            One or more results with their Unix times [s], in order of time.
        """
        kind: type[Panel] = getattr(panels, panel)
        self.get_or_create_panel(device, kind).draw(
            np.array([unix_s for unix_s, _ in results]), [one for _, one in results]
        )

    def draw_history(self, device: str, history: HistoryTable) -> None:
        """Draw the stored history of a device, with a gap before the live results.

        Parameters
        ----------
        device
            Name of the device.
        history
            Stored history of the device.
        """
        for kind in PANELS:
            self.get_or_create_panel(device, kind).draw_history(history)

    def repeat_unchanged_entities(self, folder: str, unix_s: float) -> None:
        """Log entities again whose newest content is older than REPEAT_PERIOD_S.

        Parameters
        ----------
        folder
            Beginning of the paths of the entities, such as the name of a device.
        unix_s
            Unix time under which the content is logged, unless its own time is later [s].
        """
        oldest_s = time.monotonic() - REPEAT_PERIOD_S
        for path, newest in list(self._newest.items()):
            if path.startswith(f"{folder}/") and newest.logged_s <= oldest_s:
                self.set_log_time(max(unix_s, newest.unix_s))
                self.log(path, *newest.components)

    def set_log_time(self, unix_s: float) -> None:
        """Set the Unix time [s] under which the following calls log their data."""
        self._log_time_s = unix_s
        self._stream.set_time(TIMELINE, timestamp=_timestamps(np.array([unix_s]))[0])

    def log(self, path: str, *entities: Any, static: bool = False) -> None:
        """Log components of a Rerun entity.

        Parameters
        ----------
        path
            Path of the entity in the Rerun recording.
        *entities
            Components to log.
        static
            True if the components do not change with time.
        """
        if static:
            self._stream.log(path, *entities, static=True)
            return
        drawn_s, known = self._log_time_s, self._newest.get(path)
        if known is not None and known.unix_s > drawn_s:  # otherwise, the viewer would keep showing the older content
            self.set_log_time(known.unix_s)
        self.entities.add(f"/{path}")
        self._newest[path] = _LoggedEntity(self._log_time_s, time.monotonic(), entities)
        self._stream.log(path, *entities, static=False)
        if self._log_time_s != drawn_s:
            self.set_log_time(drawn_s)

    def log_static_text(self, path: str, text: str) -> None:
        """Log a Markdown text that does not change with time, unless the viewer already has this text.

        A viewer that joins late receives all static texts before the newest results.

        Parameters
        ----------
        path
            Path of the entity in the Rerun recording.
        text
            Text in Markdown.
        """
        if self._static_texts.get(path) != text:
            self._static_texts[path] = text
            self._stream.log(path, markdown_document(text), static=True)
        self.entities.add(path if path.startswith("/") else f"/{path}")

    def log_scalars(self, path: str, unix_s: Floats, values: Floats) -> None:
        """Log one or several time series under one path.

        Parameters
        ----------
        path
            Path of the entity in the Rerun recording.
        unix_s
            Unix times [s], shape [n].
        values
            Values, shape [n] or [n, series].
        """
        if unix_s.size:
            self.entities.add(f"/{path}")
            time = rr.TimeColumn(TIMELINE, timestamp=_timestamps(unix_s))
            self._stream.send_columns(path, [time], rr.Scalars.columns(scalars=values))


def _timestamps(unix_s: Floats) -> "np.ndarray[tuple[int, ...], np.dtype[np.datetime64]]":
    return np.round(unix_s * 1e9).astype("datetime64[ns]")
