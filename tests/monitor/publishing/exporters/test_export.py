"""Tests of the exports: files are read as their target program does and compared with closed forms."""

import dataclasses
import json
import math
import re
import tomllib
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import minimize_scalar

from drivers.errors import ConfigError, NotReady
from monitor.common.shipped_config_paths import CONFIG_FOLDER
from monitor.noise.model import NoiseModel
from monitor.publishing import exporters
from monitor.publishing.exporters.kalman import (
    MARKOV_PEAK_AT,
    MARKOV_PEAK_RATIO,
    process_noise_matrix,
    state_transition_matrix,
)

MODEL = """
sample_rate = 200.0
["g*".quantization_noise]
Q = 2.0e-6
["g*".angle_random_walk]
N = 1.0e-4
[["gz".bias_instability]]
B = 3.0e-5
[["gz".bias_instability]]
B = 4.0e-5
["g*".rate_random_walk]
K = 1.0e-6
["a*".angle_random_walk]
N = 1.0e-3
["a*".rate_random_walk]
K = 2.0e-5
[az.bias]
value = 9.8
"""


def make_coefficients(text: str = MODEL) -> exporters.NoiseCoefficients:
    return exporters.from_model(NoiseModel.from_toml(text), "bench-1.toml")


def make_analysis_coefficients(status: str = "upper_bound") -> exporters.NoiseCoefficients:
    """Return coefficients of an analysis; K of gy is estimated, and K of gx has this status."""

    def make_coefficient(value: float | None, hi: float | None, status: str) -> dict[str, Any]:
        return {"value": value, "lo": None if value is None else value * 0.9, "hi": hi, "status": status}

    axes = {
        "gx": {
            "N": make_coefficient(1e-4, 1.1e-4, "estimated"),
            "K": make_coefficient(None, 9e-6 if status == "upper_bound" else None, status),
        },
        "gy": {"N": make_coefficient(2e-4, 2.1e-4, "estimated"), "K": make_coefficient(3e-6, 4e-6, "estimated")},
        "ax": {"N": make_coefficient(1e-3, 1.1e-3, "estimated"), "K": make_coefficient(None, 5e-5, "upper_bound")},
    }
    payload = {
        "schema": "imu-monitor/analyze/1",
        "rate": 100.0,
        "samples": 1000,
        "notes": [],
        "axes": {axis: {"allan": {"tau": [0.01]}, "coefficients": terms} for axis, terms in axes.items()},
    }
    return exporters.from_analysis_json(json.dumps(payload), "bench-1.json")


def parse_yaml(text: str) -> dict[str, float | str]:
    """Parse ``key: value  # comment`` lines; YAML 1.1 floats need a point and a signed exponent."""
    found: dict[str, float | str] = {}
    for line in text.splitlines():
        key, value = (
            (part.strip() for part in line.split("#")[0].split(":", 1)) if line[:1] not in ("#", "") else ("", "")
        )
        if key:
            is_float = re.fullmatch(r"[-+]?[0-9]+\.[0-9]*([eE][-+][0-9]+)?", value)
            found[key] = float(value) if is_float else value
    return found


def test_effects_of_one_name_add_as_variances() -> None:
    assert make_coefficients().axes["gz"]["B"].value == pytest.approx(5.0e-5)
    assert "B" not in make_coefficients().axes["gx"]
    assert make_coefficients().left_out == ("az.bias",)


def test_kalibr_uses_the_worst_axis_in_continuous_time_units() -> None:
    noisier = MODEL.replace("[az.bias]", "[[ay.angle_random_walk]]\nN = 2.0e-3\n[az.bias]")
    text = exporters.export(make_coefficients(noisier), "kalibr", 10.0, rostopic="/imu/data")
    found = parse_yaml(text)
    assert found == {
        "rostopic": "/imu/data",
        "update_rate": 200.0,
        "accelerometer_noise_density": pytest.approx(10 * math.sqrt(1e-3**2 + 2e-3**2), rel=1e-6),
        "accelerometer_random_walk": pytest.approx(2.0e-4),
        "gyroscope_noise_density": pytest.approx(1.0e-3),
        "gyroscope_random_walk": pytest.approx(1.0e-5),
    }
    assert "worst axis ay (ax 0.001, ay 0.00224, az 0.001)" in text
    assert "N, B and K are 10 times the values of the source" in text
    assert "source: bench-1.toml" in text
    assert "not in this file: Q, B, az.bias" in text
    assert text.isascii()


