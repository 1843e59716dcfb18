"""Simulated device, which sends the samples of a simulated sensor over a real link.

The device does not wait for a reader. Samples that cannot be sent are dropped, and the sample counter reveals the
missing samples.
"""

import threading
import time
from collections.abc import Callable
from typing import Final

import numpy as np
import structlog

from drivers.data_types import Chunk
from drivers.decoders.base import Decoder
from drivers.errors import LinkUnavailable
from monitor.common.unexpected_errors import RestartedThread
from monitor.settings.loading import VirtualTable
from monitor.simulator.encoding_sensor import SimulatedSensor
from monitor.simulator.faults import DrawnFaults, FaultCounts, FaultKind, Faults
from monitor.simulator.ports import create_port

BURST_S: Final = 0.01
"""Time between bursts of samples in s, chosen to resemble a USB adapter."""
MAX_DELAY_S: Final = 1.0
"""Delay in s above which the sensor skips samples instead of catching up."""

_log = structlog.get_logger("imu-monitor")


class SimulatedDevice:
    """Simulated device, which sends samples in a separate thread.

    Parameters
    ----------
    table : VirtualTable
        Noise model, seed, speed, effects and faults.
    decoder : Decoder
        Decoder of the wire format.
    name : str, optional
        Name of the device in log messages.

    Raises
    ------
    ConfigError
        If the noise model or an effect is invalid.
    """

    def __init__(self, table: VirtualTable, decoder: Decoder, name: str = "virtual") -> None:
        self.name = name
        self.fault_counts = FaultCounts()  # number of samples with each fault
        self.now_s: Callable[[], float] = time.monotonic
        """Clock of the simulation in seconds, which tests may replace."""
        self._sensor = SimulatedSensor(table, decoder, name)
        self.rate_hz = self._sensor.rate_hz * table.speed
        """Nominal sample rate in Hz."""
        self._pace_hz = self.rate_hz * table.faults.clock
        self._faults = Faults(table.faults, table.seed, decoder.carrier)
        self._unplugged_samples = max(1, round(table.faults.unplugged_for * self._sensor.rate_hz))
        self._back_at: int | None = None  # number of the sample before which the cable is connected again
        self.port = create_port(decoder.carrier, table.silence)
        self._stop = threading.Event()
        self._thread = RestartedThread(self._run, "virtual imu", self._stop)

    def start(self) -> None:
        """Connect the simulated device, and start sending samples."""
        self.port.plug()
        self._thread.start()

    def stop(self) -> None:
        """Stop sending samples, and close the port."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        self.port.close()

    # --- thread of the sensor

    def _run(self) -> None:
        """Send samples in bursts until the device is stopped."""
        self._sensor.compile_kernels_and_start_clock()
        begun_s, made = self.now_s(), 0
        step_s = max(BURST_S, 0.5 / self._pace_hz)  # a sensor with a low rate needs two steps per sample
        while not self._stop.wait(step_s + self._burst_delay_s()):
            due = int((self.now_s() - begun_s) * self._pace_hz)
            late = due - made - int(MAX_DELAY_S * self._pace_hz)
            if late > 0:  # a real sensor would have continued while the machine was suspended
                made += late
                self._sensor.skip_samples(late)
                self._faults.draw_faults(late)
                self.fault_counts.dropped += late
            if due > made:
                self._make_and_send(made, due - made)
                made = due

    def _make_and_send(self, first: int, n: int) -> None:
        """Simulate ``n`` samples, and send all samples except those during a cable fault."""
        frames, draws = self._sensor.encode_next_samples(n), self._faults.draw_faults(n)
        at = 0
        while at < n:
            if self._back_at is None:
                pulled = np.flatnonzero(draws.pulled[at:])
                stop = at + int(pulled[0]) if pulled.size else n
                self._send(frames[at:stop], draws[at:stop])
                if stop < n:
                    self._unplug_by_fault(first + stop)
            else:
                stop = min(n, max(at, self._back_at - first))
                self.fault_counts.dropped += stop - at
                if first + stop >= self._back_at:
                    self._plug_again()
            at = stop

    def _send(self, frames: list[list[Chunk]], draws: DrawnFaults) -> None:
        kinds = map(FaultKind, draws.kind.tolist())
        faulty = [
            (kind, self._faults.apply_fault(kind, position, chunks))
            for kind, position, chunks in zip(kinds, draws.position.tolist(), frames, strict=True)
        ]
        sent = self.port.send_and_count_chunks([chunk for _, chunks in faulty for chunk in chunks])
        for kind, chunks in faulty:
            sent -= len(chunks)
            self.fault_counts.count_sample(kind, all_sent=sent >= 0)

    def _unplug_by_fault(self, index: int) -> None:
        self.port.unplug()
        self.fault_counts.unplugged += 1
        self._back_at = index + self._unplugged_samples

    def _plug_again(self) -> None:
        self._back_at = None
        try:
            self.port.plug()
        except LinkUnavailable as error:
            _log.warning(
                "the cable of the simulated sensor cannot be connected again", device=self.name, error=str(error)
            )

    def _burst_delay_s(self) -> float:
        held_s = self._faults.draw_delay_s()
        self.fault_counts.held_s = max(self.fault_counts.held_s, held_s)
        return held_s
