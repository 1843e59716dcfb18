"""Example messages of each kind, built with operations that give the same digits on every machine."""

from pathlib import Path

import numpy as np

from drivers.data_types import Event
from monitor.common.device_health import Health
from monitor.common.loss_of_samples import LossOfSamples
from monitor.drift.thermal.live_thermal import ThermalIntervalResult
from monitor.drift.thermal.online_thermal_model import MeasuredAndPredictedMean
from monitor.drift.thermal.residual_alarm import PredictionInterval
from monitor.drift.thermal.temperature_removal import TemperatureDependence, TemperatureRemovalComparison
from monitor.estimation.allan.curve import AllanCurve, VarianceCurve
from monitor.estimation.allan.dynamic_allan import DynamicAllan
from monitor.estimation.analysis import RecordingAnalysis
from monitor.estimation.detection.change_detection import Change
from monitor.estimation.detection.comparison_with_noise_model import AxisModelComparison, ModelComparison
from monitor.estimation.detection.motion_detection import MotionEpisode
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficient_fit import empty_fit
from monitor.estimation.fit.coefficients_with_intervals import Coefficients, Status
from monitor.history.bucketed_history import HistoryTable
from monitor.history.query_parameters import PARTS, HistoryQuery
from monitor.history.stored_events import StoredEvent
from monitor.history.time_ranges import TimeRange
from monitor.publishing.messages.analysis_json import AnalysisMessage, FailedAnalysisMessage
from monitor.publishing.messages.history import HistoryMessage
from monitor.publishing.messages.message import Message
from monitor.publishing.messages.results import (
    AllanMessage,
    CoefficientsMessage,
    EventMessage,
    ModelGapMessage,
    ResetReply,
    StatusMessage,
    ThermalPredictionMessage,
    TotalAndHadamardCurves,
    TotalAndHadamardMessage,
)

EXAMPLES = Path(__file__).parent / "examples"
UNIX_S = 1763700000.01
TAU_S = np.array([0.01, 0.02, 0.04])
SIX = np.arange(1.0, 7.0)


def make_estimate() -> Estimate:
    """Three gyroscopes: gz has one value less, gy has K or R, Q is a bound, and R is not estimated."""
    avar = np.outer(1.0 / TAU_S, SIX) * 1e-10
    avar[:, 3:] = np.nan
    avar[2, 2] = np.nan
    sigma = np.sqrt(avar)
    curve = AllanCurve(
        TAU_S, np.array([1, 2, 4]), avar, np.ones((3, 6), np.int64), np.ones((3, 6)), 0.5 * sigma, 2.0 * sigma, 1500
    )
    shorter = AllanCurve(TAU_S, curve.factors, 4.0 * avar, curve.terms, curve.edf, 0.25 * sigma, 4.0 * sigma, 500)
    return Estimate(
        10**18, 100.0, 60.0, 360_000, curve, avar, make_coefficients(), np.array([False, True, *[False] * 4]), shorter
    )


def make_coefficients(scale: float = 1.0) -> Coefficients:
    value = scale * np.outer([1e-6, 1e-4, 1e-5, 1e-7, 1e-9], SIX)
    lo, hi, status = 0.5 * value, 2.0 * value, np.full((5, 6), Status.ESTIMATED, np.int8)
    value[0], lo[0], status[0] = np.nan, 0.0, Status.UPPER_BOUND
    value[4], lo[4], hi[4], status[4] = np.nan, np.nan, np.nan, Status.UNESTIMATED
    return Coefficients(value, lo, hi, status)


def make_comparison() -> ModelComparison:
    def make_axis_comparison(name: str) -> AxisModelComparison:
        return AxisModelComparison(
            name, np.array([3e-4, 2e-4, np.nan]), np.array([2e-4, 2.5e-4, 1e-4]), np.array([6.5, -1.25, np.nan]),
            6.5, (0.01, 0.02), 0, 2.5, 3.5, 4.5, 1500,
        )  # fmt: skip

    return ModelComparison(
        10**18,
        100.0,
        60.0,
        360_000,
        1500,
        TAU_S,
        {"gx": make_axis_comparison("gx"), "gz": make_axis_comparison("gz")},
        {"gz": False},
    )


def make_thermal_result() -> ThermalIntervalResult:
    gz = MeasuredAndPredictedMean(
        3e-4, 1e-6, PredictionInterval(2e-4, 1e-4, 3e-4), PredictionInterval(2.2e-4, 1.8e-4, 2.6e-4), "linear", 2e-5, ""
    )
    az = MeasuredAndPredictedMean(9.81, np.nan, None, None, "", np.nan, "the temperature hardly moved")
    return ThermalIntervalResult(0, 600.0, 25.5, {"gz": gz, "az": az})


def make_total_and_hadamard_curves() -> tuple[VarianceCurve, VarianceCurve]:
    found = make_estimate().curve
    lo = found.lo.copy()
    lo[1:] = np.nan
    total = VarianceCurve(TAU_S, found.factors, found.avar, found.terms, found.edf, lo, found.hi)
    two = slice(0, 2)
    hadamard = VarianceCurve(
        TAU_S[two], found.factors[two], 0.25 * found.avar[two], found.terms[two], found.edf[two], lo[two], found.hi[two]
    )
    return total, hadamard


def make_event() -> Event:
    return Event(
        "noise_changed", 5_000_000_000, "gz rose; tcp://user:secret@host", "gz",
        {"N": {"before": 1.5e-4, "after": 2.5e-4}, "B": {"before": np.nan, "after": 1e-5}}, 1_000_000_000, 9.5,
    )  # fmt: skip