def test_kalibr_density_agrees_with_the_samples() -> None:
    """Kalibr multiplies its density by 1/√Δt to get σ of a sample of white noise."""
    model = NoiseModel.from_toml(MODEL.replace("Q = 2.0e-6", "Q = 0.0").replace("K = 1.0e-6", "K = 1.0e-9"))
    density = parse_yaml(exporters.export(exporters.from_model(model), "kalibr"))["gyroscope_noise_density"]
    samples = model.simulate(200_000, 200.0, 1)[:, 0]
    assert isinstance(density, float)
    assert samples.std() == pytest.approx(density * math.sqrt(200.0), rel=0.01)


def test_kalibr_prefers_an_estimate_and_marks_a_bound() -> None:
    text = exporters.export(make_analysis_coefficients(), "kalibr")
    found = parse_yaml(text)
    assert found["gyroscope_random_walk"] == pytest.approx(3e-6)
    assert "# K: worst axis gy (gx <= 9e-06, gy 3e-06)" in text
    assert found["accelerometer_random_walk"] == pytest.approx(5e-5)
    assert "# K: worst axis ax, UPPER BOUND instead of a value (ax <= 5e-05)" in text
    assert found["gyroscope_noise_density"] == pytest.approx(2e-4)


def test_kalibr_refuses_zero_or_missing_values() -> None:
    with pytest.raises(ConfigError, match=r"kalibr needs K \(rate_random_walk\) above 0 on the gyro axes"):
        exporters.export(make_coefficients(MODEL.replace("K = 1.0e-6", "K = 0.0")), "kalibr")
    with pytest.raises(ConfigError, match="no sample_rate"):
        exporters.export(make_coefficients(MODEL.replace("sample_rate = 200.0", "")), "kalibr")


def test_insufficient_recording_is_refused() -> None:
    empty = exporters.from_analysis_json(
        '{"schema": "imu-monitor/analyze/1", "samples": 3, "notes": ["few"], "axes": {}}'
    )
    with pytest.raises(NotReady, match="a longer recording is needed"):
        exporters.export(empty, "kalman")
    without_accelerometers = exporters.NoiseCoefficients(
        {"gx": make_analysis_coefficients().axes["gx"]}, 100.0, "", measured=True
    )
    with pytest.raises(NotReady, match="a longer recording is needed"):
        exporters.export(dataclasses.replace(without_accelerometers, axes={"gx": {}}), "kalibr")


GYRO_RESULT = """{"schema": "imu-monitor/analyze/1", "rate": %s, "axes": {"%s": {"coefficients": {
    "N": {"value": %s, "lo": 1.9e-4, "hi": 2.1e-4, "status": "estimated"},
    "K": {"value": null, "lo": null, "hi": 3e-6, "status": "upper_bound"}}}}}"""


@pytest.mark.parametrize("form", list(exporters.FORMATS))
def test_missing_accelerometer_is_marked(form: str) -> None:
    noise = exporters.from_analysis_json(GYRO_RESULT % (100.0, "gx", 2e-4))
    text = exporters.export(noise, form)
    per_axis = form in ("gnss_ins_sim", "gyroparams", "kalman")
    assert per_axis or re.search(r"# \S+ is left out: N(, and B or K,)? of the accel axes (is|are) not measured", text)
    assert not re.search(r"\b(nan|None)\b", text)
    assert exporters.describe_weak_points(noise)[0] == "not measured: gy, gz, ax, ay, az"


