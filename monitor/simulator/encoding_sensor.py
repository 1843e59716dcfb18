"""Simulated sensor, which encodes samples of a noise model in the wire format of a decoder.

Counters and time stamps follow the nominal sample rate of the noise model, even if samples are sent at another rate.
"""

import copy
import time
from pathlib import Path
from typing import Final

import numpy as np
import structlog

from drivers.data_types import NO_TICK, Chunk, CounterTimedFormat, Floats, Ints, make_block
from drivers.decoders.base import Decoder
from drivers.errors import ConfigError
from monitor.noise.model_loading import read_model
from monitor.noise.simulation import ModelStream
from monitor.settings.loading import VirtualTable
from monitor.simulator.effect_option_parser import parse_effects

DEFAULT_RATE_HZ: Final = 100.0
"""Sample rate in Hz if the noise model does not state a sample rate."""
AMBIENT_C: Final = 24.0
"""Initial temperature in °C if the noise model does not include the temperature."""
WARM_UP_C: Final = 6.0
"""Final temperature rise in °C if the noise model does not include the temperature."""
WARM_UP_S: Final = 300.0
"""Time constant of the temperature rise in s."""

_log = structlog.get_logger("imu-monitor")


def check_noise_model_and_effects(table: VirtualTable) -> None:
    """Check the noise model and the effects of a simulated sensor. An empty ``model`` is not checked.

    Raises
    ------
    ConfigError
        If the noise model or an effect is invalid. The message has one line per mistake.
    """
    wrong: list[str] = []
    coming = []
    for text in table.effect:
        try:
            coming += [(text, axis, effect) for axis, effect in parse_effects(text)]
        except ConfigError as error:
            wrong += error.mistake_lines
    try:
        stream = None
        if table.model:
            model = read_model(Path(table.model))
            stream = model.start_stream(model.sample_rate_hz or DEFAULT_RATE_HZ, table.seed)
    except ConfigError as error:
        wrong += error.mistake_lines
    for text, axis, effect in coming:
        try:
            if stream is not None:
                stream.add_effect(axis, effect)
        except ConfigError as error:
            wrong += [f'effect "{text}": {line}' for line in error.mistake_lines]
    if wrong:
        raise ConfigError(*wrong)


class SimulatedSensor:
    """Simulated sensor that generates encoded samples.

    Parameters
    ----------
    table : VirtualTable
        Noise model, seed and effects.
    decoder : Decoder
        Decoder of the wire format, used to encode samples.
    name : str
        Name of the device in log messages.

    Raises
    ------
    ConfigError
        If the noise model or an effect is invalid.
    """

    def __init__(self, table: VirtualTable, decoder: Decoder, name: str) -> None:
        check_noise_model_and_effects(table)
        self._name = name
        self._model = read_model(Path(table.model))
        self.rate_hz = self._model.sample_rate_hz or DEFAULT_RATE_HZ
        self._pending_effects = [(text, axis, effect) for text in table.effect for axis, effect in parse_effects(text)]
        # number of the sample at which the effects begin
        self._effects_begin_at = round(table.effect_at * self.rate_hz)
        self._decoder = copy.deepcopy(decoder)
        self._stream = self._create_stream(table.seed)
        self._unix_ns = 0  # time of the first sample
        self._made = 0

    def compile_kernels_and_start_clock(self) -> None:
        """Compile the simulation kernels, and start the clock of the sensor."""
        trial = self._create_stream(0)
        self._add_effects(trial)
        trial.draw_samples_with_temperature(1)
        self._unix_ns = time.time_ns()

    def skip_samples(self, n: int) -> None:
        """Skip ``n`` samples. The sample counter of the sensor continues."""
        self._made += n

    def encode_next_samples(self, n: int) -> list[list[Chunk]]:
        """Simulate and encode the next ``n`` samples. Return a list of chunks for each sample."""
        index = np.arange(self._made, self._made + n)
        values, temperature_c = self._measured(n)
        if np.isnan(temperature_c).all():
            temperature_c = AMBIENT_C + WARM_UP_C * -np.expm1(-index / (self.rate_hz * WARM_UP_S))
        t_ns = self._unix_ns + np.rint(index * (1e9 / self.rate_hz)).astype(np.int64)
        samples = make_block(t_ns, values, temperature_c, self._ticks(index))
        self._made += n
        if self._decoder.carrier == "messages":  # one message per sample, because each sample may have a fault
            return [self._decoder.encode(samples[i : i + 1]) for i in range(n)]
        chunks = self._decoder.encode(samples)
        each = len(chunks) // n
        return [chunks[i * each : (i + 1) * each] for i in range(n)]

    def _measured(self, n: int) -> tuple[Floats, Floats]:
        """Simulate values [n, 6] and temperature [n] of the next samples, including effects that have begun."""
        before = max(self._effects_begin_at - self._made, 0)
        if not self._pending_effects or before >= n:
            drawn = self._stream.draw_samples_with_temperature(n)
            return drawn.values, drawn.temperature_c
        parts = [self._stream.draw_samples_with_temperature(before)] if before else []
        self._add_effects(self._stream)
        at_s = (self._made + before) / self.rate_hz
        for text, axis, _ in self._pending_effects:
            _log.info("effect added", device=self._name, axis=axis, effect=text, at_s=at_s)
        self._pending_effects = []
        parts.append(self._stream.draw_samples_with_temperature(n - before))
        return np.concatenate([p.values for p in parts]), np.concatenate([p.temperature_c for p in parts])

    def _create_stream(self, seed: int) -> ModelStream:
        return self._model.start_stream(self.rate_hz, seed)

    def _add_effects(self, stream: ModelStream) -> None:
        """Add the pending effects to a simulated stream."""
        for _, axis, effect in self._pending_effects:
            stream.add_effect(axis, effect)

    def _ticks(self, index: Ints) -> Ints:
        timing = self._decoder.timing
        if not isinstance(timing, CounterTimedFormat):
            return np.full(index.size, NO_TICK, np.int64)
        ticks = index if timing.tick_s is None else np.rint(index / (self.rate_hz * timing.tick_s)).astype(np.int64)
        result: Ints = ticks % timing.modulus
        return result
