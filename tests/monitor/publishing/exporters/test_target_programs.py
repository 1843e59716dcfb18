"""Tests of the exports with the parsers and the update equations of their target programs.

The variance of an angle or a velocity must grow by N² per second, and the variance of a bias by K² per second. Each
test computes this growth from the file, as the program that reads the file does.
"""

import json
import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from drivers.errors import ConfigError
from monitor.noise.effects import AngleRandomWalk, BiasInstability, RateRandomWalk
from monitor.noise.model import NoiseModel
from monitor.publishing import exporters

N = {"gyro": 1.7e-4, "accel": 2.3e-3}
B = {"gyro": 3.1e-5, "accel": 4.1e-4}
K = {"gyro": 1.3e-6, "accel": 1.9e-5}
RATE_HZ = 160.0
ESTIMATORS = (
    "kalibr", "allan_variance_ros", "openvins", "vins_fusion", "orb_slam3", "lio_sam", "fast_lio", "gtsam", "px4_ekf2",
    "ardupilot_ekf3", "robot_localization",
)  # fmt: skip
FRAGMENTS = ESTIMATORS[3:]


def make_analysis_coefficients(without: str = "", k_bound: bool = False) -> exporters.NoiseCoefficients:
    """Return an analysis in which the last axis of each kind has N, B and K, and the others half of each."""
    axes: dict[str, Any] = {}
    for kind, names in (("gyro", ("gx", "gy", "gz")), ("accel", ("ax", "ay", "az"))):
        for axis in names:
            part = 1.0 if axis[1] == "z" else 0.5
            sizes = {"N": N[kind] * part, "B": B[kind] * part, "K": K[kind] * part}
            terms = {
                letter: {"value": size, "lo": 0.9 * size, "hi": 1.2 * size, "status": "estimated"}
                for letter, size in sizes.items()
                if letter not in without
            }
            if k_bound:
                terms["K"] = {"value": None, "lo": None, "hi": sizes["K"], "status": "upper_bound"}
            axes[axis] = {"coefficients": terms}
    payload = {"schema": "imu-monitor/analyze/1", "rate": RATE_HZ, "axes": axes}
    return exporters.from_analysis_json(json.dumps(payload), "bench-1.json")


def parse_yaml(text: str) -> Any:
    pyyaml = pytest.importorskip("yaml")
    return pyyaml.safe_load(re.sub(r"\A%YAML:1\.0\n", "", text))  # the first line is OpenCV's own directive


def parse_opencv_yaml(text: str, keys: tuple[str, ...], node: str | None = None) -> dict[str, float]:
    """Return the numbers that cv::FileStorage reads; a number without a decimal point would not be real."""
    cv2 = pytest.importorskip("cv2")
    assert text.startswith("%YAML:1.0\n")
    storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    assert storage.isOpened()
    parent = storage.getNode(node) if node else storage
    found = {key: parent.getNode(key) for key in keys}
    assert all(node.isReal() for node in found.values())
    return {key: node.real() for key, node in found.items()}


def parse_qgroundcontrol_parameters(text: str) -> dict[str, float]:
    """Parse lines of five fields separated by tabs; the last field is the MAVLink type (9 = float)."""
    rows = [line.split("\t") for line in text.splitlines() if not line.startswith("#")]
    assert all(len(row) == 5 and (row[0], row[1], row[4]) == ("1", "1", "9") for row in rows)
    return {row[2]: float(row[3]) for row in rows}


def parse_mavproxy_parameters(text: str, folder: Path) -> dict[str, float]:
    mavparm = pytest.importorskip("pymavlink.mavparm")
    (folder / "x.param").write_text(text)
    found = mavparm.MAVParmDict()
    assert found.load(str(folder / "x.param"))
    return dict(found)


def round_to_seven_digits(value: float) -> float:
    """Return the value with the seven digits that a file contains."""
    return float(f"{value:.6e}")


SQUARE_RTOL = 1e-6
"""Largest relative error of the square of a number with seven digits."""


