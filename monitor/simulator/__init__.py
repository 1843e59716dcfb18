"""Simulated IMU, which sends samples of a noise model in a real wire format over a real link."""

from monitor.simulator.effect_option_parser import parse_effects
from monitor.simulator.encoding_sensor import AMBIENT_C, DEFAULT_RATE_HZ, WARM_UP_C, WARM_UP_S, SimulatedSensor
from monitor.simulator.simulated_device import SimulatedDevice

__all__ = [
    "AMBIENT_C",
    "DEFAULT_RATE_HZ",
    "WARM_UP_C",
    "WARM_UP_S",
    "SimulatedDevice",
    "SimulatedSensor",
    "parse_effects",
]
