"""Output of the daemon that shows results in the Rerun viewer.

``monitor.publishing.result_kinds`` lists the messages and drawings of each kind of result.
"""

import math
from typing import TYPE_CHECKING, Any

from drivers.data_types import Event, Ints, SampleBlock
from monitor.common.device_health import Health
from monitor.daemon.outputs.output import Output
from monitor.publishing.result_kinds import CompensatedRateBatch, SampleBatch

if TYPE_CHECKING:
    from monitor.publishing.rerun.queued_view import RerunView


class ViewerOutput(Output):
    """Output that shows the results in the Rerun viewer."""

    name = "viewer"

    def __init__(self, view: "RerunView") -> None:
        self._view = view

    def publish_samples(self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int) -> None:
        """Show the measured samples in the viewer."""
        unix_s = (samples.t_ns + offset_ns) / 1e9
        self._view.put(device, float(unix_s[-1]), SampleBatch(unix_s, samples.values, samples.temperature_c))

    def publish_drift_compensated_samples(
        self, device: str, received: int, samples: SampleBlock, offset_ns: Ints | int
    ) -> None:
        """Show the compensated angular rates together with the measured rates."""
        unix_s = (samples.t_ns + offset_ns) / 1e9
        self._view.put(device, float(unix_s[-1]), CompensatedRateBatch(unix_s, samples.values[:, :3]))

    def publish_result(self, device: str, unix_s: float, received: int, result: Any) -> None:
        """Show a result in the panels that draw this kind of result."""
        self._view.put(device, unix_s, result)

    def publish_event(self, device: str, unix_s: float, received: int, event: Event) -> None:
        """Show an event as one line of the event log."""
        self._view.put(device, unix_s, event)

    def publish_health(self, device: str, unix_s: float | None, health: Health) -> None:
        """Show the status of a device, as of the current time if that is known."""
        self._view.put(device, math.nan if unix_s is None else unix_s, health)