DENSITIES = (
    "accelerometer_noise_density",
    "accelerometer_random_walk",
    "gyroscope_noise_density",
    "gyroscope_random_walk",
)
VINS = ("acc_n", "acc_w", "gyr_n", "gyr_w")
ORB = ("IMU.NoiseAcc", "IMU.AccWalk", "IMU.NoiseGyro", "IMU.GyroWalk")
LIO = ("imuAccNoise", "imuAccBiasN", "imuGyrNoise", "imuGyrBiasN")
FAST = ("acc_cov", "b_acc_cov", "gyr_cov", "b_gyr_cov")
PX4 = ("EKF2_ACC_NOISE", "EKF2_ACC_B_NOISE", "EKF2_GYR_NOISE", "EKF2_GYR_B_NOISE")
EKF3 = ("EK3_ACC_P_NSE", "EK3_ABIAS_P_NSE", "EK3_GYRO_P_NSE", "EK3_GBIAS_P_NSE")


def read_n_and_k(form: str, text: str, folder: Path) -> tuple[float, ...]:
    """Return N and K of the accelerometer and of the gyroscope, read by the parser of the program."""
    if form in ("kalibr", "allan_variance_ros"):
        return tuple(parse_yaml(text)[key] for key in DENSITIES)
    if form == "openvins":
        found = parse_opencv_yaml(text, DENSITIES, "imu0")
        assert parse_yaml(text)["imu0"] == parse_yaml(text)["imu0"] | found
        return tuple(found.values())
    if form in ("vins_fusion", "orb_slam3"):
        keys = VINS if form == "vins_fusion" else ORB
        assert parse_opencv_yaml(text, keys) == {key: parse_yaml(text)[key] for key in keys}
        return tuple(parse_opencv_yaml(text, keys).values())
    if form in ("lio_sam", "fast_lio"):
        table = parse_yaml(text)["lio_sam" if form == "lio_sam" else "mapping"]
        return tuple(table[key] for key in (LIO if form == "lio_sam" else FAST))
    found = parse_qgroundcontrol_parameters(text) if form == "px4_ekf2" else parse_mavproxy_parameters(text, folder)
    assert set(found) == set(PX4 if form == "px4_ekf2" else EKF3)
    return tuple(found[key] for key in (PX4 if form == "px4_ekf2" else EKF3))


Growth = Callable[[float, float], tuple[float, float]]
"""Variances of angle and bias after one step, from the two parameters of a sensor, when the step is 1/rate."""

GROWTH: Mapping[str, tuple[float, Growth]] = {
    # rate of the program, and growth in one step of the update equation in its source code
    "kalibr": (RATE_HZ, lambda n, k: ((n / math.sqrt(1 / RATE_HZ) / RATE_HZ) ** 2, (k * math.sqrt(1 / RATE_HZ)) ** 2)),
    "allan_variance_ros": (RATE_HZ, lambda n, k: (n**2 / RATE_HZ, k**2 / RATE_HZ)),
    "openvins": (RATE_HZ, lambda n, k: (n**2 / RATE_HZ, k**2 / RATE_HZ)),  # Qd = dt² σ²/dt, and dt σ_w²
    "vins_fusion": (RATE_HZ, lambda n, k: ((n / RATE_HZ) ** 2, (k / RATE_HZ) ** 2)),  # V noise Vᵀ, V = dt I
    "orb_slam3": (
        RATE_HZ,
        lambda n, k: ((n * math.sqrt(RATE_HZ) / RATE_HZ) ** 2, (k / math.sqrt(RATE_HZ)) ** 2),  # B Nga Bᵀ + NgaWalk
    ),
    "lio_sam": (RATE_HZ, lambda n, k: (n**2 / RATE_HZ, (math.sqrt(1 / RATE_HZ) * k) ** 2)),  # √Δt noiseModelBetweenBias
    "fast_lio": (RATE_HZ, lambda n, k: (n / RATE_HZ**2, k / RATE_HZ**2)),  # (dt f_w) Q (dt f_w)ᵀ
    "px4_ekf2": (100.0, lambda n, k: ((0.01 * n) ** 2, (0.01 * k) ** 2)),  # sq(dt gyro_noise), sq(dt gyro_bias_p_noise)
    "ardupilot_ekf3": (
        1.0 / 0.012,
        lambda n, k: ((0.012 * n) ** 2, (0.012**2 * k) ** 2 / 0.012**2),  # the bias state is an angle per step
    ),
}


