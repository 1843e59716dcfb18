"""Effects hidden in real noise: ``python -m tests.experiments.blind.real``, with IMU_MONITOR_DATA.

Two stretches of one sensor. The program explains the first one as far as it goes; the model that it writes is the one
under test for the second. Real noise differs from stretch to stretch, so the second has names of its own: it is
compared as it is at first, and once more for every effect that is put into it. A name is right where the effect is
told on its axis; of the others those count as false which the stretch without the effect has not.

An effect acts before the converter, and values that were rounded once cannot be rounded again: the recorded values are
spread evenly over their step, the effect is added, the sum is rounded to the step. Sizes are plain beside the white
noise (gain in ln L above 100, though less over the best wrong name), and stand in the table in units of its standard
deviation a sample, s.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):  # before numpy: threads of two programs fight for the cores
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402

from tests.experiments.blind.processes import SOURCES, Clock, Floats, generator  # noqa: E402


@dataclass(frozen=True)
class Sensor:
    """Two stretches of recordings of one sensor."""

    name: str
    first: tuple[str, int, int]  # file, samples from and to: explained first
    second: tuple[str, int, int]  # the same: where effects are hidden
    axes: tuple[str, ...]
    hidden_in: str  # axis


SENSORS: Final = (
    Sensor(
        "adis16405",
        ("adis16405/run1.npz", 400_000, 520_000),
        ("adis16405/run2.npz", 400_000, 520_000),
        ("gx", "gy"),
        "gx",
    ),
    Sensor(
        "mpu6050",
        ("mpu6050-arduino/static-7min.npz", 0, 22_000),
        ("mpu6050-arduino/static-7min.npz", 22_000, 44_000),
        ("gx", "ax"),
        "gx",
    ),
    Sensor(
        "vn100",
        ("vn100-serial/static-12min.npz", 15_000, 22_000),
        ("vn100-serial/static-12min.npz", 22_000, 29_000),
        ("gz", "ax"),
        "gz",
    ),
)

TIME_LIMIT_S: Final = 600.0
FINE: Final = 0.01
"""Of the deviation: steps below that are decimals of a text, no converter's."""
Parameters = dict[str, Any]
Sizes = Callable[[float, int, float], Parameters]
"""Of standard deviation a sample, samples and rate to the parameters of an effect."""


def _line(s: float, n: int, rate_hz: float) -> Parameters:
    return {"amplitude": 2.0 * s * (200.0 / n) ** 0.5, "frequency": 0.0731 * rate_hz, "phase": 1.0}


def _resonance(s: float, n: int, rate_hz: float) -> Parameters:
    return {"sigma": 0.4 * s, "frequency": 0.1337 * rate_hz, "bandwidth": 0.01 * rate_hz}


def _correlated(s: float, n: int, rate_hz: float) -> Parameters:
    return {"sigma": 0.4 * s, "correlation_time": 60.0 / rate_hz}


def _telegraph(s: float, n: int, rate_hz: float) -> Parameters:
    return {"amplitude": s, "dwell_time": 300.0 / rate_hz}


def _far(s: float, n: int, rate_hz: float) -> Parameters:
    return {"fraction": 1.5e-3, "scale": 8.0 * s}


def _step(s: float, n: int, rate_hz: float) -> Parameters:
    return {"time": 0.4 * n / rate_hz, "height": 0.6 * s}


def _slope(s: float, n: int, rate_hz: float) -> Parameters:
    return {"R": 0.8 * s * rate_hz / n}


def _transient(s: float, n: int, rate_hz: float) -> Parameters:
    return {"amplitude": 1.0 * s, "time_constant": 0.07 * n / rate_hz}


HIDDEN: Final[dict[str, Sizes]] = {
    "sinusoidal": _line,
    "narrowband": _resonance,
    "exponentially_correlated": _correlated,
    "random_telegraph": _telegraph,
    "outliers": _far,
    "bias_step": _step,
    "rate_ramp": _slope,
    "turn_on_transient": _transient,
}


@dataclass(frozen=True)
class Told:
    """What the program said of one recording."""

    verdict: str
    names: tuple[tuple[str, str, float], ...]  # axis, effect, confidence, of what was added
    seconds: float

    def beyond(self, other: "Told") -> list[tuple[str, str, float]]:
        """Names that ``other`` has not."""
        known = [(axis, effect) for axis, effect, _ in other.names]
        found = []
        for axis, effect, confidence in self.names:
            if (axis, effect) in known:
                known.remove((axis, effect))
            else:
                found.append((axis, effect, confidence))
        return found


def columns(data: Path, place: tuple[str, int, int], axes: Sequence[str]) -> tuple[dict[str, Floats], float]:
    """Axes of a stretch, and its sample rate."""
    file, begin, end = place
    with np.load(data / file) as held:
        return {axis: held[axis][begin:end].astype(np.float64) for axis in axes}, float(held["fs"])


