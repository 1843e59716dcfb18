"""Panels of the Rerun viewer for the health of a device and for the table of all devices.

Importing this module imports Rerun.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from drivers.data_types import Floats
from monitor.common.device_health import Health
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
        self._log_text("status", at_s, health_text(self.device, health, about))
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