@pytest.mark.parametrize("form", list(GROWTH))
def test_variances_grow_by_n2_and_k2_per_second(form: str, tmp_path: Path) -> None:
    rate_hz, growth = GROWTH[form]
    accel_n, accel_k, gyro_n, gyro_k = read_n_and_k(
        form, exporters.export(make_analysis_coefficients(), form), tmp_path
    )
    for kind, n, k in (("accel", accel_n, accel_k), ("gyro", gyro_n, gyro_k)):
        angle, bias = growth(n, k)
        assert angle * rate_hz == pytest.approx(N[kind] ** 2, rel=SQUARE_RTOL)
        assert bias * rate_hz == pytest.approx(K[kind] ** 2, rel=SQUARE_RTOL)


ROOT = math.sqrt(RATE_HZ)
EXPECTED: Mapping[str, Callable[[float], float]] = {
    "kalibr": lambda value: value,
    "allan_variance_ros": lambda value: value,
    "openvins": lambda value: value,
    "vins_fusion": lambda value: value * ROOT,
    "orb_slam3": lambda value: value,
    "lio_sam": lambda value: value,
    "fast_lio": lambda value: value**2 * RATE_HZ,
    "px4_ekf2": lambda value: value * 10.0,
    "ardupilot_ekf3": lambda value: value / math.sqrt(0.012),
}


@pytest.mark.parametrize("inflation", [1.0, 7.0])
@pytest.mark.parametrize("form", list(EXPECTED))
def test_exported_digits_are_those_of_the_worst_axis(form: str, inflation: float, tmp_path: Path) -> None:
    found = read_n_and_k(form, exporters.export(make_analysis_coefficients(), form, inflation), tmp_path)
    inputs = (N["accel"], K["accel"], N["gyro"], K["gyro"])
    assert found == tuple(round_to_seven_digits(EXPECTED[form](value * inflation)) for value in inputs)


@pytest.mark.parametrize("form", ["vins_fusion", "fast_lio", "px4_ekf2", "ardupilot_ekf3"])
def test_given_time_step_replaces_the_default(form: str, tmp_path: Path) -> None:
    text = exporters.export(make_analysis_coefficients(), form, dt_s=0.04)
    expected = N["accel"] ** 2 / 0.04 if form == "fast_lio" else N["accel"] / 0.2
    assert read_n_and_k(form, text, tmp_path)[0] == round_to_seven_digits(expected)
    assert "dt = 0.04 s (25 Hz)" in text


def test_gtsam_propagates_the_variances_of_the_input() -> None:
    gtsam = pytest.importorskip("gtsam")
    names: dict[str, Any] = {}
    exec(exporters.export(make_analysis_coefficients(), "gtsam"), names)
    params = names["params"]
    params.setIntegrationCovariance(1e-30 * np.eye(3))
    integrated = gtsam.PreintegratedCombinedMeasurements(params, gtsam.imuBias.ConstantBias())
    for _ in range(400):
        integrated.integrateMeasurement(np.zeros(3), np.zeros(3), 0.005)
    variances = np.diag(integrated.preintMeasCov()).reshape(5, 3)  # rotation, position, velocity, both biases
    seconds = 2.0
    for kind, row, bias_row in (("gyro", 0, 4), ("accel", 2, 3)):
        walk = K[kind] ** 2 * seconds**3 / 3.0
        np.testing.assert_allclose(variances[bias_row], K[kind] ** 2 * seconds, rtol=5e-7)
        np.testing.assert_allclose(variances[row], N[kind] ** 2 * seconds + walk, rtol=1e-5)


def test_gtsam_gets_squares_of_the_densities() -> None:
    class Parameters(dict[str, Any]):
        def __getattr__(self, name: str) -> Callable[[Any], None]:
            return lambda value: self.update({name: value})

    class Module:
        class PreintegrationCombinedParams:
            MakeSharedU = staticmethod(lambda _g: Parameters())

    code = exporters.export(make_analysis_coefficients(), "gtsam", 3.0).replace("import gtsam\n", "")
    names: dict[str, Any] = {"gtsam": Module}
    exec(code, names)
    expected = {
        "setAccelerometerCovariance": N["accel"],
        "setBiasAccCovariance": K["accel"],
        "setGyroscopeCovariance": N["gyro"],
        "setBiasOmegaCovariance": K["gyro"],
    }
    assert names["params"].keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_array_equal(names["params"][name], round_to_seven_digits((3.0 * value) ** 2) * np.eye(3))


