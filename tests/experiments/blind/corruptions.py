"""Faults added to real recordings: ``python -m tests.experiments.blind.corruptions``, with IMU_MONITOR_DATA.

Each sensor has two parts: two runs, or two halves of one run. ``reconcile`` fits a model to the first part. A random
fault is added to the second part, and ``reconcile`` compares the faulty part with the model. A case is right if the
first finding of the report names the fault and the axes with the right factor, order or time. The second part is also
compared without a fault, and the findings are printed for inspection.

Only axes with different spectra can be distinguished. The axes to swap are therefore selected by the Welch spectra of
both parts, without code of the program. A swap is allowed if the swapped axes differ more than three times as much as
the two parts of the same axis.

A wrong sample rate can be found only if features keep their frequencies between both parts. ``RATE_SENSORS`` lists the
sensors with such features in the Welch spectra.
"""

import argparse
import os
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

# set before NumPy is imported, so that programs do not compete for the cores
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402
from scipy.signal import welch  # noqa: E402

from drivers.data_types import AXES, Floats  # noqa: E402
from monitor.noise.effects import ConstantBias  # noqa: E402
from monitor.noise.model import NoiseModel  # noqa: E402
from monitor.reconcile.likelihood.axis_fit import RegressorCache  # noqa: E402
from monitor.reconcile.preparation.reconcile_input import RecordedAxes, select_axes_and_smooth_temperature  # noqa: E402
from monitor.reconcile.reconcile import reconcile  # noqa: E402
from monitor.reconcile.recording_checks.checks import check_recording, sort_findings  # noqa: E402
from monitor.reconcile.recording_checks.sample_rate_from_features import (  # noqa: E402
    describe_sample_rate_error,
    estimate_sample_rate_error,
)
from monitor.reconcile.result import RecordingFinding  # noqa: E402
from monitor.reconcile.search.sample_rate_from_spectrum import detect_sample_rate_error  # noqa: E402
from monitor.reconcile.search.sample_repair import build_repaired_axes  # noqa: E402


@dataclass(frozen=True)
class Sensor:
    """Two parts of recordings of one sensor."""

    name: str
    first: tuple[str, int, int]  # file, first and last sample: part for the fit of the model
    second: tuple[str, int, int]  # file, first and last sample: part with the faults


SENSORS: Final = (
    Sensor("adis16405-run2", ("adis16405/run1.npz", 400_000, 460_000), ("adis16405/run2.npz", 400_000, 460_000)),
    Sensor("adis16405-run6", ("adis16405/run1.npz", 400_000, 460_000), ("adis16405/run6.npz", 600_000, 660_000)),
    Sensor(
        "mpu6050-arduino",
        ("mpu6050-arduino/static-7min.npz", 0, 22_000),
        ("mpu6050-arduino/static-7min.npz", 22_000, 44_000),
    ),
    Sensor(
        "mpu6050-hosttime",
        ("mpu6050-hosttime/static-11min.npz", 0, 32_000),
        ("mpu6050-hosttime/static-11min.npz", 32_000, 64_000),
    ),
    Sensor("vn100", ("vn100-serial/static-12min.npz", 0, 15_000), ("vn100-serial/static-12min.npz", 15_000, 30_000)),
    Sensor("px4", ("px4-bench/bench-69s.npz", 2_000, 9_500), ("px4-bench/bench-69s.npz", 9_500, 17_000)),
    Sensor("ig500n", ("ig500n/static-2h.npz", 0, 18_000), ("ig500n/static-2h.npz", 18_000, 36_000)),
)
RATE_SENSORS: Final = ("mpu6050-arduino", "mpu6050-hosttime", "vn100", "px4")
"""Sensors with features that keep their frequencies."""
TRIADS: Final = (AXES[:3], AXES[3:])
UNITS: Final = {
    "g": (np.pi / 180.0, 180.0 / np.pi, 1000.0, 0.001, 2.0, 0.5, 4.0),
    "a": (9.80665, 1.0 / 9.80665, 1000.0, 0.001, 2.0, 0.5, 4.0),
}
"""Factors of wrong units by the first letter of the axes."""
FAULTS: Final = ("unit", "swap", "rate", "knocks", "drop-out", "spike row", "stuck axis", "first row")
CASES: Final = 100


@dataclass(frozen=True)
class Case:
    """Recording with one fault, and the finding that names the fault."""

    sensor: str
    fault: str
    detail: str
    recording: RecordedAxes
    kinds: tuple[str, ...]  # kinds of findings that are right
    axes: tuple[str, ...] = ()  # axes that the finding must name; empty = any
    expected: dict[str, tuple[float, float]] = field(default_factory=dict)  # parameter -> value, relative tolerance