def with_effect(values: Floats, rate_hz: float, name: str, seed: int) -> tuple[Floats, Parameters]:
    """Values [n] with an effect, on the grid that they were on, and its parameters."""
    rng = generator(seed, "hidden in real noise", name)
    step = float(np.median(np.diff(np.unique(values))))
    s = float(np.std(np.diff(values))) / 2.0**0.5
    parameters = HIDDEN[name](s, values.size, rate_hz)
    effect = SOURCES[name](Clock(values.size, rate_hz), rng, **parameters)
    if step < FINE * s:
        return values + effect, {**parameters, "s": s}
    spread = values + step * (rng.random(values.size) - 0.5)
    origin = values[0]
    return origin + step * np.rint((spread + effect - origin) / step), {**parameters, "s": s}


def compare(folder: Path, held: dict[str, Floats], rate_hz: float, model: Path | None) -> Told:
    """The program on a recording, as a user runs it."""
    folder.mkdir(parents=True)
    recording, out = folder / "recording.npz", folder / "out"
    np.savez(recording, fs=np.float64(rate_hz), **held)  # type: ignore[arg-type]
    under_test = ["--model", str(model)] if model else []
    begin = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "monitor.cli", "reconcile", str(recording), *under_test, "--out", str(out)],
        capture_output=True,
        text=True,
        timeout=TIME_LIMIT_S,
        check=False,
    )
    seconds = time.perf_counter() - begin
    if done.returncode != 0:
        raise RuntimeError(f"exit status {done.returncode}: {done.stderr.strip()[-500:]}")
    report = json.loads((out / "report.json").read_text())
    names = [
        (axis, step["effect"], step["confidence"])
        for axis, result in report["axes"].items()
        for step in result["steps"]
        if step["kind"] == "added"
    ]
    return Told(report["verdict"], tuple(names), seconds)


def rows(data: Path, sensor: Sensor, seed: int, only: Sequence[str]) -> list[tuple[str, bool, int]]:
    """One row of the table for each effect: its text, whether the name is right, and how many names are false."""
    found = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        first, rate_hz = columns(data, sensor.first, sensor.axes)
        compare(folder / "first", first, rate_hz, None)
        model = folder / "first" / "out" / "model.toml"
        second, rate_hz = columns(data, sensor.second, sensor.axes)
        bare = compare(folder / "second", second, rate_hz, model)
        print(_row(sensor.name, "nothing", "", bare.verdict, bare.names, bare.seconds), flush=True)
        for name in only or HIDDEN:
            changed, parameters = with_effect(second[sensor.hidden_in], rate_hz, name, seed)
            told = compare(folder / name, {**second, sensor.hidden_in: changed}, rate_hz, model)
            new = told.beyond(bare)
            right = any((axis, effect) == (sensor.hidden_in, name) for axis, effect, _ in new)
            text = _row(sensor.name, name, _sizes(parameters), told.verdict, new, told.seconds)
            print(text, flush=True)
            found.append((text, right, len(new) - right))
    return found


def _sizes(parameters: Parameters) -> str:
    """In s, s.d. of a sample; Hz and s."""
    s = parameters["s"]
    sized = {"amplitude", "sigma", "scale", "height"}
    parts = [f"{k} {v / s:.2g} s" if k in sized else f"{k} {v:.3g}" for k, v in parameters.items() if k != "s"]
    return ", ".join(parts)


def _row(sensor: str, effect: str, sizes: str, verdict: str, new: Sequence[tuple[str, str, float]], took: float) -> str:
    said = ", ".join(f"{axis} {name} ({confidence:.3f})" for axis, name, confidence in new) or "no name"
    return f"| {sensor} | {effect} | {sizes} | {said} | {verdict} | {took:.1f} |"


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.experiments.blind.real", description="Effects hidden in real noise."
    )
    parser.add_argument("--sensor", nargs="+", choices=[one.name for one in SENSORS], default=(), help="only these")
    parser.add_argument("--only", nargs="+", choices=list(HIDDEN), default=(), metavar="EFFECT", help="only these")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    if "IMU_MONITOR_DATA" not in os.environ:
        parser.error("IMU_MONITOR_DATA does not point to the recordings")
    data = Path(os.environ["IMU_MONITOR_DATA"])
    print("| recording | hidden | size | names beyond those without it | verdict | s |\n|---|---|---|---|---|---|")
    found = [
        one
        for sensor in SENSORS
        if not options.sensor or sensor.name in options.sensor
        for one in rows(data, sensor, options.seed, options.only)
    ]
    right, false = sum(one[1] for one in found), sum(one[2] for one in found)
    print(f"\n{right} of {len(found)} named right; {false} false names.")


if __name__ == "__main__":
    main()
