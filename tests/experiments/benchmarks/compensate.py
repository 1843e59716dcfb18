"""Errors and cost of the drift compensation methods: at rest, in motion, with changing noise and without rest.

    python -m tests.experiments.benchmarks.compensate [PART …] [--seeds 5]

The simulated gyros are models of the catalogue. Methods that learn from a whole recording get its first third, or the
rest before the motion. The filter of the daemon learns continuously, and its errors are computed for the same part.
"Before" means the rate less the mean of the part for learning.
"""

import argparse
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from drivers.data_types import AXES, Floats, make_block
from drivers.recordings import load_samples
from monitor.commands.compensate import METHODS, run_compensation
from monitor.daemon.device.arma_worker import ArmaWorker
from monitor.drift.compensation import sage_husa
from monitor.drift.compensation.arma import fit_arma, stationary_covariance
from monitor.drift.compensation.compensation_score import AxisCompensation
from monitor.drift.compensation.gyro_drift_compensator import Compensator
from monitor.drift.compensation.live_compensation import LiveDriftCompensation
from monitor.drift.compensation.reference_methods import REFERENCE_METHODS, apply_reference_method
from monitor.drift.thermal.interval_means import compute_interval_means
from monitor.noise.model_loading import load_model
from tests.experiments.benchmarks.joint_filter import compiled_filter, filter_drift_and_rate
from tests.experiments.benchmarks.machine import console, create_table
from tests.experiments.benchmarks.motion_score import MotionScore, score_in_motion

RATE_HZ = 100.0
SENSORS = ("mpu-6050", "consumer-mems", "adis16470")
REST_S, MOTION_S = 600.0, 200.0
DEGREE = np.pi / 180.0
PER_H = 3600.0 / DEGREE
RECORDINGS = (
    "adis16405/run1.npz",
    "adis16405/run2.npz",
    "mpu6050-hosttime/static-11min.npz",
    "mpu6050-arduino/static-7min.npz",
    "vn100-serial/static-12min.npz",
)


def simulate_rest(sensor: str, seed: int, seconds: float) -> Floats:
    """Return samples [n, 6] of a sensor at rest."""
    model = load_model(sensor, Path.cwd())
    return model.start_stream(RATE_HZ, seed, None).draw_samples_with_temperature(round(seconds * RATE_HZ)).values.copy()


