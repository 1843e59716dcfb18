"""A simulated sensor's life: its samples go out in real time or faster, with faults where asked for, over a real link.

The ordinary link reads the other end of ``port`` and cannot tell it from a sensor. A device does not wait for its
reader: what finds no room is dropped, and its counter shows it. ``unplug`` and ``plug`` pull the cable and put it back.
``truth`` counts what was done.
"""

import threading
import time
from collections.abc import Callable
from typing import Final

import numpy as np
import structlog

from drivers.decoders.base import Decoder
from drivers.errors import LinkUnavailable
from drivers.links.base import Link
from drivers.sample import Chunk
from monitor.settings.loading import VirtualTable
from monitor.simulator.faults import Draws, Faults, Truth
from monitor.simulator.port import port_of
from monitor.simulator.sensor import Sensor

STEP_S: Final = 0.01
"""Samples go out in bursts of this length, as from a USB adapter."""
BEHIND_S: Final = 1.0
"""A writer that fell further behind than this goes on from now."""

_log = structlog.get_logger("imu-monitor")


class VirtualImu:
    """One simulated device.

    Args:
        table: model, seed, speed, effects to come, faults
        decoder: the wire format
        name: for the log
    Raises:
        ConfigError: the model or an effect cannot be
    """

    def __init__(self, table: VirtualTable, decoder: Decoder, name: str = "virtual") -> None:
        self.name = name
        self.truth = Truth()
        self.now_s: Callable[[], float] = time.monotonic
        """Clock that the sensor runs by, in seconds. It may be replaced before ``start``."""
        self._sensor = Sensor(table, decoder, name)
        self.rate_hz = self._sensor.rate_hz * table.speed
        """As the sensor states it; its clock may be off."""
        self._pace_hz = self.rate_hz * table.faults.clock
        self._faults = Faults(table.faults, table.seed, decoder.carrier)
        self._away = max(1, round(table.faults.unplugged_for * self._sensor.rate_hz))  # samples
        self._back_at: int | None = None  # sample before which a pulled cable is put back
        self.port = port_of(decoder.carrier, table.silence)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="virtual imu", daemon=True)

    @property
    def link(self) -> Link:
        """What the sensor's samples come by."""
        return self.port.link

    def start(self) -> None:
        """Plug in and begin to send."""
        self.plug()
        self._thread.start()

    def stop(self) -> None:
        """Stop sending and remove the port."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        self.port.close()

    def plug(self) -> None:
        """Put the cable in."""
        self.port.plug()

    def unplug(self) -> None:
        """Pull the cable out."""
        self.port.unplug()

    # --- the sensor's own life

    def _run(self) -> None:
        self._sensor.switch_on()
        begun_s, made = self.now_s(), 0
        step_s = max(STEP_S, 0.5 / self._pace_hz)  # a slow sensor is not looked at more often than twice a sample
        while not self._stop.wait(step_s + self._held_s()):
            due = int((self.now_s() - begun_s) * self._pace_hz)
            late = due - made - int(BEHIND_S * self._pace_hz)
            if late > 0:  # the machine slept: the sensor ran on meanwhile
                made += late
                self._sensor.skip(late)
                self._faults.draw(late)
                self.truth.dropped += late
            if due > made:
                self._live(made, due - made)
                made = due

    def _live(self, first: int, n: int) -> None:
        """Make ``n`` samples, and send those that find a cable."""
        frames, draws = self._sensor.frames(n), self._faults.draw(n)
        at = 0
        while at < n:
            if self._back_at is None:
                pulled = np.flatnonzero(draws.pulled[at:])
                stop = at + int(pulled[0]) if pulled.size else n
                self._send(frames[at:stop], draws[at:stop])
                if stop < n:
                    self._pull(first + stop)
            else:
                stop = min(n, max(at, self._back_at - first))
                self.truth.dropped += stop - at
                if first + stop >= self._back_at:
                    self._put_back()
            at = stop

    def _send(self, frames: list[list[Chunk]], draws: Draws) -> None:
        hurt = [
            (kind, self._faults.hurt(kind, where, chunks))
            for kind, where, chunks in zip(draws.kinds(), draws.where.tolist(), frames, strict=True)
        ]
        gone = self.port.send([chunk for _, chunks in hurt for chunk in chunks])
        for kind, chunks in hurt:
            gone -= len(chunks)
            self.truth.count(kind, out=gone >= 0)

    def _pull(self, index: int) -> None:
        self.unplug()
        self.truth.unplugged += 1
        self._back_at = index + self._away

    def _put_back(self) -> None:
        self._back_at = None
        try:
            self.plug()
        except LinkUnavailable as error:
            _log.warning("the simulated sensor cannot be plugged in again", device=self.name, error=str(error))

    def _held_s(self) -> float:
        held_s = self._faults.hold_s()
        self.truth.held_s = max(self.truth.held_s, held_s)
        return held_s