def make_health() -> Health:
    return Health(
        "running", 99.98, 360_000, 3, 1, 2, 0.0025, None, 182_000_000,
        {"zenoh": "ok", "viewer": "stalled (3 dropped)"}, "too slow", 3600.5, 4, 5, True, 6, ("gz N", "ax B"),
        LossOfSamples(0.012, {"N": 0.006, "K": 0.04}),
    )  # fmt: skip


def make_analysis() -> RecordingAnalysis:
    motion = MotionEpisode("knock", 250, 400, 0.5, "gx", 0.25, "knocked")
    noise = Change("noise_changed", 2, 25_000, 25_100, 9.5, {"N": (1.5e-4, 2.5e-4)}, "gz rose")
    line = Change("noise_changed", 0, 30_000, 30_100, 12.0, {"band": (10.0, 20.0), "rms": (1e-3, 2e-3)}, "gx line")
    found = make_estimate()
    return RecordingAnalysis(
        found, 15.0, ("a note",), np.zeros((1, 6)), empty_fit(found.curve.avar),
        np.array([np.nan, 33.5, *[np.nan] * 4]), (motion,), (noise, line), False, ("gz",),
    )  # fmt: skip


def make_dynamic_curves() -> DynamicAllan:
    deviation = np.multiply.outer(np.array([1.0, 2.0]), np.outer(TAU_S, SIX))
    deviation[0, 2] = np.nan
    value = np.multiply.outer(np.array([1.0, 2.0]), make_coefficients().value)
    status = np.stack([make_coefficients().status] * 2)
    return DynamicAllan(
        np.array([10.0, 15.0]), 10.0, 100.0, TAU_S, deviation, 0.5 * deviation, 2.0 * deviation,
        value, 0.5 * value, 2.0 * value, status,
    )  # fmt: skip


def make_temperature_removal() -> TemperatureRemovalComparison:
    return TemperatureRemovalComparison(
        {"gz": "cubic"}, make_coefficients(), make_coefficients(0.5), (False,) * 6,
        {"gz": TemperatureDependence(0.75, 1e-6, "cubic", True, 60.0)},
    )  # fmt: skip


def make_history() -> HistoryTable:
    """Return two buckets: N is estimated in the first and bounded in the second."""
    names = (
        "gz.N", "gz.N.lo", "gz.N.hi", "gz.N.bound", "gz.sigma.0.1", "gz.sigma.1", "rate", "latency",
        "memory", "temperature",
    )  # fmt: skip
    last = np.array([
        [1.1e-4, 1e-4, 1.2e-4, np.nan, 3e-4, np.nan, 99.98, 0.0025, 1.8e8, 21.3],
        [np.nan, np.nan, np.nan, 3e-4, 4e-4, 5e-4, np.nan, np.nan, 1.9e8, np.nan],
    ])  # fmt: skip
    n = np.isfinite(last).astype(np.int64) * 3
    return HistoryTable(
        "bench-1", TimeRange(UNIX_S - 120.0, UNIX_S), 60, np.array([1763699880, 1763699940]), np.array([60, 60]),
        names, n, (0.5 * last).astype(np.float32), (2.0 * last).astype(np.float32), last.astype(np.float32),
        np.array([[6000, 1, 2, 3], [5000, 0, 0, 0]]), np.array([1, 3]),
        (
            StoredEvent(
                UNIX_S - 30.0, "noise_changed", "gz rose", "gz", {"N": {"before": 1e-4, "after": 2e-4}}, UNIX_S, 9.5, 3
            ),
            StoredEvent(UNIX_S - 20.0, "moved", "moved"),
        ),
        2,
    )  # fmt: skip


def make_messages() -> dict[str, Message | AnalysisMessage | FailedAnalysisMessage]:
    """Return a message of each kind by the name of its stored payload."""
    device, query = "bench-1", HistoryQuery(what=PARTS)
    waiting = Health("waiting", None, 0, 0, 0, 0, None, None, 1, {}, "", 0.5)
    return {
        "allan": AllanMessage.from_result(device, UNIX_S, 0, make_estimate()),
        "coefficients": CoefficientsMessage.from_result(device, UNIX_S, 0, make_estimate()),
        "total": TotalAndHadamardMessage.from_result(
            device, UNIX_S, 360_000, TotalAndHadamardCurves(*make_total_and_hadamard_curves())
        ),
        "gap": ModelGapMessage.from_result(device, UNIX_S, 0, make_comparison()),
        "thermal": ThermalPredictionMessage.from_result(device, UNIX_S, 360_000, make_thermal_result()),
        "event": EventMessage.from_result(device, UNIX_S, 7, make_event()),
        "event_plain": EventMessage.from_result(device, UNIX_S, 7, Event("link_back", 0, "back")),
        "status": StatusMessage.from_result(device, UNIX_S, 0, make_health()),
        "status_before_the_first_sample": StatusMessage.from_result(device, None, 0, waiting),
        "reset": ResetReply.from_result(device, UNIX_S, 7, "the window is empty"),
        "history": HistoryMessage.build_reply(make_history(), query, UNIX_S, 7),
        "history_of_one_coefficient": HistoryMessage.build_reply(
            make_history(), HistoryQuery(what=("coefficients",), axes=("gz",), symbols=("B", "N")), UNIX_S, 7
        ),
        "analyze": AnalysisMessage.from_analysis(make_analysis()),
        "analyze_with_all_curves": AnalysisMessage.from_analysis(
            make_analysis(), *make_total_and_hadamard_curves(), make_dynamic_curves(), make_temperature_removal()
        ),
        "analyze_failed": FailedAnalysisMessage(3, ["too few samples"]),
    }