def motion_profiles(t: Floats) -> Iterator[tuple[str, Floats]]:
    """Yield name and rate of each motion of a turntable, in rad/s."""
    for size in (1.0, 10.0, 50.0, 200.0):
        for hz in (0.1, 0.5, 1.0, 2.0):
            yield f"sine {size:g} °/s, {hz:g} Hz", size * DEGREE * np.sin(2.0 * np.pi * hz * t)
        yield f"steps {size:g} °/s", size * DEGREE * (t // 5.0 % 2.0)
        yield f"ramps ±{size:g} °/s", size * DEGREE * (2.0 * np.abs(t / 10.0 % 2.0 - 1.0) - 1.0)


def compensate_live(values: Floats, rate_hz: float, adapts: bool = True) -> tuple[Floats, Compensator]:
    """Compensate values as the daemon does."""
    compensator, out = Compensator(rate_hz, adapts), np.empty_like(values)
    size = compensator.interval_samples
    for start in range(0, len(values), size):
        out[start : start + size] = compensator.compensate(values[start : start + size])
        compensator.identify_due_models()
    return out, compensator


def compensate_axis(method: str, values: Floats, rest: int, axis: int) -> Floats:
    """Compensate one axis with a method that learns from the first ``rest`` samples."""
    if method in REFERENCE_METHODS:
        return apply_reference_method(values[:, axis], values[:rest, axis], REFERENCE_METHODS[method])
    return compensate_live(values, RATE_HZ, method != "fixed")[0][:, axis]


def rest(seeds: int) -> None:
    """Print the errors of every method for simulated sensors at rest for three hours."""
    table = create_table(
        "At rest, three hours, °/h: before → after",
        "sensor, method",
        "rms",
        "worst minute",
        "1 min",
        "10 min",
        "60 min",
    )
    folder = Path(tempfile.gettempdir())
    for sensor in SENSORS:
        for method in METHODS:
            rows = []
            for seed in range(1 if method == "emd" else seeds):
                path = folder / f"bench-compensate-{os.getpid()}.npz"
                np.savez(
                    path,
                    fs=RATE_HZ,
                    **dict(zip(("gx", "gy", "gz"), simulate_rest(sensor, seed, 10_800.0).T, strict=False)),
                )
                rows.append(_compute_errors(path, method))
                path.unlink()
            table.add_row(f"{sensor} {method}", *_format_errors(np.array(rows)))
    console.print(table)


def recordings(_seeds: int) -> None:
    """Print the errors of every method for real recordings at rest."""
    folder = os.environ.get("IMU_MONITOR_DATA")
    if not folder:
        console.print("IMU_MONITOR_DATA is not set: no recordings")
        return
    table = create_table(
        "At rest, °/h: before → after, mean of the axes",
        "recording, method",
        "rms",
        "worst minute",
        "1 min",
        "10 min",
        "60 min",
    )
    for name in RECORDINGS:
        for method in METHODS:
            table.add_row(
                f"{name.partition('/')[0]} {name[-8:-4]} {method}",
                *_format_errors(np.array([_compute_errors(Path(folder) / name, method)])),
            )
    console.print(table)


def allan(_seeds: int) -> None:
    """Print the Allan deviations of recordings at rest before and after compensation, as rms of the axes."""
    folder = os.environ.get("IMU_MONITOR_DATA")
    if not folder:
        console.print("IMU_MONITOR_DATA is not set: no recordings")
        return
    taus = (0.1, 1.0, 10.0, 100.0)
    table = create_table("Allan deviation at rest, °/h: before → after", "recording", *(f"{tau:g} s" for tau in taus))
    for name in RECORDINGS:
        curves = [
            [
                [np.interp(np.log(tau), np.log(one.tau_s), one.allan) for tau in taus]
                for one in (axis.uncompensated, axis.compensated)
            ]
            for axis in _compensate_recording(Path(folder) / name, "adaptive")
        ]
        table.add_row(name, *_format_errors(np.array(curves)))
    console.print(table)


def _compute_errors(recording: Path, method: str) -> Floats:
    """Return rms, worst minute and drift over each span, before and after [2, 5], as rms of the axes in rad/s."""
    axes = _compensate_recording(recording, method)
    rows = [
        [[one.rms, one.worst_minute, *one.drift] for one in (axis.uncompensated, axis.compensated)] for axis in axes
    ]
    return np.asarray(np.sqrt(np.mean(np.square(rows), axis=0)))


def _compensate_recording(recording: Path, method: str) -> list[AxisCompensation]:
    """Return the result of each axis, without the compensated recording."""
    with tempfile.TemporaryDirectory() as folder:
        return list(run_compensation(recording, Path(folder) / "out.npz", method).axes.values())


def _format_errors(rows: Floats) -> list[str]:
    before, after = np.sqrt(np.mean(np.square(rows), axis=0)) * PER_H
    return [f"{b:.3g} → {a:.3g}" if np.isfinite(b + a) else "—" for b, a in zip(before, after, strict=True)]


def motion(seeds: int) -> None:
    """Print the relative errors on a turntable after ten minutes at rest."""
    t = np.arange(round(MOTION_S * RATE_HZ)) / RATE_HZ
    for sensor in SENSORS:
        table = create_table(
            f"{sensor}: rms error over that before, delay, angle (°, before → after)",
            "profile",
            *METHODS,
            "delay",
            "angle",
        )
        worst = dict.fromkeys(METHODS, 0.0)
        for name, truth in motion_profiles(t):
            cells, first = [], None
            for method in METHODS:
                pairs = [_score_motion(sensor, seed, truth, method) for seed in range(1 if method == "emd" else seeds)]
                ratio = float(
                    np.sqrt(np.mean([a.rms_error**2 for _, a in pairs]) / np.mean([b.rms_error**2 for b, _ in pairs]))
                )
                worst[method] = max(worst[method], ratio)
                cells.append(f"{ratio:.3f}")
                first = first or pairs
            assert first is not None
            angle = [np.sqrt(np.mean([one[k].angle_error_rad ** 2 for one in first])) / DEGREE for k in (0, 1)]
            delay = np.mean([after.delay_s for _, after in first])
            table.add_row(name, *cells, f"{1e3 * delay:.1f} ms", f"{angle[0]:.2g} → {angle[1]:.2g}")
        table.add_row("worst", *(f"{worst[method]:.3f}" for method in METHODS))
        console.print(table)


def one_filter(_seeds: int) -> None:
    """Print the errors of a single filter of drift and rate, for several intensities of motion."""
    t = np.arange(round(MOTION_S * RATE_HZ)) / RATE_HZ
    shown = ("sine 1 °/s, 0.1 Hz", "sine 10 °/s, 1 Hz", "steps 10 °/s")
    truths = {"rest": np.zeros(t.size), **{name: truth for name, truth in motion_profiles(t) if name in shown}}
    table = create_table("One filter of both: rms error over that before", "sensor, (°/s³)²/Hz", *truths)
    for sensor in SENSORS:
        still = round(REST_S * RATE_HZ)
        measured = simulate_rest(sensor, 0, REST_S + MOTION_S)[:, 2]
        means = compute_interval_means(measured[:still], np.zeros(still), RATE_HZ, 1.0)
        model = fit_arma(means.bias, float(np.mean(means.error**2)), [(1, 0)])
        phi, white = max(model.phi[0], 0.5) ** (1.0 / RATE_HZ), float(measured[:still].var())
        variance = model.variance * stationary_covariance(*model.phi, model.theta)[0] * (1.0 - phi**2)
        for intensity in (1e-8, 1e-6, 1e-4, 1e-2, 1.0):
            cells = []
            for truth in truths.values():
                z = measured - measured[:still].mean()
                z[still:] += truth
                out = compiled_filter(z, 1.0 / RATE_HZ, phi, 0.0, 0.0, variance, white, intensity)
                before, after = score_in_motion(z[still:], truth, RATE_HZ), score_in_motion(out[still:], truth, RATE_HZ)
                cells.append(f"{after.rms_error / before.rms_error:.3g}")
            table.add_row(f"{sensor}, {intensity / DEGREE**2:.1e}", *cells)
    console.print(table)


def _score_motion(sensor: str, seed: int, truth: Floats, method: str) -> tuple[MotionScore, MotionScore]:
    still = round(REST_S * RATE_HZ)
    values = simulate_rest(sensor, seed, REST_S + MOTION_S)
    before = values[still:, 2] - values[:still, 2].mean() + truth
    values[still:, 2] += truth
    after = compensate_axis(method, values, still, 2)[still:]
    return score_in_motion(before, truth, RATE_HZ), score_in_motion(after, truth, RATE_HZ)


def slow(seeds: int) -> None:
    """Print how much of a constant slow rotation remains, after half an hour at rest."""
    table = create_table("Constant rotation for ten minutes: remaining error", "°/s", *SENSORS)
    for rate in (0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 5.0):
        cells = []
        for sensor in SENSORS:
            left = []
            for seed in range(seeds):
                values = simulate_rest(sensor, seed, 2400.0)
                values[180_000:, 2] += rate * DEGREE
                out = compensate_live(values, RATE_HZ)[0][180_000:, 2]
                left.append([out[:6000].mean(), out[24_000:30_000].mean(), out[-6000:].mean()])
            cells.append(" ".join(f"{100.0 * x / DEGREE / rate:.0f}" for x in np.mean(left, axis=0)))
        table.add_row(f"{rate:g}", *cells)
    console.print(table)
    console.print("percent of it in the first, the fifth and the tenth minute")


def doubling(seeds: int) -> None:
    """Print the errors for white noise that increases by a factor of 2 or 4, with adaptive and fixed noise."""
    table = create_table(
        "rms error of the drift, in units of its own deviation",
        "white noise",
        "before",
        "adaptive",
        "fixed",
        "S over ε²: adaptive",
        "fixed",
    )
    n = 8000
    for factor in (1.0, 2.0, 4.0):
        rows = []
        for seed in range(10 * seeds):
            rng = np.random.default_rng(seed)
            drift = lfilter([1.0], [1.0, -0.995], 0.1 * rng.standard_normal(n + 2000))[2000:]
            white = np.where(np.arange(n) < n // 2, 3.0, 3.0 * factor)
            z = drift + white * rng.standard_normal(n)
            scatter = white**2 * rng.chisquare(3, n) / 3.0
            model = fit_arma(z[:2048], float(scatter[:2048].mean()))
            rows.append([_filter_errors(model, z, scatter, drift, adapts) for adapts in (True, False)])
        (before, adaptive, first), (_, fixed, second) = np.sqrt(np.mean(np.square(rows), axis=0))
        table.add_row(
            f"× {factor:g}",
            f"{before:.3f}",
            f"{adaptive:.3f}",
            f"{fixed:.3f}",
            f"{1 / first**2:.2f}",
            f"{1 / second**2:.2f}",
        )
    console.print(table)


def _filter_errors(model, z: Floats, scatter: Floats, drift: Floats, adapts: bool) -> list[float]:  # type: ignore[no-untyped-def]
    """Return the rms error before and after the change, and the rms of ε/√S after the change."""
    row = np.zeros(1, sage_husa.DRIFT_FILTER)[0]
    row["adaptive"] = adapts
    sage_husa.restart_with_model(row, model)
    off, new = np.empty(z.size), np.empty(z.size)
    for k in range(z.size):
        expected = sage_husa.expected_bias_and_variance(row)[0]
        off[k] = expected - drift[k]
        total, _ = sage_husa.update_with_interval(row, z[k], scatter[k], 1e-12)
        new[k] = (z[k] - expected) / total**0.5
        sage_husa.predict_next_interval(row)
    half = z.size // 2
    return [float(np.sqrt(np.mean(part**2))) for part in (off[2048:half], off[half + 200 :], new[half + 200 :])]


def coast(seeds: int) -> None:
    """Print the error of the bias after a time without rest, in °/h."""
    spans = (1.0, 10.0, 60.0)
    table = create_table(
        "Bias after so long without rest, °/h: last minute's mean | adaptive (and its stated error)",
        "sensor",
        *(f"{s:g} min" for s in spans),
    )
    for sensor in SENSORS:
        rows = [_errors_without_rest(simulate_rest(sensor, seed, 10_800.0), RATE_HZ, spans) for seed in range(seeds)]
        table.add_row(sensor, *_format_errors_without_rest(np.array(rows)))
    folder = os.environ.get("IMU_MONITOR_DATA")
    for name in RECORDINGS if folder else ():
        found = load_samples(Path(str(folder)) / name)
        rate_hz = float(found.rate_hz or RATE_HZ)
        within = tuple(s for s in spans if 120.0 * s < len(found) / rate_hz)
        table.add_row(
            name, *_format_errors_without_rest(np.array([_errors_without_rest(found.values, rate_hz, within)]))
        )
    console.print(table)


def _format_errors_without_rest(rows: Floats) -> list[str]:
    minute, own, stated = np.sqrt(np.mean(np.square(rows), axis=0)) * PER_H
    return [f"{a:.3g} | {b:.3g} ({c:.3g})" for a, b, c in zip(minute, own, stated, strict=True)]


def _errors_without_rest(values: Floats, rate_hz: float, spans: tuple[float, ...]) -> Floats:
    """Return rms errors of the last minute's mean and of the filter, and the stated error of the filter [3, spans]."""
    one = Compensator(rate_hz)
    size, kept = one.interval_samples, []
    interval_means: list[Floats] = []
    for start in range(0, len(values) - size, size):
        one.compensate(values[start : start + size])
        one.identify_due_models()
        kept.append((one._state.drift.copy(), len(interval_means)))
        interval_means += [interval.mean for interval in one.take_finished_intervals()]
    means, per_min = np.array(interval_means), round(60.0 / one.interval_s)
    squares = np.zeros((3, len(spans)))
    for at, span in enumerate(spans):
        ahead, count = round(span * per_min), 0
        for rows, known in kept[len(kept) // 3 :: per_min]:
            if known + ahead + per_min > len(means):
                break
            truth = np.nanmean(means[known + ahead : known + ahead + per_min], axis=0)
            minute = np.nanmean(means[known - per_min : known], axis=0)
            rows = rows.copy()
            for row in rows:
                for _ in range(ahead + per_min // 2):
                    sage_husa.predict_next_interval(row)
            now = np.array([sage_husa.expected_bias_and_variance(row) for row in rows])
            spread = now[:, 1] + np.array([row["white_variance"] for row in rows]) / per_min
            squares[:, at] += np.mean([(truth - minute) ** 2, (truth - now[:, 0]) ** 2, spread], axis=1)
            count += 1
        squares[:, at] /= max(count, 1)
    return np.sqrt(squares)


def alarms(seeds: int) -> None:
    """Print the number of events ``drift_unexplained`` for sensors with constant noise."""
    table = create_table("Events at rest", "sensor", "hours", "events", "of them steps")
    sources: list[tuple[str, list[Floats], float]] = [
        (sensor, [simulate_rest(sensor, 1000 + seed, 10_800.0) for seed in range(seeds)], RATE_HZ) for sensor in SENSORS
    ]
    folder = os.environ.get("IMU_MONITOR_DATA")
    for name in RECORDINGS if folder else ():
        found = load_samples(Path(str(folder)) / name)
        sources.append((name, [found.values], float(found.rate_hz or RATE_HZ)))
    for name, records, rate_hz in sources:
        event_texts: list[str] = []
        for values in records:
            one, worker = LiveDriftCompensation(rate_hz), ArmaWorker("", synchronous=True)
            t_ns = np.round(np.arange(len(values)) / rate_hz * 1e9).astype(np.int64)
            for start in range(0, len(values), 100):
                one.compensate_block(make_block(t_ns[start : start + 100].copy(), values[start : start + 100].copy()))
                worker.adopt_results_and_start_next_identification(one)
            event_texts += [event.text for event in one.take_events()]
        hours = sum(len(values) for values in records) / rate_hz / 3600.0
        table.add_row(
            name, f"{hours:.1f}", str(len(event_texts)), str(sum("step of the bias" in text for text in event_texts))
        )
    console.print(table)


def consistency(_seeds: int) -> None:
    """Compare recordings in motion with a reference: attitude of a robot, yaw of a car, or other gyros."""
    folder = os.environ.get("IMU_MONITOR_DATA")
    if not folder:
        console.print("IMU_MONITOR_DATA is not set: no recordings")
        return
    table = create_table("rms difference to the reference: before → after", "recording", "learned at rest", "°/s, or °")
    for name in ("mpu9150", "mpu6500", "mpu6050"):
        with np.load(Path(folder) / f"robot-arm/{name}.npz") as found:
            values, rate_hz, t = _stack_axes(found), float(found["fs"]), found["t"]
            attitude = Rotation.from_quat(found["ref_quat"][:, [1, 2, 3, 0]])
        out, one = compensate_live(values, rate_hz)
        table.add_row(
            f"robot-arm {name}, ° turned in 100 samples",
            _has_learned(one),
            " → ".join(f"{_angle_difference(x[:, :3], t, attitude):.3g}" for x in (values, out)),
        )
    with np.load(Path(folder) / "car-phone-can/minute.npz") as found:
        values, rate_hz = _stack_axes(found), float(found["fs"])
        t = np.arange(len(values)) / rate_hz if "t" not in found else found["t"] - found["t"][0]
        yaw = np.interp(t, found["t_yaw"] - found["t_yaw"][0], found["yaw_counts"] * 0.24 * DEGREE)
    out, one = compensate_live(values, rate_hz)
    table.add_row(
        "car-phone-can, yaw",
        _has_learned(one),
        _differences([x[:, 2] - x[:, 2].mean() for x in (values, out)], yaw.mean() - yaw),
    )
    each: list[tuple[Floats, Floats, str]] = []
    for imu in ("imu1", "imu2", "imu3"):
        found_one = load_samples(Path(folder) / f"autopilot-3imu/{imu}.npz")
        out, one = compensate_live(found_one.values, 50.0)
        still = found_one.values[1000:2500, :3].mean(axis=0)  # at rest on the ground from 20 s
        each.append((found_one.values[:, :3] - still, out[:, :3], _has_learned(one)))
    for a, b in ((0, 1), (0, 2), (1, 2)):
        n = min(len(each[a][0]), len(each[b][0]))
        cells = []
        for one_way, other_way in zip(each[a][:2], each[b][:2], strict=True):
            apart = one_way[3750:n] - other_way[3750:n]  # in flight
            means = apart[: len(apart) // 500 * 500].reshape(-1, 500, 3).mean(axis=1)
            cells.append((np.sqrt(np.mean(apart**2)), np.sqrt(np.mean(means**2))))
        text = ", ".join(f"{x / DEGREE:.3g} → {y / DEGREE:.3g}" for x, y in zip(*cells, strict=True))
        table.add_row(f"autopilot-3imu {a + 1} and {b + 1} in flight; means of 10 s", each[a][2], text)
    console.print(table)


def _stack_axes(found) -> Floats:  # type: ignore[no-untyped-def]
    return np.stack([found[axis].astype(np.float64) for axis in AXES], axis=1)


def _angle_difference(rates: Floats, t: Floats, attitude: Rotation) -> float:
    """Return the rms difference of the angles that gyros and attitude turn in 100 samples, in °.

    The attitude is 10 samples early.
    """
    apart = []
    for start in range(100, len(rates) - 200, 50):
        turned = Rotation.identity()
        for k in range(start, start + 100):
            turned = turned * Rotation.from_rotvec(rates[k] * (t[k + 1] - t[k]))
        known = attitude[start - 10].inv() * attitude[start + 90]
        apart.append(turned.magnitude() - known.magnitude())
    return float(np.sqrt(np.mean(np.square(apart))) / DEGREE)


def _has_learned(one: Compensator) -> str:
    return "yes" if np.isfinite(one.bias).all() else "no"


def _differences(both: list[Floats], truth: Floats) -> str:
    return " → ".join(f"{np.sqrt(np.nanmean((x - truth) ** 2)) / DEGREE:.3g}" for x in both)


def arma(seeds: int) -> None:
    """Print the coverage of the 95 % intervals of the coefficients for 20 times ``seeds`` simulated drifts."""
    count = 20 * seeds
    table = create_table(f"{count} drifts each, per cent inside 95 %", "φ1, φ2, θ1", "values", "φ1", "φ2", "θ1")
    for phi, theta in (
        ((1.2, -0.5), -0.4),
        ((0.9, 0.05), -0.5),
        ((1.7, -0.75), 0.2),
        ((0.3, 0.4), 0.6),
        ((0.6, 0.2), 0.3),
    ):
        for n in (500, 2000):
            inside = np.zeros(3)
            for seed in range(count):
                a = np.random.default_rng(seed).standard_normal(n + 500)
                z = lfilter([1.0, theta], [1.0, -phi[0], -phi[1]], a)[500:]
                found = fit_arma(z, orders=[(2, 1)], with_confidence_intervals=True)
                inside += (np.array(found.lo) <= [*phi, theta]) & (np.array(found.hi) >= [*phi, theta])
            table.add_row(f"{phi[0]:g}, {phi[1]:g}, {theta:g}", str(n), *(f"{100 * x / count:.0f}" for x in inside))
    console.print(table)


def robust(_seeds: int) -> None:
    """Check that results stay finite for 10⁸ samples with outliers, gaps, saturation, motion and steps."""
    rng, one = np.random.default_rng(0), Compensator(RATE_HZ)
    size, done, bias = 400_000, 0, np.zeros(6)
    least = np.inf
    began = time.perf_counter()
    while done < 1e8:
        bias += 1e-4 * rng.standard_normal(6)
        values = bias + 1e-3 * rng.standard_normal((size, 6))
        kind = rng.integers(7)
        if kind == 0:
            values[rng.integers(size, size=200)] += 10.0 * rng.standard_normal((200, 6))
        elif kind == 1:
            values[1000:200_000] = np.clip(1e3 * values[1000:200_000], -4.36, 4.36)
        elif kind == 2:
            values[:] = values[0]
        elif kind == 3:
            values[rng.integers(size, size=20_000), rng.integers(6, size=20_000)] = np.nan
        elif kind == 4:
            values[:, :3] += np.sin(np.arange(size) / rng.uniform(5.0, 5e4))[:, None]
        elif kind == 5:
            values[size // 2 :] += 0.05
        out = one.compensate(values, lost=int(rng.integers(2)) * int(rng.integers(10**6)))
        one.identify_due_models()
        one.take_finished_intervals()
        assert np.array_equal(np.isfinite(out), np.isfinite(values))
        for row in one._state.drift:
            covariance = row["covariance"]
            if np.trace(covariance) > 0.0:  # the filter has learned
                least = min(least, float(np.linalg.eigvalsh(covariance)[0] / np.trace(covariance)))
        done += size
    seconds = time.perf_counter() - began
    console.print(
        f"{done:.0f} samples, {seconds:.0f} s: all finite; least eigenvalue of a covariance over its trace {least:.0e}"
    )


def speed(_seeds: int) -> None:
    """Print the processor time per sample and axis, compared with a NumPy Kalman filter of a drift and a rate."""
    values = 1e-3 * np.random.default_rng(0).standard_normal((400_000, 6))
    Compensator(RATE_HZ).compensate(values[:1000])

    def cost(rows: int, count: int) -> float:
        best = np.inf
        for _ in range(3):
            one, began = Compensator(RATE_HZ), time.process_time()
            for start in range(0, count, rows):
                one.compensate(values[start : start + rows])
            best = min(best, (time.process_time() - began) / count / 3.0)
        return 1e9 * best

    began = time.process_time()
    filter_drift_and_rate(values[:10_000, 0], 1.0 / RATE_HZ, 1.6, -0.61, -0.8, 1e-10, 1e-6, 1e-2)
    plain = 1e9 * (time.process_time() - began) / 10_000.0
    table = create_table("ns a sample and axis", "fed by", "ns", "plain NumPy filter over it")
    for rows, count in ((4096, 400_000), (100, 400_000), (1, 40_000)):
        ns = cost(rows, count)
        table.add_row(str(rows), f"{ns:.0f}", f"{plain / ns:.0f}")
    console.print(table)


PART_FUNCTIONS = (
    rest,
    recordings,
    allan,
    motion,
    one_filter,
    slow,
    doubling,
    coast,
    alarms,
    consistency,
    arma,
    robust,
    speed,
)
PARTS = {function.__name__: function for function in PART_FUNCTIONS}


def main() -> None:
    """Print the requested tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], default=[])
    parser.add_argument("--seeds", type=int, default=5)
    arguments = parser.parse_args()
    for part in arguments.parts or PARTS:
        PARTS[part](arguments.seeds)


if __name__ == "__main__":
    main()