def test_ros_covariances_are_those_of_simulated_samples() -> None:
    text = "sample_rate = 160.0\n['g*'.angle_random_walk]\nN = 1.7e-4\n['a*'.angle_random_walk]\nN = 2.3e-3"
    model = NoiseModel.from_toml(text)
    found = parse_yaml(exporters.export(exporters.from_model(model), "robot_localization"))
    samples = model.simulate(200_000, 160.0, 1)
    assert list(found) == ["angular_velocity_covariance", "linear_acceleration_covariance"]
    for first, name in ((0, "angular_velocity_covariance"), (3, "linear_acceleration_covariance")):
        matrix = np.array(found[name]).reshape(3, 3)
        assert np.count_nonzero(matrix) == 3
        assert np.diag(matrix) == pytest.approx(samples[:, first : first + 3].var(axis=0), rel=0.02)


def test_imu_utils_gets_the_sigma_of_a_sample_and_the_minimum_of_the_allan_deviation() -> None:
    text = exporters.export(make_analysis_coefficients(), "imu_utils")
    found = parse_yaml(text.replace("---\n", "", 1))
    assert (found["type"], found["Gyr"]["unit"], found["Acc"]["unit"]) == ("IMU", " rad/s", " m/s^2")
    for kind, group, prefix in (("gyro", "Gyr", "gyr"), ("accel", "Acc", "acc")):
        effects = (AngleRandomWalk(N[kind]), BiasInstability(B[kind]), RateRandomWalk(K[kind]))

        def variance(log_tau: float, effects: Any = effects) -> float:
            return float(
                sum(effect.avar(np.array([math.exp(log_tau)]), 1e-6 * math.exp(log_tau))[0] for effect in effects)
            )

        minimum = minimize_scalar(variance, bounds=(math.log(1.0), math.log(1e5)), method="bounded")
        table = found[group]
        assert table["z-axis"][f"{prefix}_n"] == round_to_seven_digits(N[kind] * ROOT)
        assert table["z-axis"][f"{prefix}_w"] == pytest.approx(math.sqrt(minimum.fun), rel=1e-4)
        for name in (f"{prefix}_n", f"{prefix}_w"):
            assert table["x-axis"][name] == pytest.approx(table["z-axis"][name] / 2.0, rel=1e-6)
            assert table["avg-axis"][name] == pytest.approx(
                np.mean([table[f"{axis}-axis"][name] for axis in "xyz"]), rel=1e-6
            )


def test_gnss_ins_sim_gets_its_own_units() -> None:
    names: dict[str, Any] = {}
    exec(exporters.export(make_analysis_coefficients(), "gnss_ins_sim", 2.0, correlation_time_s=120.0), names)
    found = names["imu_err"]
    needed = {"gyro_b", "gyro_b_stability", "gyro_arw", "accel_b", "accel_b_stability", "accel_vrw"}
    assert found.keys() == needed | {"gyro_b_corr", "accel_b_corr"}
    assert all(array.shape == (3,) for array in found.values())
    # After one hour, the random walk in the unit of the program equals that of N over 3600 s.
    assert math.radians(found["gyro_arw"][2]) == pytest.approx(2.0 * N["gyro"] * math.sqrt(3600.0), rel=5e-7)
    assert found["accel_vrw"][2] == pytest.approx(2.0 * N["accel"] * math.sqrt(3600.0), rel=5e-7)
    assert found["gyro_b_corr"].tolist() == [120.0] * 3
    for kind, sigma in (
        ("gyro", math.radians(found["gyro_b_stability"][2]) / 3600.0),
        ("accel", found["accel_b_stability"][2]),
    ):
        tau = 1.89  # peak of exponentially correlated noise with T = 1, IEEE Std 952, C.1.1.7
        peak = sigma * math.sqrt(2 / tau * (1 - (3 - 4 * math.exp(-tau) + math.exp(-2 * tau)) / (2 * tau)))
        assert peak == pytest.approx(2.0 * B[kind] * math.sqrt(2.0 * math.log(2.0) / math.pi), rel=2e-3)


