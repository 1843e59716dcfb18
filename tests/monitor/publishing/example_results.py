"""Example estimates from the five-term formula, and other example results, for all outputs."""

from dataclasses import replace

import numpy as np

from drivers.data_types import AXES
from monitor.common.device_health import Health
from monitor.drift.thermal.live_thermal import ThermalIntervalResult
from monitor.drift.thermal.online_thermal_model import MeasuredAndPredictedMean
from monitor.drift.thermal.residual_alarm import PredictionInterval
from monitor.estimation.allan.curve import AllanCurve, VarianceCurve
from monitor.estimation.allan.hadamard import compute_hadamard_curve
from monitor.estimation.allan.total import compute_total_curve
from monitor.estimation.analysis import RecordingAnalysis
from monitor.estimation.detection.comparison_with_noise_model import ModelComparison, NoiseModelComparator
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficient_fit import empty_fit
from monitor.estimation.fit.coefficients_with_intervals import Coefficients, Status
from monitor.noise.model import NoiseModel

GYRO = np.array([2.0e-6, 1.5e-4, 4.0e-5, 1.5e-6, 0.0])  # Q N B K R in SI
ACCEL = np.array([4.0e-6, 6.0e-4, 2.5e-4, 6.0e-6, 0.0])
SPREAD = np.array([1.0, 1.35, 0.8])  # x, y and z differ, as in real sensors


def compute_design_matrix(tau_s: np.ndarray) -> np.ndarray:
    """Return [m, 5] of the five-term equation (IEEE Std 952), the factors of Q² N² B² K² R²."""
    ones = np.ones_like(tau_s)
    return np.column_stack([3 / tau_s**2, 1 / tau_s, 2 * np.log(2) / np.pi * ones, tau_s / 3, tau_s**2 / 2])


def make_true_coefficients(scale: float = 1.0) -> np.ndarray:
    """Return the coefficients [5, 6] in SI units."""
    return scale * np.hstack([np.outer(GYRO, SPREAD), np.outer(ACCEL, SPREAD[::-1])])


def make_estimate(
    unix_s: float = 1.76e9, rate_hz: float = 100.0, seconds: float = 3600.0, scale: float = 1.0, seed: int = 1
) -> Estimate:
    """Return an estimate after ``seconds`` of a one-hour window, with noise on the curve and intervals by its edf."""
    rng = np.random.default_rng(seed)
    n = int(seconds * rate_hz)
    factors = 2 ** np.arange(int(np.log2(n / 4)) + 1)
    tau_s = factors / rate_hz
    truth = make_true_coefficients(scale)
    model = compute_design_matrix(tau_s) @ truth**2
    edf = np.repeat((1.5 * n / factors)[:, None], 6, axis=1)
    avar = model * rng.chisquare(edf) / edf
    half = 1.96 * np.sqrt(2 / edf)
    coefficients = make_fitted_coefficients(truth, seconds, rng)
    used = np.nan_to_num(coefficients.value)
    return Estimate(
        t_ns=int(unix_s * 1e9),
        rate_hz=rate_hz,
        window_s=3600.0,
        samples=n,
        curve=AllanCurve(
            tau_s=tau_s,
            factors=factors.astype(np.int64),
            avar=avar,
            terms=np.repeat((n - 2 * factors)[:, None], 6, axis=1),
            edf=edf,
            lo=np.sqrt(avar / np.exp(half)),
            hi=np.sqrt(avar * np.exp(half)),
            n=n,
        ),
        fitted=compute_design_matrix(tau_s) @ used**2,
        coefficients=coefficients,
        k_or_r=np.zeros(6, np.bool_),
    )