def test_results_of_separate_recordings_are_joined() -> None:
    gyro, accel = (
        exporters.from_analysis_json(GYRO_RESULT % values, source)
        for values, source in (((400.0, "gx", 2e-4), "gyro.json"), ((250.0, "az", 3e-4), "accel.json"))
    )
    text = exporters.export(exporters.join_sources([gyro, accel]), "kalibr")
    found = parse_yaml(text)
    assert found["update_rate"] == 400.0
    assert found["gyroscope_noise_density"] == pytest.approx(2e-4)
    assert found["accelerometer_noise_density"] == pytest.approx(3e-4)
    assert "# source: gyro.json and accel.json" in text
    assert "# the sample rates differ (gyro.json 400 Hz, accel.json 250 Hz); that of the first is used" in text
    with pytest.raises(ConfigError, match=r"accel\.json: az in another source too"):
        exporters.join_sources([accel, gyro, accel])


def test_bounds_are_named_with_the_gain_of_a_longer_recording() -> None:
    noise = exporters.from_analysis_json(GYRO_RESULT % (100.0, "gx", 2e-4))
    assert exporters.describe_weak_points(noise)[1].startswith("upper bounds instead of values: K (gx); a recording 4 ")
    assert exporters.describe_weak_points(make_coefficients(MODEL)) == []


def parse_matlab_properties(text: str) -> dict[str, dict[str, Any]]:
    """Parse the name-value pairs per constructor, with continuations and comments as in MATLAB."""
    joined = re.sub(r"\.\.\..*\n", " ", re.sub(r"^%.*\n", "", text, flags=re.M))
    found: dict[str, dict[str, Any]] = {}
    for variable, maker, body in re.findall(r"(\w+) = (\w+)\((.*)\);", joined):
        pairs = re.findall(r"'(\w+)', (\[[^\]]*\]|'[^']*'|[\w.]+(?:\(\d+\))?)", body.removeprefix("'accel-gyro', "))
        found[f"{variable}={maker}"] = {
            name: [float(x) for x in value[1:-1].split()] if value.startswith("[") else value for name, value in pairs
        }
    return found


def test_matlab_gets_a_value_per_axis_and_single_sided_noise() -> None:
    found = parse_matlab_properties(exporters.export(make_coefficients(), "gyroparams", 2.0))
    gyro, accel, imu = found["gyro=gyroparams"], found["accel=accelparams"], found["imu=imuSensor"]
    assert gyro["NoiseDensity"] == pytest.approx([2e-4, 2e-4, 2e-4])
    assert gyro["BiasInstability"] == pytest.approx([0.0, 0.0, 1e-4])
    assert gyro["RandomWalk"] == pytest.approx([2e-6, 2e-6, 2e-6])
    assert gyro["NoiseType"] == "'single-sided'"
    assert gyro["BiasInstabilityCoefficients"] == "fractalcoef(500)"
    assert accel["NoiseDensity"] == pytest.approx([2e-3, 2e-3, 2e-3])
    assert accel["RandomWalk"] == pytest.approx([4e-5, 4e-5, 4e-5])
    assert imu == {"SampleRate": "200.0", "Gyroscope": "gyro", "Accelerometer": "accel"}


def test_matlab_gets_zero_instead_of_a_bound() -> None:
    text = exporters.export(make_analysis_coefficients(), "gyroparams")
    found = parse_matlab_properties(text)
    assert found["gyro=gyroparams"]["RandomWalk"] == pytest.approx([0.0, 3e-6, 0.0])
    assert "% K, (rad/s)*sqrt(Hz); gx only bounded, <= 9e-06; gz unknown" in text
    assert text.isascii()


