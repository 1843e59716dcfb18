"""Panels of the Rerun viewer, each of which draws one kind of result of one device.

``monitor.publishing.result_kinds`` lists the kinds of results. Importing this package imports Rerun.
"""

from monitor.publishing.rerun.panels.bias_panels import DriftPanel, ThermalPredictionPanel
from monitor.publishing.rerun.panels.noise_panels import (
    AllanAndCoefficientPanel,
    CoefficientsPanel,
    ModelDifferencePanel,
)
from monitor.publishing.rerun.panels.panel import Panel
from monitor.publishing.rerun.panels.sample_panels import (
    CompensatedPanel,
    SamplesAndTemperaturePanel,
)
from monitor.publishing.rerun.panels.status_panels import AllDevicesTablePanel, EventsPanel, HealthPanel

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