@dataclass(frozen=True)
class Answer:
    """Answer of the program to one case."""

    case: Case
    findings: tuple[RecordingFinding, ...]
    verdict: str
    seconds: float

    @property
    def right(self) -> bool:
        """True if the first finding names the fault."""
        if not self.findings:
            return False
        first, case = self.findings[0], self.case
        if first.kind not in case.kinds or (case.axes and set(first.axes) != set(case.axes)):
            return False
        numbers = {**first.evidence, **{name: one.value for name, one in first.parameters.items()}}
        return all(
            abs(float(numbers[name]) / value - 1.0) <= tolerance for name, (value, tolerance) in case.expected.items()
        )


def load_part(data: Path, place: tuple[str, int, int]) -> RecordedAxes:
    """Return one part of a recording."""
    file, begin, end = place
    with np.load(data / file) as columns:
        values = {axis: columns[axis][begin:end].astype(np.float64) for axis in AXES}
        temperature_c = columns["temp"][begin:end].astype(np.float64) if "temp" in columns else None
        return RecordedAxes(values, float(columns["fs"]), temperature_c)


def replace_values(recording: RecordedAxes, values: dict[str, Floats]) -> RecordedAxes:
    """Return the recording with other values on some axes."""
    return RecordedAxes({**recording.values, **values}, recording.rate_hz, recording.temperature_c)


def noise_deviation(y: Floats) -> float:
    """Return the standard deviation from sample to sample."""
    return float(np.std(np.diff(y))) / 2.0**0.5


def with_unit(sensor: str, second: RecordedAxes, rng: np.random.Generator) -> Case:
    """Multiply one triad by a wrong conversion."""
    triad = TRIADS[int(rng.integers(2))]
    factor = float(rng.choice(UNITS[triad[0][0]]))
    values = {axis: factor * second.values[axis] for axis in triad}
    detail = f"{triad[0][0]}* times {factor:.5g}"
    return Case(
        sensor,
        "unit",
        detail,
        replace_values(second, values),
        ("unit_error",),
        triad,
        {"nearest_factor": (factor, 1e-6)},
    )


def with_swap(sensor: str, first: RecordedAxes, second: RecordedAxes, rng: np.random.Generator) -> Case | None:
    """Swap two axes of a triad with different spectra, or return None without such axes."""
    pairs = [
        (one, other)
        for triad in TRIADS
        for k, one in enumerate(triad)
        for other in triad[k + 1 :]
        if _have_different_spectra(first, second, one, other)
    ]
    if not pairs:
        return None
    one, other = pairs[int(rng.integers(len(pairs)))]
    values = {one: second.values[other], other: second.values[one]}
    return Case(sensor, "swap", f"{one} and {other}", replace_values(second, values), ("axes_permuted",), (one, other))


def _have_different_spectra(first: RecordedAxes, second: RecordedAxes, one: str, other: str) -> bool:
    """Return True if a swap of two axes changes the spectra far more than the spectra differ between the parts."""
    spectra = {
        (part, axis): np.log(welch(recording.values[axis], nperseg=256)[1][2:])
        for part, recording in (("first", first), ("second", second))
        for axis in (one, other)
    }

    def distance(a: str, b: str) -> float:
        return float(np.mean(np.abs(spectra["second", a] - spectra["first", b])))

    return distance(one, other) + distance(other, one) > 3.0 * (distance(one, one) + distance(other, other))


def with_rate(sensor: str, second: RecordedAxes, rng: np.random.Generator) -> Case:
    """State a sample rate that is wrong by 0.5 to 20 %."""
    size = float(np.exp(rng.uniform(np.log(0.005), np.log(0.2))))
    ratio = (1.0 + size) ** float(rng.choice([-1.0, 1.0]))  # true over stated
    recording = RecordedAxes(second.values, second.rate_hz / ratio, second.temperature_c)
    detail = f"true over stated {ratio:.4f}"
    return Case(sensor, "rate", detail, recording, ("sample_rate_error",), (), {"ratio": (ratio, 0.003)})


