"""Panels of the Rerun viewer for the health of a device, the table of all devices and the log of events.

Importing this module imports Rerun.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
import rerun as rr

from drivers.data_types import Event, Floats
from monitor.common.device_health import Health
from monitor.common.unit_formatting import format_utc
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS
from monitor.history.bucketed_history import HistoryTable
from monitor.publishing.rerun.panels.noise_panels import CoefficientsPanel
from monitor.publishing.rerun.panels.panel import Panel
from monitor.publishing.rerun.panels.panel_text import health_text, overview_text
from monitor.publishing.rerun.shared_views import markdown_document

if TYPE_CHECKING:
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


MAX_PAST_EVENTS: Final = 200
"""Largest number of stored events that are shown."""
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
    """List of events. A diamond in the plot marks the new value of a changed noise coefficient."""

    def draw(self, unix_s: Floats, results: Sequence[Event]) -> None:
        """Log events, and mark changed noise coefficients in the plots."""
        for at_s, event in zip(unix_s.tolist(), results, strict=True):
            level = "ERROR" if event.kind == "link_lost" else "WARN" if event.kind in WARNING_EVENTS else "INFO"
            clock_time = format_utc(at_s)[-8:]  # the time column of the viewer is too narrow for the whole time
            self.scene.set_log_time(at_s)
            if self.scene.fleet or len(self.scene.devices) > 1:
                line = rr.TextLog(f"{clock_time}  {self.device}: {event.text}", level=level)
                self.scene.log("overview/events", line)
            if self.device in self.scene.devices:
                self.scene.log(self.entity_path("events"), rr.TextLog(f"{clock_time}  {event.text}", level=level))
                self._mark_changes(at_s, event)

    def draw_history(self, history: HistoryTable) -> None:
        """Log the stored events of the device."""
        for one in history.events[-MAX_PAST_EVENTS:]:
            text = f"{format_utc(one.t_s)[:10]}: {one.text}"  # a log line would otherwise show no date
            self.draw(np.array([one.t_s]), [Event(one.kind, round(one.t_s * 1e9), text, one.axis, one.what)])

    def _mark_changes(self, unix_s: float, event: Event) -> None:
        if event.axis is None:
            return
        coefficients = self.scene.get_or_create_panel(self.device, CoefficientsPanel)
        for symbol, sides in event.values.items():
            if symbol in SYMBOLS and "after" in sides:
                at, after = np.array([unix_s]), np.array([sides["after"]])
                coefficients.log_coefficient(symbol, event.axis, at, after, "/changed")