def test_matlab_bias_instability_gives_flicker_noise_of_this_level() -> None:
    """MATLAB filters white noise by 1/A(z); A of ``fractalcoef`` has a_k = a_{k-1} (k - 3/2)/k by Kasdin."""
    gyro = parse_matlab_properties(exporters.export(make_coefficients(), "gyroparams"))["gyro=gyroparams"]
    b, poles = gyro["BiasInstability"][2], int(gyro["BiasInstabilityCoefficients"][12:-1])
    a = np.ones(poles + 1)
    for k in range(1, poles + 1):
        a[k] = a[k - 1] * (k - 1.5) / k
    f = np.geomspace(2.0 / poles, 0.05, 20)  # cycles per sample
    gain = 1.0 / np.abs(np.exp(-2j * np.pi * f[:, None] * np.arange(poles + 1)) @ a) ** 2
    assert b**2 * gain == pytest.approx((5e-5) ** 2 / (2 * np.pi * f), rel=0.1)


def test_kalman_blocks_have_the_expected_values() -> None:
    text = exporters.export(make_coefficients(), "kalman")
    found = tomllib.loads(text)
    assert found["schema"] == "imu-monitor/kalman/1"
    dt, n, k = 0.005, 1e-4, 1e-6
    assert found["dt"] == dt
    gx = found["gx"]
    assert gx["states"] == ["angle", "bias_walk"]
    assert gx["psd_white"] == pytest.approx(n**2)
    assert gx["psd_walk"] == pytest.approx(k**2)
    by_hand = [[n**2 * dt + k**2 * dt**3 / 3, k**2 * dt**2 / 2], [k**2 * dt**2 / 2, k**2 * dt]]
    np.testing.assert_allclose(gx["Q"], by_hand, rtol=1e-9)
    np.testing.assert_allclose(gx["F"], [[1, dt], [0, 1]])
    gz = found["gz"]
    assert gz["states"] == ["angle", "bias_walk", "bias_markov"]
    assert gz["sigma_markov"] == pytest.approx(5e-5 * 0.66432 / 0.61801, rel=1e-4)
    assert gz["correlation_time"] == pytest.approx(math.sqrt(3) * n / k / 1.89, rel=1e-6)
    assert gz["psd_markov"] == pytest.approx(2 * gz["sigma_markov"] ** 2 / gz["correlation_time"], rel=1e-5)
    assert found["az"]["states"][0] == "velocity"
    assert "az.bias" in text


@pytest.mark.parametrize("dt", [1e-3, 0.5, 30.0, 200.0])
def test_discrete_noise_is_the_integral_of_the_continuous_noise(dt: float) -> None:
    """The integral follows Van Loan, IEEE Trans. Automatic Control 23(3), 1978."""
    n, k, sigma, time = 2e-4, 3e-6, 4e-5, 50.0
    f = np.array([[0.0, 1.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, -1 / time]])
    g = np.diag([n**2, k**2, 2 * sigma**2 / time])
    whole = expm(np.block([[-f, g], [np.zeros((3, 3)), f.T]]) * dt)
    phi = whole[3:, 3:].T
    np.testing.assert_allclose(state_transition_matrix(dt, time), phi, rtol=1e-10, atol=1e-15)
    np.testing.assert_allclose(process_noise_matrix(dt, n, k, sigma, time), phi @ whole[:3, 3:], rtol=1e-8, atol=1e-20)


@pytest.mark.parametrize("x", [0.0999, 0.1001])
def test_series_and_closed_form_agree_at_their_boundary(x: float) -> None:
    own = process_noise_matrix(x, 0.0, 0.0, 1.0, 1.0)[0, 0]
    assert own == pytest.approx(2.0 * (x - 2 * (1 - math.exp(-x)) + (1 - math.exp(-2 * x)) / 2), rel=1e-10)


def test_markov_process_has_its_peak_at_the_stated_tau() -> None:
    """The Allan variance of exponentially correlated noise is given by IEEE Std 952, C.1.1.7."""

    def deviation(log_tau: float) -> float:  # σ = T = 1
        tau = math.exp(log_tau)
        return -math.sqrt(2 / tau * (1 - (3 - 4 * math.exp(-tau) + math.exp(-2 * tau)) / (2 * tau)))

    peak = minimize_scalar(deviation, bounds=(-1.0, 2.0), method="bounded")
    assert math.exp(peak.x) == pytest.approx(MARKOV_PEAK_AT, rel=2e-3)
    assert -peak.fun == pytest.approx(MARKOV_PEAK_RATIO, rel=2e-3)


