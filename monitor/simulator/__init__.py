"""Simulated IMU that sends a real wire format over a real link: noise model, encoder, faults and link endpoint."""

from monitor.simulator.scheduled_effects import effects_of
from monitor.simulator.sensor import DEFAULT_RATE_HZ, ROOM_C, WARM_UP_C, WARM_UP_S, Sensor
from monitor.simulator.virtual_imu import VirtualImu

__all__ = ["DEFAULT_RATE_HZ", "ROOM_C", "WARM_UP_C", "WARM_UP_S", "Sensor", "VirtualImu", "effects_of"]
