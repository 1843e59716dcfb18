"""Panels of the Rerun viewer, each of which draws one kind of result of one device.

``monitor.publishing.result_kinds`` lists the kinds of results. Importing this package imports Rerun.
"""

from monitor.publishing.rerun.panels.device_health_panels import AllDevicesTablePanel, HealthPanel
from monitor.publishing.rerun.panels.drift_panel import DriftPanel
from monitor.publishing.rerun.panels.events_panel import EventsPanel
from monitor.publishing.rerun.panels.measured_and_compensated_sample_panels import (
    CompensatedPanel,
    SamplesAndTemperaturePanel,
)
from monitor.publishing.rerun.panels.noise_panels import (
    AllanAndCoefficientPanel,
    CoefficientsPanel,
    ModelDifferencePanel,
)
from monitor.publishing.rerun.panels.panel import Panel
from monitor.publishing.rerun.panels.thermal_panel import ThermalPredictionPanel

__all__ = [
    "AllDevicesTablePanel",
    "AllanAndCoefficientPanel",
    "CoefficientsPanel",
    "CompensatedPanel",
    "DriftPanel",
    "EventsPanel",
    "HealthPanel",
    "ModelDifferencePanel",
    "Panel",
    "SamplesAndTemperaturePanel",
    "ThermalPredictionPanel",
]