def test_bias_instability_without_a_plateau_needs_a_correlation_time() -> None:
    text = "sample_rate = 10.0\n[gx.bias_instability]\nB = 1e-5"
    without = exporters.export(make_coefficients(text), "kalman")
    assert tomllib.loads(without)["gx"]["states"] == ["angle", "bias_walk"]
    assert "# B is omitted" in without
    given = tomllib.loads(exporters.export(make_coefficients(text), "kalman", 3.0, dt_s=2.0, correlation_time_s=100.0))
    assert given["inflation"] == 3.0
    assert given["gx"]["correlation_time"] == 100.0
    sigma = 3e-5 * math.sqrt(2 * math.log(2) / math.pi) / (0.437 * math.sqrt(2))
    assert given["gx"]["Q"][2][2] == pytest.approx(sigma**2 * (1 - math.exp(-0.04)), rel=1e-6)


def test_kalman_uses_a_bound_and_marks_it() -> None:
    text = exporters.export(make_analysis_coefficients(), "kalman")
    assert tomllib.loads(text)["gx"]["psd_walk"] == pytest.approx(9e-6**2)
    assert "# UPPER BOUND instead of a value: K" in text
    unseen = exporters.export(make_analysis_coefficients("unestimated"), "kalman")
    assert tomllib.loads(unseen)["gx"]["psd_walk"] == 0.0
    assert "# unknown, set to 0: B, K" in unseen


@pytest.mark.parametrize("form", list(exporters.FORMATS))
def test_shipped_model_can_be_exported_to_every_format(form: str) -> None:
    model = NoiseModel.from_toml((CONFIG_FOLDER / "models" / "consumer-mems.toml").read_text())
    text = exporters.export(exporters.from_model(model, "consumer-mems.toml"), form)
    assert text.isascii()
    assert "consumer-mems.toml" in text
    assert "inflation: none" in text


@pytest.mark.parametrize(
    ("form", "inflation", "options", "message"),
    [
        ("yaml", 1.0, {}, 'unknown format "yaml"; possible are kalibr, allan_variance_ros, openvins'),
        ("kalibr", 0.5, {}, "inflation: 0.5 is outside the supported range"),
        ("kalibr", math.nan, {}, "inflation: nan"),
        ("kalman", 1.0, {"dt_s": 0.0}, "a time step of 1 µs"),
        ("kalman", 1.0, {"correlation_time_s": -1.0}, "correlation time: -1 s"),
    ],
)
def test_invalid_request_is_refused(form: str, inflation: float, options: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        exporters.export(make_coefficients(), form, inflation, **options)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        '{"schema": "imu-monitor/event/1", "axes": {}}',
        '{"schema": "imu-monitor/coefficients/1", "axes": {}, "temperature_shares": {"gx": 1e308}}',
        b"\xff\xfe",
    ],
)
def test_invalid_analysis_is_refused(text: str | bytes) -> None:
    with pytest.raises(ConfigError):
        exporters.from_analysis_json(text)