def with_knocks(sensor: str, second: RecordedAxes, rng: np.random.Generator) -> Case:
    """Add one to three knocks: decaying oscillations of all axes."""
    n, rate_hz = second.sample_count, second.rate_hz
    values = {axis: y.copy() for axis, y in second.values.items()}
    count = int(rng.integers(1, 4))
    length = max(int(1.0 * rate_hz), 24)
    for _ in range(count):
        begin = int(rng.integers(n // 10, n - 2 * length))
        t = np.arange(length) / rate_hz
        shape = np.exp(-t / max(0.15, 3.0 / rate_hz)) * np.sin(2.0 * np.pi * rng.uniform(0.1, 0.3) * np.arange(length))
        for axis, y in values.items():
            y[begin : begin + length] += rng.uniform(20.0, 100.0) * noise_deviation(second.values[axis]) * shape
    return Case(sensor, "knocks", f"{count}", replace_values(second, values), ("motion",))


def with_hole(sensor: str, second: RecordedAxes, rng: np.random.Generator) -> Case:
    """Remove successive rows, or replace successive rows by copies of the previous row."""
    n = second.sample_count
    begin, length = int(rng.integers(n // 10, n // 2)), int(rng.integers(n // 200, n // 20))
    frozen = bool(rng.integers(2))
    values = {axis: y.copy() for axis, y in second.values.items()}
    for y in values.values():
        y[begin : begin + length] = y[begin - 1] if frozen else np.nan
    at = {"time": (begin / second.rate_hz, 0.01)}
    kind = "frozen_rows" if frozen else "missing_rows"
    return Case(sensor, "drop-out", f"{length} rows {kind}", replace_values(second, values), (kind,), (), at)


def with_spike(sensor: str, second: RecordedAxes, rng: np.random.Generator) -> Case:
    """Add a spike to one row on one axis or on all axes."""
    at = int(rng.integers(second.sample_count // 10, second.sample_count - 10))
    axes = AXES if rng.integers(2) else (AXES[int(rng.integers(6))],)
    return _corrupt_row(sensor, "spike row", second, at, axes, rng)


def with_first_row(sensor: str, second: RecordedAxes, rng: np.random.Generator) -> Case:
    """Add a spike to the first or last row, or set the first row to zero."""
    at = 0 if rng.integers(3) else second.sample_count - 1
    if at == 0 and rng.integers(2):
        values = {axis: y.copy() for axis, y in second.values.items()}
        for y in values.values():
            y[0] = 0.0
        return Case(sensor, "first row", "row 0 is zero", replace_values(second, values), ("corrupt_rows",))
    return _corrupt_row(sensor, "first row", second, at, AXES, rng)


def _corrupt_row(
    sensor: str, fault: str, second: RecordedAxes, at: int, axes: Sequence[str], rng: np.random.Generator
) -> Case:
    """Add a spike of 30 to 1000 standard deviations to one row."""
    values = {axis: y.copy() for axis, y in second.values.items()}
    size = float(np.exp(rng.uniform(np.log(30.0), np.log(1000.0))))
    for axis in axes:
        values[axis][at] += size * noise_deviation(values[axis]) * float(rng.choice([-1.0, 1.0]))
    expected = {"time": (at / second.rate_hz, 1e-9)} if at else {}
    detail = f"row {at}, {size:.0f} s on {' '.join(axes)}"
    return Case(sensor, fault, detail, replace_values(second, values), ("corrupt_rows",), (), expected)


def with_stuck_axis(sensor: str, second: RecordedAxes, rng: np.random.Generator) -> Case:
    """Keep one axis at a constant value for some time, or until the end of the recording."""
    n, axis = second.sample_count, AXES[int(rng.integers(6))]
    begin = int(rng.integers(n // 10, n // 2))
    end = n if rng.integers(2) else begin + int(rng.integers(n // 50, n // 4))
    y = second.values[axis].copy()
    y[begin:end] = y[begin - 1]
    detail = f"{axis} for {end - begin} of {n} rows"
    return Case(sensor, "stuck axis", detail, replace_values(second, {axis: y}), ("stuck_axis",), (axis,))


def draw_case(data: Path, sensor: Sensor, fault: str, rng: np.random.Generator) -> Case | None:
    """Draw one case, or return None if the fault cannot be identified with the sensor."""
    first, second = load_part(data, sensor.first), load_part(data, sensor.second)
    if fault == "swap":
        return with_swap(sensor.name, first, second, rng)
    draw = {
        "unit": with_unit,
        "rate": with_rate,
        "knocks": with_knocks,
        "drop-out": with_hole,
        "spike row": with_spike,
        "stuck axis": with_stuck_axis,
        "first row": with_first_row,
    }[fault]
    return draw(sensor.name, second, rng)


def draw_cases(data: Path, seed: int, count: int) -> list[Case]:
    """Draw the cases. The faults alternate, and the sensors alternate for each fault."""
    cases: list[Case] = []
    turn: Counter[str] = Counter()
    while len(cases) < count:
        fault = FAULTS[len(cases) % len(FAULTS)]
        rng = np.random.default_rng([seed, len(cases)])
        while True:
            sensor = SENSORS[turn[fault] % len(SENSORS)]
            turn[fault] += 1
            if fault == "rate" and sensor.name not in RATE_SENSORS:
                continue
            case = draw_case(data, sensor, fault, rng)
            if case is not None:
                break
        cases.append(case)
    return cases


def load_or_fit_model(data: Path, sensor: Sensor, folder: Path) -> NoiseModel:
    """Return the model of the first part, which is stored in a folder."""
    file, begin, end = sensor.first
    file_of_model = folder / f"{file.replace('/', '-')}-{begin}-{end}.toml"
    if not file_of_model.exists():
        folder.mkdir(parents=True, exist_ok=True)
        file_of_model.write_text(reconcile(load_part(data, sensor.first), None, 1).model.to_toml())
    return NoiseModel.from_toml(file_of_model.read_text())


def run_case(case: Case, model: NoiseModel, with_search: bool) -> Answer:
    """Run ``reconcile`` on a case, or only the checks of the recording if ``whole`` is False."""
    begin = time.perf_counter()
    if with_search:
        result = reconcile(case.recording, model, 1)
        return Answer(case, result.recording_findings, result.verdict, time.perf_counter() - begin)
    return Answer(case, run_checks_before_search(case.recording, model), "", time.perf_counter() - begin)


def run_checks_before_search(recording: RecordedAxes, model: NoiseModel) -> tuple[RecordingFinding, ...]:
    """Return the findings of ``reconcile`` without the search for effects."""
    checked = check_recording(recording, model, 1)
    usable, _ = select_axes_and_smooth_temperature(checked.recording, model)
    cache = RegressorCache(usable.sample_count, usable.rate_hz, usable.temperature_c)
    effects = {axis: tuple(e for e in model.effects[axis] if not isinstance(e, ConstantBias)) for axis in usable.values}
    axes = build_repaired_axes(usable, effects, cache, np.random.default_rng(1))
    error = estimate_sample_rate_error(
        {axis: one.coefficients for axis, one in axes.items()},
        usable.rate_hz,
        effects,
        model.sample_rate_hz,
        detect_sample_rate_error(axes, effects),
    )
    if error is None:
        return checked.findings
    return sort_findings((describe_sample_rate_error(error, usable.rate_hz), *checked.findings))


def main() -> None:
    """Run all cases and print the results."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.experiments.blind.corruptions", description="Faults added to real recordings."
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cases", type=int, default=CASES)
    parser.add_argument("--only", nargs="+", choices=FAULTS, default=FAULTS, help="only these faults")
    parser.add_argument(
        "--models", type=Path, default=Path("corruption-models"), metavar="DIR", help="folder for the fitted models"
    )
    parser.add_argument("--checks-only", action="store_true", help="leave out the search for effects")
    options = parser.parse_args()
    if "IMU_MONITOR_DATA" not in os.environ:
        parser.error("IMU_MONITOR_DATA does not point to the recordings")
    data = Path(os.environ["IMU_MONITOR_DATA"])
    models = {sensor.name: load_or_fit_model(data, sensor, options.models) for sensor in SENSORS}
    print("| sensor | fault | case | first finding | all findings | s |\n|---|---|---|---|---|---|")
    for sensor in SENSORS:
        clean = Case(sensor.name, "none", "", load_part(data, sensor.second), ())
        _print_answer(run_case(clean, models[sensor.name], not options.checks_only))
    answers = []
    for case in draw_cases(data, options.seed, options.cases):
        if case.fault in options.only:
            answers.append(run_case(case, models[case.sensor], not options.checks_only))
            _print_answer(answers[-1])
    print("\n| fault | named first | cases |\n|---|---|---|")
    for fault in options.only:
        group = [answer for answer in answers if answer.case.fault == fault]
        print(f"| {fault} | {sum(answer.right for answer in group)} | {len(group)} |")
    print(f"| all | {sum(one.right for one in answers)} | {len(answers)} |")


def _print_answer(one: Answer) -> None:
    """Print one answer as a table row."""
    case = one.case
    mark = "" if case.fault == "none" else "right: " if one.right else "WRONG: "
    first = one.findings[0].sentence if one.findings else "none"
    every = ", ".join(f"{finding.kind} ({' '.join(finding.axes)})" for finding in one.findings)
    print(f"| {case.sensor} | {case.fault} | {case.detail} | {mark}{first} | {every} | {one.seconds:.1f} |", flush=True)


if __name__ == "__main__":
    main()