def make_fitted_coefficients(truth: np.ndarray, seconds: float, rng: np.random.Generator) -> Coefficients:
    """Return coefficients as a fit would: Q, N and B are estimated, K is estimated late, and R is a bound."""
    relative = np.array([0.03, 0.0015, 0.06, 0.3, 0.0])[:, None] * np.sqrt(10800 / seconds) * np.ones(6)
    value = truth * (1 + relative * rng.standard_normal(truth.shape))
    value = np.abs(value)
    status = np.full((5, 6), Status.ESTIMATED, np.int8)
    lo, hi = value * (1 - np.minimum(1.96 * relative, 0.95)), value * (1 + 1.96 * relative)
    bounded = np.array([False, False, seconds < 300, seconds < 1500, True])
    status[bounded] = Status.UPPER_BOUND
    hi[4] = np.repeat([3e-9, 4e-8], 3)
    value[bounded], lo[bounded] = np.nan, 0.0
    if seconds < 1500:
        status[4], lo[4], hi[4] = Status.UNESTIMATED, np.nan, np.nan
    return Coefficients(value=value, lo=lo, hi=hi, status=status)


def make_comparison(found: Estimate | None = None, scale: float = 1.0, **agrees: bool) -> ModelComparison:
    """Compare the estimate with the model of ``make_true_coefficients(scale)``, with these agreements."""
    found = found or make_estimate()
    coefficients = make_true_coefficients(scale)
    names = ("quantization_noise.Q", "angle_random_walk.N", "bias_instability.B", "rate_random_walk.K")
    text = "\n".join(
        f"[{axis}]\n" + "\n".join(f"{name} = {float(coefficients[row, i])}" for row, name in enumerate(names))
        for i, axis in enumerate(AXES)
    )
    comparator = NoiseModelComparator(NoiseModel.from_toml(text), 360_000)
    return replace(comparator.compare_with_estimate(found), agrees=agrees)


def make_thermal_result(t_ns: int = 0, bias: float = 3e-4) -> ThermalIntervalResult:
    """Return a ten-minute interval of a device that measures gz and az; az has no model yet."""
    gz = MeasuredAndPredictedMean(
        bias,
        1e-6,
        PredictionInterval(2e-4, 1e-4, 3e-4),
        PredictionInterval(2.2e-4, 1.8e-4, 2.6e-4),
        "polynomial 1",
        2e-5,
        "",
    )
    az = MeasuredAndPredictedMean(9.81, np.nan, None, None, "", np.nan, "temperature hardly changed")
    return ThermalIntervalResult(t_ns, 600.0, 25.5, {"gz": gz, "az": az})


def make_total_and_hadamard_curves() -> tuple[VarianceCurve, VarianceCurve]:
    """Return the total and Hadamard deviations of ten seconds of white noise."""
    values = 1e-3 * np.random.default_rng(3).standard_normal((1000, 6))
    theta = np.zeros((5, 6))
    theta[1] = 1e-8
    return compute_total_curve(values, 100.0, theta), compute_hadamard_curve(values, 100.0, theta)


def make_analysis(
    found: Estimate | None = None, seconds: float = 3600.0, notes: tuple[str, ...] = ()
) -> RecordingAnalysis:
    """Return an analysis with this estimate and only one sample."""
    found = found or make_estimate(seconds=seconds)
    return RecordingAnalysis(found, seconds, notes, np.zeros((1, 6)), empty_fit(found.curve.avar), np.full(6, np.nan))


def make_health(**changed: object) -> Health:
    fields: dict[str, object] = {
        "state": "running",
        "rate_hz": 99.98,
        "received": 360_000,
        "lost": 3,
        "bad": 1,
        "overflowed": 0,
        "latency_p50_s": 0.0021,
        "latency_p99_s": 0.0068,
        "memory_bytes": 182_000_000,
        "outputs": {"zenoh": "ok", "viewer": "ok"},
        "text": "",
        "uptime_s": 3600.0,
    }
    return Health(**(fields | changed))  # type: ignore[arg-type]


def simulate_samples(
    unix_s: float, seconds: float, rate_hz: float = 100.0, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times [n], samples [n, 6] at rest with z up, and temperatures [n] in °C of the example device."""
    rng = np.random.default_rng([seed, int(unix_s * 1000)])
    t = unix_s + np.arange(round(seconds * rate_hz)) / rate_hz
    sigma = make_true_coefficients()[1] * np.sqrt(rate_hz)
    values = rng.standard_normal((t.size, 6)) * sigma + np.array([2e-3, -1e-3, 5e-4, 0.05, -0.1, 9.81])
    return t, values, 31.0 + 0.8 * np.sin((t - 1.76e9) / 900)
