"""A recording from a model: ``simulate``, the twin of ``analyze``.

The model's series is drawn and written block by block, so that memory does not grow with the length. The file has ``t``
(s from 0, at the stated rate), the axes that the model names (others are absent, not zero), and ``temperature`` where
the model or a recording gives one. It appears whole or not at all, and so does the truth beside it: the model, the
seed, and what was drawn from the seed that the samples do not say.
"""

import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from drivers.errors import ConfigError
from drivers.quantities import SAMPLES
from drivers.recordings import Recording, load_samples, writing
from drivers.recordings.writing import whole
from drivers.sample import AXES, Floats
from monitor.noise.model import NoiseModel
from monitor.noise.simulation import Drawn, ModelStream

TRUTH_SCHEMA: Final = "imu-monitor/truth/1"
RESULT_SCHEMA: Final = "imu-monitor/simulate/1"
ROWS: Final = 1 << 16
"""Drawn and written at a time."""

Tell = Callable[[str, float | None], None]
"""Told what is being done, and the share that is done where that is known."""


@dataclass(frozen=True, slots=True)
class Request:
    """What is to be simulated."""

    model: NoiseModel
    out: Path
    seconds: float
    seed: int
    rate_hz: float | None = None  # the model's own unless given
    temperature_from: Path | None = None  # a recording whose temperature is taken instead of the model's
    truth: bool = False
    name: str = "the model"  # for messages


@dataclass(frozen=True, slots=True)
class Result:
    """What was written."""

    out: Path
    samples: int
    rate_hz: float
    seed: int
    axes: tuple[str, ...]
    temperature: bool
    truth: Path | None

    @property
    def seconds(self) -> float:
        """Length of the recording."""
        return self.samples / self.rate_hz

    def text(self) -> str:
        """One line for people."""
        columns = " ".join([*self.axes, *(["temperature"] if self.temperature else [])])
        beside = f"; truth in {self.truth}" if self.truth else ""
        return (
            f"{self.out}: {self.samples} samples at {self.rate_hz:g} Hz, {self.seconds:.6g} s, "
            f"seed {self.seed}: {columns}{beside}"
        )

    def to_json(self) -> bytes:
        """The same for programs."""
        return msgspec.json.encode(
            {
                "schema": RESULT_SCHEMA,
                "out": str(self.out),
                "samples": self.samples,
                "rate": self.rate_hz,
                "seconds": self.seconds,
                "seed": self.seed,
                "axes": self.axes,
                "temperature": self.temperature,
                "truth": None if self.truth is None else str(self.truth),
            }
        )


def make(request: Request, tell: Tell = lambda _what, _share: None) -> Result:
    """Simulate and write.

    Raises:
        ConfigError: no rate, no axis, or what the model cannot do at this rate; a place that cannot be written
        RecordingError: the recording with the temperature is none
    """
    rate_hz = _rate_hz(request)
    n = round(request.seconds * rate_hz)
    try:
        SAMPLES.check(n)
    except ConfigError as error:
        raise ConfigError(f"{request.seconds:g} s at {rate_hz:g} Hz: {error}") from None
    axes = tuple(axis for axis in AXES if axis in request.model.effects)
    if not axes:
        raise ConfigError(f"{request.name}: names no axis; axes are {' '.join(AXES)}")
    tell("preparing", None)
    temperature_c = _temperature(request, rate_hz, n)
    try:
        stream = request.model.stream(rate_hz, request.seed, temperature_c)
    except ConfigError as error:
        raise ConfigError(f"{request.name}: {error}") from error
    first = stream.draw_all(min(n, ROWS))
    temperature = not bool(np.isnan(first.temperature_c).all())
    truth = request.out.with_name(request.out.name + ".truth.json") if request.truth else None
    result = Result(request.out, n, rate_hz, request.seed, axes, temperature, truth)
    if truth is None:
        _write(result, stream, first, tell)
    else:
        with whole(truth) as part:
            _write(result, stream, first, tell)
            part.write_bytes(_truth(result, request.model, stream))
    return result


def _write(result: Result, stream: ModelStream, first: Drawn, tell: Tell) -> None:
    with writing(result.out, result.axes, result.temperature) as append:
        block, written = first, 0
        while True:
            append(np.arange(written, written + len(block.values)) / result.rate_hz, block.values, block.temperature_c)
            written += len(block.values)
            tell("simulating", written / result.samples)
            if written == result.samples:
                break
            block = stream.draw_all(min(ROWS, result.samples - written))
        tell("finishing the file", None)  # an archive is packed only now


def _rate_hz(request: Request) -> float:
    rate_hz = request.rate_hz or request.model.sample_rate_hz
    if rate_hz is None:
        raise ConfigError(f"{request.name}: has no sample_rate; give one with --rate HZ")
    return rate_hz


def _temperature(request: Request, rate_hz: float, n: int) -> Floats | None:
    """[≤ n] °C of the recording at the samples' times, straight lines between its own; None: the model's."""
    if request.temperature_from is None:
        return None
    found = _recorded(request.temperature_from, request.rate_hz)
    known = np.isfinite(found.temperature_c)
    if not known.any():
        raise ConfigError(f"{request.temperature_from}: has no temperature; the column is temperature, in °C")
    t_s = np.arange(len(found)) / (found.rate_hz or rate_hz) if found.t_s is None else found.t_s - found.t_s[0]
    t_s, temperature_c = t_s[known], found.temperature_c[known]
    order = np.argsort(t_s, kind="stable")
    length = min(n, int(t_s.max() * rate_hz) + 1)
    return np.interp(np.arange(length) / rate_hz, t_s[order], temperature_c[order])


def _recorded(path: Path, rate_hz: float | None) -> Recording:
    """At its own rate; where it states none, its rows are as far apart as the samples that ``--rate`` asks for."""
    try:
        return load_samples(path)
    except ConfigError:
        if rate_hz is None:
            raise
        return load_samples(path, rate_hz)


def _truth(result: Result, model: NoiseModel, stream: ModelStream) -> bytes:
    """What the file does not say, as JSON."""
    return msgspec.json.encode(
        {
            "schema": TRUTH_SCHEMA,
            "version": _version(),
            "model": tomllib.loads(model.to_toml()),
            "seed": result.seed,
            "rate": result.rate_hz,
            "seconds": result.seconds,
            "samples": result.samples,
            "axes": result.axes,
            "drawn": stream.truth(),
        }
    )


def _version() -> str | None:
    """Of this program; None where it runs from a folder without being installed."""
    try:
        return version("imu-monitor")
    except PackageNotFoundError:
        return None