@pytest.mark.parametrize("form", ["kalibr", "gyroparams", "kalman"])
def test_temperature_dependent_axis_gives_a_warning(form: str) -> None:
    estimated = {"value": 1e-4, "lo": 9e-5, "hi": 1.1e-4, "status": "estimated"}
    axis = {"coefficients": dict.fromkeys("NBK", estimated)}
    axes: dict[str, Any] = dict.fromkeys(("gx", "gy", "gz", "ax", "ay", "az"), axis)
    old = json.dumps({"schema": "imu-monitor/analyze/1", "rate": 100.0, "axes": axes})
    assert "WARNING" not in exporters.export(exporters.from_analysis_json(old), form)
    axes["gy"] = {**axis, "temperature": {"share": 0.987, "p_value": 1e-9, "form": "cubic", "later": 1}}
    new = json.dumps({"schema": "imu-monitor/analyze/1", "rate": 100.0, "axes": axes})
    exported = exporters.export(exporters.from_analysis_json(new), form)
    mark = "%" if form == "gyroparams" else "#"
    [line] = [line for line in exported.splitlines() if "WARNING" in line]
    assert line == (
        f"{mark} WARNING: gy follows its temperature, which explains 98 % of its slow variance "
        "and is part of B and K of gy"
    )


def test_coefficients_of_a_daemon_are_marked_by_its_thermal_models() -> None:
    """A message of an earlier revision says nothing about temperature."""
    estimated = {"value": 1e-4, "lo": 9e-5, "hi": 1.1e-4, "status": "estimated"}
    terms = dict.fromkeys("NBK", estimated)
    axes = dict.fromkeys(("gx", "gy", "az"), terms)
    message: dict[str, Any] = {"schema": "imu-monitor/coefficients/1", "rate": 100.0, "axes": axes}
    assert exporters.from_analysis_json(json.dumps(message)).remarks == (
        "not checked for temperature: B and K of gx, gy, az; no live thermal model",
    )
    message["temperature_shares"] = {"gx": 0.0, "gy": 0.987}
    noise = exporters.from_analysis_json(json.dumps(message))
    assert noise.remarks == (
        "WARNING: gy follows its temperature, which explains 98 % of its slow variance and is part of B and K of gy",
        "not checked for temperature: B and K of az; no live thermal model",
    )
    assert all(f"# {remark}" in exporters.export(noise, "kalibr").splitlines() for remark in noise.remarks)


@pytest.mark.parametrize(
    ("k", "k_text"),
    [
        (
            {"value": 2e-6, "lo": 1.8e-6, "hi": 2.2e-6, "status": "estimated"},
            "2e-06 (95 % interval 1.8e-06 to 2.2e-06)",
        ),
        ({"value": None, "lo": None, "hi": 2.9e-6, "status": "upper_bound"}, "<= 2.9e-06 (one-sided 95 % bound)"),
        ({"value": None, "lo": None, "hi": None, "status": "unestimated"}, "8.8e-06 (95 % interval 8e-06 to 9e-06)"),
    ],
)
def test_coefficients_without_temperature_are_exported(k: dict[str, Any], k_text: str) -> None:
    """K with temperature is exported only if K without temperature is unknown."""
    own = {
        "N": {"value": 1e-4, "lo": 9e-5, "hi": 1.1e-4, "status": "estimated"},
        "K": {"value": 8.8e-6, "lo": 8e-6, "hi": 9e-6, "status": "estimated"},
    }
    gx = {
        "coefficients": own,
        "temperature": {"share": 0.987},
        "without_temperature": {"model": "polynomial 1", "coefficients": {"K": k}, "share": {"K": 0.9}},
    }
    axes = {"gx": gx, "ax": {"coefficients": own}}
    text = json.dumps({"schema": "imu-monitor/analyze/1", "rate": 100.0, "axes": axes})
    lines = exporters.export(exporters.from_analysis_json(text), "kalibr").splitlines()
    value = 8.8e-6 if k["status"] == "unestimated" else k["value"] or k["hi"]
    [line] = [line for line in lines if line.startswith("gyroscope_random_walk")]
    assert float(line.split()[1]) == value
    assert any(k_text in line for line in lines)
    remarks = [line for line in lines if "follows its temperature" in line]
    if k["status"] == "unestimated":
        assert len(remarks) == 1
        assert remarks[0].startswith("# WARNING: gx follows its temperature")
        assert remarks[0].endswith("is part of K of gx")
    else:
        assert remarks == ["# gx follows its temperature: K of gx without its effect (polynomial 1)"]
