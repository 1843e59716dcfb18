"""A simulated IMU that speaks a real wire format over a pseudo-terminal, in real time or faster.

The noise model's endless series goes through a decoder's ``encode`` into the master side of a pseudo-terminal; the
ordinary serial link reads the other side and cannot tell it from a sensor. A device does not wait for its reader:
what does not fit into the terminal's buffer is dropped, and its counter shows it. ``unplug`` and ``plug`` pull the
cable and put it back; a link in a temporary folder keeps the port's name the same.
"""

import contextlib
import copy
import os
import select
import shutil
import tempfile
import threading
import time
from pathlib import Path
from typing import Final

import numpy as np

from drivers.decoders.base import Decoder
from drivers.errors import ConfigError
from drivers.links import serial_link
from drivers.sample import NO_TICK, Counter, Floats, Ints, block
from monitor.noise.model import NoiseModel
from monitor.settings import VirtualTable

STEP_S: Final = 0.01
"""Samples go out in bursts of this length, as from a USB adapter."""
BEHIND_S: Final = 1.0
"""A writer that fell further behind than this goes on from now."""
DEFAULT_RATE_HZ: Final = 100.0
ROOM_C: Final = 24.0
WARM_UP_C: Final = 6.0
WARM_UP_S: Final = 300.0
"""The simulated die warms by WARM_UP_C with this time constant, as a small sensor does after it is switched on."""


class VirtualImu:
    """One simulated device.

    Args:
        table: model, seed and speed
        decoder: the wire format; a copy of it encodes
    Raises:
        ConfigError: the model cannot be read
    """

    def __init__(self, table: VirtualTable, decoder: Decoder) -> None:
        self.model = read_model(Path(table.model))
        self.rate_hz = (self.model.sample_rate_hz or DEFAULT_RATE_HZ) * table.speed
        self.sent = 0  # samples written in full
        self.dropped = 0  # samples that did not fit, or found no cable
        self._decoder = copy.deepcopy(decoder)
        self._stream = self.model.stream(self.model.sample_rate_hz or DEFAULT_RATE_HZ, table.seed)
        self._tick_s = 1.0 / (self.model.sample_rate_hz or DEFAULT_RATE_HZ)
        self._folder = Path(tempfile.mkdtemp(prefix="imu-monitor-"))
        self.port = self._folder / "tty"
        settings = serial_link.Settings(port=str(self.port), baudrate=921600, silence=table.silence)
        self.link = serial_link.build(settings)
        self._master: int | None = None
        self._plugging = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="virtual imu", daemon=True)

    def start(self) -> None:
        """Plug in and begin to send."""
        self.plug()
        self._thread.start()

    def stop(self) -> None:
        """Stop sending and remove the port."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        self.unplug()
        shutil.rmtree(self._folder, ignore_errors=True)

    def plug(self) -> None:
        """Make the port appear."""
        import tty

        with self._plugging:
            if self._master is not None:
                return
            master, slave = os.openpty()
            tty.setraw(master)
            tty.setraw(slave)
            os.set_blocking(master, False)
            self.port.unlink(missing_ok=True)
            self.port.symlink_to(os.ttyname(slave))
            os.close(slave)
            self._master = master

    def unplug(self) -> None:
        """Make the port go away, as a pulled cable does."""
        with self._plugging:
            master, self._master = self._master, None
            self.port.unlink(missing_ok=True)
            if master is not None:
                os.close(master)

    # --- the sensor's own life

    def _run(self) -> None:
        # a sensor's clock runs from its first sample: what the simulator compiles comes before it
        self.model.stream(1.0 / self._tick_s, 0).draw(1)
        begun_s, made = time.monotonic(), 0
        while not self._stop.wait(STEP_S):
            due = int((time.monotonic() - begun_s) * self.rate_hz)
            late = due - made - int(BEHIND_S * self.rate_hz)
            if late > 0:  # the machine slept: the sensor ran on meanwhile
                made += late
                self.dropped += late
            if due > made:
                self._send(made, due - made)
                made = due

    def _send(self, first: int, n: int) -> None:
        index = np.arange(first, first + n)
        values = self._stream.draw(n)
        samples = block(np.zeros(n, np.int64), values, self._temperature(index), self._ticks(index))
        frames = [chunk.data for chunk in self._decoder.encode(samples)]
        written = self._write(b"".join(frames))
        whole = int(np.searchsorted(np.cumsum([len(frame) for frame in frames]), written, "right"))
        self.sent += whole
        self.dropped += n - whole

    def _write(self, data: bytes) -> int:
        """Bytes that went out; what has begun is finished as long as anyone reads."""
        view = memoryview(data)
        with self._plugging, contextlib.suppress(BlockingIOError):
            while view and self._master is not None:
                if not select.select([], [self._master], [], STEP_S)[1]:
                    break
                view = view[os.write(self._master, view) :]
        return len(data) - len(view)

    def _temperature(self, index: Ints) -> Floats:
        result: Floats = ROOM_C + WARM_UP_C * -np.expm1(-index * self._tick_s / WARM_UP_S)
        return result

    def _ticks(self, index: Ints) -> Ints:
        timing = self._decoder.timing
        if not isinstance(timing, Counter):
            return np.full(index.size, NO_TICK, np.int64)
        ticks = index if timing.tick_s is None else np.rint(index * self._tick_s / timing.tick_s).astype(np.int64)
        result: Ints = ticks % timing.modulus
        return result


def read_model(path: Path) -> NoiseModel:
    """The model in a file.

    Raises:
        ConfigError: one line: the file, the place in it, what is wrong
    """
    try:
        return NoiseModel.from_toml(path.read_text("utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
