"""Effects hidden in real noise: ``python -m tests.experiments.blind.real``, with IMU_MONITOR_DATA.

Each sensor has two parts of its recordings. ``reconcile`` explains the first part and writes a model. The second part
is compared with this model, first without a hidden effect and then with each effect. A name is right if it is the
hidden effect on its axis. Other names count as false if they do not occur without the hidden effect.

An effect acts before the converter of the sensor, and recorded values are already rounded. The recorded values are
therefore spread evenly over their step, the effect is applied, and the result is rounded to the step. Effects that
need a temperature are left out, because these recordings have none. Terms that the model of the sensor contains anyway
are left out too, as well as effects that real noise cannot be given afterwards (``heavy_tails``, ``resolution``,
``sample_rate_error``). A noise step and a modulation act on the deviations from a running mean. The effects are large
compared with the white noise: the gain in ln L is above 100, and less over the best wrong name. The table contains the
sizes in units of the standard deviation s of a sample.
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

# set before NumPy is imported, so that programs do not compete for the cores
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402

from monitor.noise.effect import Source  # noqa: E402
from monitor.noise.model import NoiseModel  # noqa: E402
from monitor.noise.model_loading import load_model  # noqa: E402
from tests.experiments.blind.processes import SOURCES, TRANSFORMS, Clock, Floats, generator, modulated, wandering_gain  # noqa: E402


@dataclass(frozen=True)
class Sensor:
    """Two parts of recordings of one sensor."""

    name: str
    first: tuple[str, int, int]  # file, first and last sample: part for the fit of the model
    second: tuple[str, int, int]  # file, first and last sample: part with hidden effects
    axes: tuple[str, ...]
    hidden_axis: str


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
MIN_STEP_SHARE: Final = 0.01
"""Smaller steps, relative to the standard deviation, come from decimals of a text and not from a converter."""
Parameters = dict[str, Any]
Sizes = Callable[[float, int, float], Parameters]
"""Function from standard deviation, number of samples and rate in Hz to the parameters of an effect."""


def _line(s: float, n: int, rate_hz: float) -> Parameters:
    return {"amplitude": 2.0 * s * (200.0 / n) ** 0.5, "frequency": 0.0731 * rate_hz, "phase": 1.0}


def _resonance(s: float, n: int, rate_hz: float) -> Parameters:
    return {"sigma": 0.4 * s, "frequency": 0.1337 * rate_hz, "bandwidth": 0.01 * rate_hz}


def _correlated(s: float, n: int, rate_hz: float) -> Parameters:
    return {"sigma": 0.4 * s, "correlation_time": 60.0 / rate_hz}


def _telegraph(s: float, n: int, rate_hz: float) -> Parameters:
    return {"amplitude": s, "dwell_time": 300.0 / rate_hz}


def _outliers(s: float, n: int, rate_hz: float) -> Parameters:
    return {"fraction": 1.5e-3, "scale": 8.0 * s}


def _step(s: float, n: int, rate_hz: float) -> Parameters:
    return {"time": 0.4 * n / rate_hz, "height": 0.6 * s}


def _slope(s: float, n: int, rate_hz: float) -> Parameters:
    return {"R": 0.8 * s * rate_hz / n}


def _transient(s: float, n: int, rate_hz: float) -> Parameters:
    return {"amplitude": 1.0 * s, "time_constant": 0.07 * n / rate_hz}


def _wandering_line(s: float, n: int, rate_hz: float) -> Parameters:
    return {
        "amplitude": 0.5 * s,
        "frequency": 0.0931 * rate_hz,
        "frequency_deviation": 2e-3 * rate_hz,
        "correlation_time": 2000.0 / rate_hz,
        "phase": 1.0,
    }


def _power_law(s: float, n: int, rate_hz: float) -> Parameters:
    """Return noise with the density of the white noise at one hundredth of the sample rate."""
    return {"density": s / rate_hz**0.5 * (0.01 * rate_hz) ** 0.75, "exponent": 1.5}


def _poisson_steps(s: float, n: int, rate_hz: float) -> Parameters:
    return {"rate": 20.0 * rate_hz / n, "height": 0.6 * s}


def _pulses(s: float, n: int, rate_hz: float) -> Parameters:
    return {"height": 0.6 * s, "period": 100.0 / rate_hz, "width": 10.0 / rate_hz, "delay": 33.0 / rate_hz}


def _curve(s: float, n: int, rate_hz: float) -> Parameters:
    return {"slope": 0.0, "curvature": 1.5 * s * (rate_hz / n) ** 2}


def _noise_step(s: float, n: int, rate_hz: float) -> Parameters:
    return {"time": 0.6 * n / rate_hz, "ratio": 1.3}


def _modulation(s: float, n: int, rate_hz: float) -> Parameters:
    return {"depth": 0.5, "period": 0.07 * n / rate_hz, "phase": 1.0}


HIDDEN: Final[dict[str, Sizes]] = {
    "sinusoidal": _line,
    "narrowband": _resonance,
    "exponentially_correlated": _correlated,
    "random_telegraph": _telegraph,
    "outliers": _outliers,
    "bias_step": _step,
    "rate_ramp": _slope,
    "turn_on_transient": _transient,
    "wandering_line": _wandering_line,
    "power_law": _power_law,
    "poisson_steps": _poisson_steps,
    "pulse_train": _pulses,
    "bias_curve": _curve,
    "noise_step": _noise_step,
    "variance_modulation": _modulation,
    "wandering_variance": lambda s, n, rate_hz: {"deviation": 0.7, "correlation_time": 0.02 * n / rate_hz},
    "bandwidth_limit": lambda s, n, rate_hz: {"cutoff": 0.15 * rate_hz, "order": 2},
    "sample_hold": lambda s, n, rate_hz: {"fraction": 0.03},
    "scale_factor": lambda s, n, rate_hz: {"factor": 1.3},
    "leak": lambda s, n, rate_hz: {"coefficient": 0.25},
}
LEAK_NAMES: Final = ("cross_axis", "g_sensitivity")
"""Names of a leak from an axis of the same kind, and from an axis of the other kind."""
MEAN_SAMPLES: Final = 65
"""Number of samples of the running mean whose deviations a noise step or a modulation changes."""


@dataclass(frozen=True)
class ReconcileAnswer:
    """Answer of the program to one recording."""

    verdict: str
    names: tuple[tuple[str, str, float], ...]  # axis, effect and confidence of the added effects
    seconds: float
    resized: tuple[tuple[str, str], ...] = ()  # axis and effect of the model's effects with a new size

    def names_not_in(self, other: "ReconcileAnswer") -> list[tuple[str, str, float]]:
        """Return the names that another answer does not contain."""
        known = [(axis, effect) for axis, effect, _ in other.names]
        found = []
        for axis, effect, confidence in self.names:
            if (axis, effect) in known:
                known.remove((axis, effect))
            else:
                found.append((axis, effect, confidence))
        return found


def load_columns(data: Path, place: tuple[str, int, int], axes: Sequence[str]) -> tuple[dict[str, Floats], float]:
    """Return the axes of a part of a recording, and its sample rate in Hz."""
    file, begin, end = place
    with np.load(data / file) as columns:
        return {axis: columns[axis][begin:end].astype(np.float64) for axis in axes}, float(columns["fs"])


def add_effect(values: Floats, other_axis: Floats, rate_hz: float, name: str, seed: int) -> tuple[Floats, Parameters]:
    """Return values [n] with an effect, rounded to their original step, and the parameters of the effect."""
    rng = generator(seed, "hidden in real noise", name)
    step = float(np.median(np.diff(np.unique(values))))
    s = white_deviation(values)
    parameters = HIDDEN[name](s, values.size, rate_hz)
    if name == "leak":  # the coefficient is relative to the noise of both axes
        parameters["coefficient"] *= s / white_deviation(other_axis)
    if step < MIN_STEP_SHARE * s:
        return apply_effect(values, other_axis, rate_hz, name, rng, parameters), {**parameters, "s": s}
    spread = values + step * (rng.random(values.size) - 0.5)
    changed, origin = apply_effect(spread, other_axis, rate_hz, name, rng, parameters), values[0]
    return origin + step * np.rint((changed - origin) / step), {**parameters, "s": s}


def white_deviation(values: Floats) -> float:
    """Return the standard deviation of a sample of the white noise."""
    return float(np.std(np.diff(values))) / 2.0**0.5


def apply_effect(
    values: Floats, other_axis: Floats, rate_hz: float, name: str, rng: np.random.Generator, parameters: Parameters
) -> Floats:
    """Return values [n] with an effect."""
    clock = Clock(values.size, rate_hz)
    if name in SOURCES:
        return values + SOURCES[name](clock, rng, **parameters)
    if name in TRANSFORMS:
        return TRANSFORMS[name](values, rate_hz, rng, **parameters)
    if name == "leak":
        return values + parameters["coefficient"] * (other_axis - other_axis.mean())
    mean = np.convolve(np.pad(values, MEAN_SAMPLES // 2, "reflect"), np.full(MEAN_SAMPLES, 1.0 / MEAN_SAMPLES), "valid")
    if name == "noise_step":
        level = np.where(clock.t_s >= parameters["time"], parameters["ratio"], 1.0)
    elif name == "wandering_variance":
        level = wandering_gain(clock, rng, **parameters)
    else:
        level = np.sqrt(modulated(clock, **parameters))
    return mean + level * (values - mean)


def run_reconcile(folder: Path, columns: dict[str, Floats], rate_hz: float, model: Path | None) -> ReconcileAnswer:
    """Run the command on a recording and return its answer."""
    folder.mkdir(parents=True)
    recording, out = folder / "recording.npz", folder / "out"
    np.savez(recording, fs=np.float64(rate_hz), **columns)  # type: ignore[arg-type]
    options = ["--model", str(model)] if model else []
    begin = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "imu_monitor", "reconcile", str(recording), *options, "--out", str(out)],
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
    resized = [
        (axis, step["effect"])
        for axis, result in report["axes"].items()
        for step in result["steps"]
        if step["kind"] == "retuned"
    ]
    return ReconcileAnswer(report["verdict"], tuple(names), seconds, tuple(resized))


def run_sensor(data: Path, sensor: Sensor, seed: int, only: Sequence[str]) -> list[tuple[str, bool, int]]:
    """Return a row for each effect: its text, True if the name is right, and the number of false names."""
    found = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        first, rate_hz = load_columns(data, sensor.first, sensor.axes)
        run_reconcile(folder / "first", first, rate_hz, None)
        model = folder / "first" / "out" / "model.toml"
        only_noise = find_only_noise(load_model(str(model), folder), sensor.hidden_axis)
        second, rate_hz = load_columns(data, sensor.second, sensor.axes)
        without_effect = run_reconcile(folder / "second", second, rate_hz, model)
        print(
            _format_row(
                sensor.name, "nothing", "", without_effect.verdict, without_effect.names, without_effect.seconds
            ),
            flush=True,
        )
        for name in only or HIDDEN:
            (other_axis,) = (axis for axis in sensor.axes if axis != sensor.hidden_axis)
            changed, parameters = add_effect(second[sensor.hidden_axis], second[other_axis], rate_hz, name, seed)
            answer = run_reconcile(folder / name, {**second, sensor.hidden_axis: changed}, rate_hz, model)
            added = answer.names_not_in(without_effect)
            expected = LEAK_NAMES[other_axis[0] != sensor.hidden_axis[0]] if name == "leak" else name
            right = any((axis, effect) == (sensor.hidden_axis, expected) for axis, effect, _ in added)
            named = right
            if name == "scale_factor" and only_noise is not None:
                right = right or (sensor.hidden_axis, only_noise) in answer.resized
            if name in (
                "bandwidth_limit",
                "leak",
            ):  # beside a filter or leak of the model, the sum has other parameters
                right = right or (sensor.hidden_axis, expected) in answer.resized
            text = _format_row(sensor.name, name, _format_sizes(parameters), answer.verdict, added, answer.seconds)
            print(text, flush=True)
            found.append((text, right, len(added) - named))
    return found


def find_only_noise(model: NoiseModel, axis: str) -> str | None:
    """Return the name of the noise effect of an axis, or None if the axis has several noise effects.

    A factor of the only noise effect and a new size of this effect are the same model, so both answers are right.
    """
    noises = [effect.name for effect in model.effects[axis] if isinstance(effect, Source)]
    return noises[0] if len(noises) == 1 else None


def _format_sizes(parameters: Parameters) -> str:
    """Return the parameters as text, with amplitudes in units of s."""
    s = parameters["s"]
    sized = {"amplitude", "sigma", "scale", "height"}
    parts = [f"{k} {v / s:.2g} s" if k in sized else f"{k} {v:.3g}" for k, v in parameters.items() if k != "s"]
    return ", ".join(parts)


def _format_row(
    sensor: str, effect: str, sizes: str, verdict: str, added: Sequence[tuple[str, str, float]], took: float
) -> str:
    names = ", ".join(f"{axis} {name} ({confidence:.3f})" for axis, name, confidence in added) or "no name"
    return f"| {sensor} | {effect} | {sizes} | {names} | {verdict} | {took:.1f} |"


def main() -> None:
    """Run all sensors and print the table."""
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
    print("| recording | hidden | size | additional names | verdict | s |\n|---|---|---|---|---|---|")
    found = [
        one
        for sensor in SENSORS
        if not options.sensor or sensor.name in options.sensor
        for one in run_sensor(data, sensor, options.seed, options.only)
    ]
    right, false = sum(one[1] for one in found), sum(one[2] for one in found)
    print(f"\n{right} of {len(found)} named right; {false} false names.")


if __name__ == "__main__":
    main()
