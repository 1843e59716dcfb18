"""Panels of the Rerun viewer for the health of a device, the table of all devices and the log of events.

Importing this module imports Rerun.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from drivers.data_types import Event, Floats
from monitor.common.device_health import Health
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS
from monitor.history.bucketed_history import HistoryTable
from monitor.publishing.rerun.panels.noise_panels import AllanAndCoefficientPanel, CoefficientsPanel
from monitor.publishing.rerun.panels.panel import Panel
from monitor.publishing.rerun.panels.panel_text import escape_markdown, events_text, health_text, overview_text
from monitor.publishing.rerun.shared_views import markdown_document

if TYPE_CHECKING:
    from monitor.publishing.rerun.viewer_scene import AllDevicesScene
    from monitor.publishing.result_kinds import AllDevicesTableText


class HealthPanel(Panel):
    """State and sample counts of one device. The panel also updates the table of all devices."""

    def draw(self, unix_s: Floats, results: Sequence[Health]) -> None:
        """Draw the newest state and sample counts of the device."""
        at_s, health, devices = float(unix_s[-1]), results[-1], self.scene.devices
        if self.device in devices:
            self.scene.healths[self.device] = health
        about = devices[self.device].about if self.device in devices else ""
        text = health_text(self.device, health, about)
        if math.isnan(at_s):  # there is no sample yet, so the time on the axis of the samples is unknown
            self.scene.log_static_text(self.entity_path("waiting"), text)
            return
        self.scene.entities.discard(f"/{self.entity_path('waiting')}")
        self._log_text("status", at_s, text)
        if self.device in devices:
            plots = self.scene.get_or_create_panel(self.device, AllanAndCoefficientPanel)
            plots.show_connection(at_s, connected=health.state not in ("lost", "waiting"))
        self.scene.repeat_unchanged_entities(self.device, at_s)
        if len(devices) > 1 and not self.scene.fleet:
            self.scene.get_or_create_panel("", AllDevicesTablePanel).log_table_of_all_devices(
                at_s, overview_text(self.scene.healths)
            )


class AllDevicesTablePanel(Panel):
    """Table of all devices."""

    def draw(self, unix_s: Floats, results: "Sequence[AllDevicesTableText]") -> None:
        """Draw the newest table of all devices."""
        self.log_table_of_all_devices(float(unix_s[-1]), results[-1].text)

    def log_table_of_all_devices(self, unix_s: float, text: str) -> None:
        """Log the table of all devices.

        Parameters
        ----------
        unix_s
            Unix time at which the table is shown [s].
        text
            Table in Markdown.
        """
        self.scene.set_log_time(unix_s)
        self.scene.log("overview", markdown_document(text))
        self.scene.repeat_unchanged_entities("overview", unix_s)


MAX_SHOWN_EVENTS: Final = 100
"""Largest number of events in the list of a device and in the list of all devices."""
WARNING_EVENTS: Final = frozenset({
    "samples_lost",
    "noise_changed",
    "bias_stepped",
    "limit_crossed",
    "model_disagrees",
    "temperature_unexplained",
    "drift_unexplained",
    "clock_jumped",
})  # fmt: skip
"""Kinds of events that are logged as warnings."""


class EventsPanel(Panel):
    """List of events, newest first. A diamond in the plot marks the new value of a changed noise coefficient.

    The list is a text. A Rerun log would cut long lines, and a viewer that joins late may not receive its old lines.
    """

    def __init__(self, scene: "AllDevicesScene", device: str) -> None:
        super().__init__(scene, device)
        self._lines: list[tuple[float, str, str]] = []  # Unix time [s], level and text of each event, in order of time

    def draw(self, unix_s: Floats, results: Sequence[Event]) -> None:
        """Add events to the lists, and mark changed noise coefficients in the plots."""
        levels = [
            "ERROR" if one.kind == "link_lost" else "WARN" if one.kind in WARNING_EVENTS else "" for one in results
        ]
        texts = [escape_markdown(one.text) for one in results]
        lines = list(zip(unix_s.tolist(), levels, texts, strict=True))
        if self.scene.fleet or len(self.scene.devices) > 1:
            name = escape_markdown(self.device)
            named = [(at_s, level, f"{name}: {text}") for at_s, level, text in lines]
            self.scene.get_or_create_panel("", EventsPanel).log_lines("overview/events", named)
        if self.device in self.scene.devices:
            self.log_lines(self.entity_path("events"), lines)
            for at_s, event in zip(unix_s.tolist(), results, strict=True):
                self._mark_changes(at_s, event)

    def draw_history(self, history: HistoryTable) -> None:
        """Add the stored events of the device to the lists."""
        stored = history.events[-MAX_SHOWN_EVENTS:]
        if stored:
            events = [Event(one.kind, round(one.t_s * 1e9), one.text, one.axis, one.what) for one in stored]
            self.draw(np.array([one.t_s for one in stored]), events)

    def log_lines(self, path: str, lines: Sequence[tuple[float, str, str]]) -> None:
        """Log the list of events after adding lines to it.

        Parameters
        ----------
        path
            Path of the entity with the list.
        lines
            Unix time [s], level and Markdown text of each new event.
        """
        self._lines = sorted([*self._lines, *lines], key=lambda line: line[0])[-MAX_SHOWN_EVENTS:]
        self.scene.set_log_time(self._lines[-1][0])
        self.scene.log(path, markdown_document(events_text(self._lines)))

    def _mark_changes(self, unix_s: float, event: Event) -> None:
        if event.axis is None:
            return
        coefficients = self.scene.get_or_create_panel(self.device, CoefficientsPanel)
        for symbol, sides in event.values.items():
            if symbol in SYMBOLS and "after" in sides:
                coefficients.mark_change(symbol, event.axis, unix_s, sides["after"])