def test_gnss_ins_sim_gets_the_correlation_time_from_n_and_k() -> None:
    names: dict[str, Any] = {}
    exec(exporters.export(make_analysis_coefficients(), "gnss_ins_sim"), names)
    expected = math.sqrt(3.0) * N["gyro"] / K["gyro"] / 1.89
    assert names["imu_err"]["gyro_b_corr"][2] == pytest.approx(expected, rel=1e-6)
    exec(exporters.export(make_analysis_coefficients(k_bound=True), "gnss_ins_sim"), names)
    assert names["imu_err"]["gyro_b_stability"].tolist() == [0.0] * 3  # without T, it would be white noise
    assert names["imu_err"]["gyro_b_corr"].tolist() == [math.inf] * 3


@pytest.mark.parametrize("form", ESTIMATORS)
def test_axis_interval_and_inflation_are_next_to_the_value(form: str) -> None:
    lines = exporters.export(make_analysis_coefficients(), form, 4.0).splitlines()
    [row] = [i for i, line in enumerate(lines) if line.startswith("# N: worst axis gz")]
    assert lines[row].endswith("0.00017 (95 % interval 0.000153 to 0.000204); times 4")
    assert re.match(r"# \S+ \[.*rad/s.*\] = N", lines[row - 1])
    assert not lines[row + 1].startswith("# N")


@pytest.mark.parametrize("form", [form for form in ESTIMATORS if form != "robot_localization"])
def test_bound_is_exported_and_marked(form: str) -> None:
    text = exporters.export(make_analysis_coefficients(k_bound=True), form)
    assert "# K: worst axis gz, UPPER BOUND instead of a value" in text
    assert f"<= {K['gyro']:.3g} (one-sided 95 % bound)" in text


@pytest.mark.parametrize("form", FRAGMENTS)
def test_fragment_omits_unknown_values(form: str) -> None:
    text = exporters.export(make_analysis_coefficients(without="K"), form)
    assert text.count("is left out: K of the") == (0 if form == "robot_localization" else 2)
    assert sum("= N" in line for line in text.splitlines()) == 2


def test_value_outside_the_documented_range_is_marked() -> None:
    text = exporters.export(make_analysis_coefficients(), "px4_ekf2", dt_s=0.1)
    lines = text.splitlines()
    row = next(i for i, line in enumerate(lines) if "\tEKF2_ACC_NOISE\t" in line)
    assert lines[row - 1] == "# outside the documented range, 0.01 to 1"
    assert "outside" not in exporters.export(make_analysis_coefficients(), "px4_ekf2", 3.0)


@pytest.mark.parametrize("form", ["vins_fusion", "fast_lio", "robot_localization", "imu_utils"])
def test_discrete_value_needs_a_time_step(form: str) -> None:
    text = "['g*'.angle_random_walk]\nN = 1e-4\n['g*'.bias_instability]\nB = 1e-5\n" + (
        "['a*'.angle_random_walk]\nN = 1e-3\n['a*'.bias_instability]\nB = 1e-4"
    )
    noise = exporters.from_model(NoiseModel.from_toml(text))
    with pytest.raises(ConfigError, match=f"{form} needs a time step"):
        exporters.export(noise, form)
    assert "dt = 0.01 s (100 Hz)" in exporters.export(noise, form, dt_s=0.01)


def test_message_of_a_daemon_is_exported_like_an_analysis() -> None:
    coefficient = {"value": 1.5e-4, "lo": 1.4e-4, "hi": 1.6e-4, "status": "estimated"}
    axes: dict[str, Any] = {axis: dict.fromkeys("NBK", coefficient) for axis in ("gx", "ax")}
    message = {"schema": "imu-monitor/coefficients/1", "device": "bench-1", "t": 1.0, "samples": 9, "rate": 50.0}
    live = exporters.from_analysis_json(json.dumps(message | {"axes": axes}))
    assert live.sample_rate_hz == 50.0
    assert live.axes["gx"]["N"] == exporters.AxisCoefficientOrBound(1.5e-4, interval=(1.4e-4, 1.6e-4))


def test_line_break_in_a_name_does_not_end_the_comment() -> None:
    noise = exporters.from_model(NoiseModel.from_toml("['g*'.angle_random_walk]\nN = 1e-4"), "x\nimport os")
    assert "source: x import os\n" in exporters.export(noise, "gnss_ins_sim")
