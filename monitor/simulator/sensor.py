"""What a simulated sensor measures and says: samples of a model, encoded, with effects that come while it runs.

The sensor's own time is its sample's number over the model's rate: counters and time stamps say it, whatever its true
rate is.
"""

import copy
import time
from pathlib import Path
from typing import Final

import numpy as np
import structlog

from drivers.decoders.base import Decoder
from drivers.errors import ConfigError
from drivers.sample import NO_TICK, Chunk, Counter, Floats, Ints, block
from monitor.noise.catalogue import read_model
from monitor.noise.simulation import ModelStream
from monitor.settings.loading import VirtualTable
from monitor.simulator.scheduled_effects import effects_of

DEFAULT_RATE_HZ: Final = 100.0
ROOM_C: Final = 24.0
WARM_UP_C: Final = 6.0
WARM_UP_S: Final = 300.0
"""Where the model has no temperature, the die warms by WARM_UP_C with this time constant, as after switching on."""

_log = structlog.get_logger("imu-monitor")


def check_sensor(table: VirtualTable) -> None:
    """Check the model and the effects of a simulated sensor; simulates nothing.

    Parameters
    ----------
    table
        Its settings; without a model if ``model`` is empty.

    Raises
    ------
    ConfigError
        With one line for each effect or model that cannot be.
    """
    wrong: list[str] = []
    coming = []
    for text in table.effect:
        try:
            coming += [(text, axis, effect) for axis, effect in effects_of(text)]
        except ConfigError as error:
            wrong += error.lines
    try:
        stream = None
        if table.model:
            model = read_model(Path(table.model))
            stream = model.stream(model.sample_rate_hz or DEFAULT_RATE_HZ, table.seed)
    except ConfigError as error:
        wrong += error.lines
    for text, axis, effect in coming:
        try:
            if stream is not None:
                stream.add(axis, effect)
        except ConfigError as error:
            wrong += [f'effect "{text}": {line}' for line in error.lines]
    if wrong:
        raise ConfigError(*wrong)


class Sensor:
    """One simulated sensor.

    Args:
        table: model, seed, effects to come
        decoder: the wire format; a copy of it encodes
        name: for the log
    Raises:
        ConfigError: the model or an effect cannot be
    """

    def __init__(self, table: VirtualTable, decoder: Decoder, name: str) -> None:
        self._name = name
        self._model = read_model(Path(table.model))
        self.rate_hz = self._model.sample_rate_hz or DEFAULT_RATE_HZ
        self._coming = [(text, axis, effect) for text in table.effect for axis, effect in effects_of(text)]
        self._comes_at = round(table.effect_at * self.rate_hz)  # sample
        self._decoder = copy.deepcopy(decoder)
        self._stream = self._begin(table.seed)
        self._unix_ns = 0  # of the first sample
        self._made = 0
        self._add_to(self._begin(table.seed))  # what cannot be is said here, before anything starts

    def switch_on(self) -> None:
        """Its clock runs from the first sample: what the simulator has to compile comes before it."""
        trial = self._begin(0)
        self._add_to(trial)
        trial.draw_all(1)
        self._unix_ns = time.time_ns()

    def skip(self, n: int) -> None:
        """Samples that nobody will ever ask for: the counter goes on."""
        self._made += n

    def frames(self, n: int) -> list[list[Chunk]]:
        """The chunks of each of the next ``n`` samples."""
        index = np.arange(self._made, self._made + n)
        values, temperature_c = self._measured(n)
        if np.isnan(temperature_c).all():
            temperature_c = ROOM_C + WARM_UP_C * -np.expm1(-index / (self.rate_hz * WARM_UP_S))
        t_ns = self._unix_ns + np.rint(index * (1e9 / self.rate_hz)).astype(np.int64)
        samples = block(t_ns, values, temperature_c, self._ticks(index))
        self._made += n
        if self._decoder.carrier == "messages":  # each sample in a message of its own, as each may have its fault
            return [self._decoder.encode(samples[i : i + 1]) for i in range(n)]
        chunks = self._decoder.encode(samples)
        each = len(chunks) // n
        return [chunks[i * each : (i + 1) * each] for i in range(n)]

    def _measured(self, n: int) -> tuple[Floats, Floats]:
        """Values [n, 6] and temperature [n]; the effects to come are there from their sample on."""
        before = max(self._comes_at - self._made, 0)
        if not self._coming or before >= n:
            drawn = self._stream.draw_all(n)
            return drawn.values, drawn.temperature_c
        parts = [self._stream.draw_all(before)] if before else []
        self._add_to(self._stream)
        at_s = (self._made + before) / self.rate_hz
        for text, axis, _ in self._coming:
            _log.info("effect added", device=self._name, axis=axis, effect=text, at_s=at_s)
        self._coming = []
        parts.append(self._stream.draw_all(n - before))
        return np.concatenate([p.values for p in parts]), np.concatenate([p.temperature_c for p in parts])

    def _begin(self, seed: int) -> ModelStream:
        return self._model.stream(self.rate_hz, seed)

    def _add_to(self, stream: ModelStream) -> None:
        for text, axis, effect in self._coming:
            try:
                stream.add(axis, effect)
            except ConfigError as error:
                raise ConfigError(f'effect "{text}": {error}') from error

    def _ticks(self, index: Ints) -> Ints:
        timing = self._decoder.timing
        if not isinstance(timing, Counter):
            return np.full(index.size, NO_TICK, np.int64)
        ticks = index if timing.tick_s is None else np.rint(index / (self.rate_hz * timing.tick_s)).astype(np.int64)
        result: Ints = ticks % timing.modulus
        return result
