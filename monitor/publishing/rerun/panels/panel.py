"""Base class of the panels of the Rerun viewer.

Importing this module imports Rerun.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import rerun as rr
import rerun.blueprint as rrb

from drivers.data_types import Floats
from monitor.common.unit_formatting import UnitSystem
from monitor.history.bucketed_history import HistoryTable
from monitor.publishing.plots.axis_colours import Colour
from monitor.publishing.rerun.shared_views import markdown_document
from monitor.publishing.rerun.viewer_settings_and_errors import ViewerDeviceDescription

if TYPE_CHECKING:
    from monitor.publishing.rerun.viewer_scene import AllDevicesScene


class Panel:
    """Base class of the panels that draw one kind of result of one device.

    Parameters
    ----------
    scene
        Scene that contains the panel.
    device
        Name of the device.
    """

    def __init__(self, scene: "AllDevicesScene", device: str) -> None:
        self.scene = scene
        self.device = device

    def log_styles(self) -> None:
        """Log the names, colours and widths of the lines, which do not change."""

    def draw(self, unix_s: Floats, results: Sequence[Any]) -> None:
        """Draw results of the device.

        Parameters
        ----------
        unix_s
            Unix times of the results [s].
        results
            One or more results, in order of time.
        """
        raise NotImplementedError

    def draw_history(self, history: HistoryTable) -> None:
        """Draw the stored history of the device."""

    @classmethod
    def own_page(cls, device: ViewerDeviceDescription, units: UnitSystem, guide: rrb.View) -> rrb.Container | None:
        """Return the page that only this panel fills, or None if there is no such page.

        Parameters
        ----------
        device
            Device to show.
        units
            Units of the plots.
        guide
            View with the text that describes the page.
        """
        return None

    def entity_path(self, name: str) -> str:
        """Return the path of an entity that belongs to the device."""
        return f"{self.device}/{name}"

    def _style_lines(self, name: str, lines: Sequence[tuple[str, Colour, float]]) -> None:
        names, line_colours, widths = zip(*lines, strict=True)
        self.scene.log(
            self.entity_path(name), rr.SeriesLines(colors=line_colours, widths=widths, names=names), static=True
        )

    def _log_text(self, name: str, unix_s: float, text: str) -> None:
        self.scene.set_log_time(unix_s)
        self.scene.log(self.entity_path(name), markdown_document(text))
