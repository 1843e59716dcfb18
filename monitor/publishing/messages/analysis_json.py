"""Output of ``analyze --json`` with the noise coefficients and Allan deviations of a recording."""

from typing import Final, Self

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType
from numpy.typing import NDArray

from drivers.data_types import AXES, Floats
from monitor.drift.thermal.temperature_removal import SLOW_LETTERS, TemperatureRemovalComparison
from monitor.estimation.allan.curve import AllanCurve, VarianceCurve
from monitor.estimation.allan.dynamic_allan import DynamicAllan
from monitor.estimation.analysis import RecordingAnalysis
from monitor.estimation.detection.change_detection import Change
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Status
from monitor.publishing.messages.message import attributes_with_field_names, encode_json
from monitor.publishing.messages.results import (
    CoefficientValue,
    coefficient_values,
    deviations_with_interval_ends,
    measured_axes,
)

SCHEMA: Final = "imu-monitor/analyze/1"


class AxisDeviations(msgspec.Struct, frozen=True, eq=False):
    """Allan, total or Hadamard deviations of one axis with averaging times and 95 % intervals."""

    tau: Floats
    deviation: Floats
    lo: Floats
    hi: Floats

    @classmethod
    def from_curve(cls, curve: AllanCurve | VarianceCurve, axis: int) -> Self:
        """Build the deviations of one axis from the variances of all axes."""
        return cls(curve.tau_s, *deviations_with_interval_ends(curve, axis))


class TemperatureDependenceValues(msgspec.Struct, frozen=True, rename={"interval_s": "interval"}):
    """Statistics of the dependence of the bias of one axis on temperature."""

    share: float
    p_value: float
    form: str
    one_way: bool
    interval_s: float


class CoefficientsWithoutTemperature(msgspec.Struct, frozen=True):
    """Coefficients B, K and R of one axis after removal of the temperature-correlated bias."""

    model: str
    coefficients: dict[str, CoefficientValue]
    share: dict[str, float | None]

    @classmethod
    def coefficients_from_temperature_removal(cls, removal: TemperatureRemovalComparison, axis: str) -> Self:
        """Build the coefficients of one axis from the fits with and without the temperature-correlated bias."""
        i = AXES.index(axis)
        values = coefficient_values(removal.coefficients, removal.k_or_r)[i]
        return cls(
            removal.models[axis],
            {symbol: values[symbol] for symbol in SLOW_LETTERS},
            {symbol: removal.variance_share_of_temperature(symbol, axis) for symbol in SLOW_LETTERS},
        )


class AxisAnalysis(msgspec.Struct, frozen=True, kw_only=True):
    """Analysis results of one axis. Deviations that were not computed are absent from the JSON output."""

    allan: AxisDeviations
    total: AxisDeviations | UnsetType = UNSET
    hadamard: AxisDeviations | UnsetType = UNSET
    coefficients: dict[str, CoefficientValue]
    bandwidth: float | None
    temperature: TemperatureDependenceValues | UnsetType = UNSET
    without_temperature: CoefficientsWithoutTemperature | UnsetType = UNSET


class MotionValues(msgspec.Struct, frozen=True):
    """Detected motion. ``t`` is the time from the first sample to the start of the motion [s]."""

    kind: str
    axis: str
    t: float
    seconds: float
    peak: float
    text: str


class ChangeValues(msgspec.Struct, frozen=True):
    """Detected change. ``t`` is the time from the first sample to the start of the change [s]."""

    kind: str
    axis: str
    t: float
    sigma: float
    what: dict[str, dict[str, float]]
    text: str

    @classmethod
    def from_change(cls, change: Change, rate_hz: float) -> Self:
        """Build the JSON values of a detected change."""
        t = change.since / rate_hz
        return cls(change.kind, AXES[change.axis], t, change.sigma, change.values_before_and_after(), change.text)


class CoefficientTimeSeries(msgspec.Struct, frozen=True, eq=False):
    """Time series of one noise coefficient of one axis."""

    value: Floats
    lo: Floats
    hi: Floats
    status: list[str]


class DynamicAllanAxis(msgspec.Struct, frozen=True, eq=False):
    """Dynamic Allan deviations of one axis, shape [time steps, τ], and coefficients over time."""

    deviation: NDArray[np.float64]
    lo: NDArray[np.float64]
    hi: NDArray[np.float64]
    coefficients: dict[str, CoefficientTimeSeries]

    @classmethod
    def from_dynamic_allan(cls, dynamic: DynamicAllan, axis: int) -> Self:
        """Build the dynamic Allan deviations of one axis."""
        coefficients = {
            symbol: CoefficientTimeSeries(
                dynamic.value[:, row, axis],
                dynamic.value_lo[:, row, axis],
                dynamic.value_hi[:, row, axis],
                [Status(one).name.lower() for one in dynamic.status[:, row, axis].tolist()],
            )
            for row, symbol in enumerate(SYMBOLS)
        }
        return cls(dynamic.deviation[:, :, axis], dynamic.lo[:, :, axis], dynamic.hi[:, :, axis], coefficients)


class DynamicAllanValues(msgspec.Struct, frozen=True, eq=False):
    """Dynamic Allan deviations. ``t`` is the time from the first sample to the end of each window [s]."""

    window: float
    t: Floats
    tau: Floats
    axes: dict[str, DynamicAllanAxis]


class AnalysisMessage(msgspec.Struct, frozen=True, kw_only=True, eq=False, tag_field="schema", tag=SCHEMA):
    """JSON object that ``analyze --json`` writes."""

    rate: float
    samples: int
    seconds: float
    notes: tuple[str, ...]
    axes: dict[str, AxisAnalysis]
    motions: list[MotionValues]
    changes: list[ChangeValues]
    dynamic: DynamicAllanValues | UnsetType = UNSET

    @classmethod
    def from_analysis(
        cls,
        result: RecordingAnalysis,
        total: VarianceCurve | None = None,
        hadamard: VarianceCurve | None = None,
        dynamic: DynamicAllan | None = None,
        temperature: TemperatureRemovalComparison | None = None,
    ) -> Self:
        """Build the JSON output of an analysis.

        Parameters
        ----------
        result
            Analysis of the recording.
        total
            Total variance, or None to omit total deviations.
        hadamard
            Hadamard variance, or None to omit Hadamard deviations.
        dynamic
            Allan deviations over time, or None if the analysis has no sliding window.
        temperature
            K and R after removal of the temperature-correlated bias, or None without a recorded temperature.
        """
        estimate = result.estimate
        measured = measured_axes(estimate.curve)
        coefficients = coefficient_values(estimate.coefficients, estimate.k_or_r)
        axes = {
            axis: AxisAnalysis(
                allan=AxisDeviations.from_curve(estimate.curve, i),
                total=UNSET if total is None else AxisDeviations.from_curve(total, i),
                hadamard=UNSET if hadamard is None else AxisDeviations.from_curve(hadamard, i),
                coefficients=coefficients[i],
                bandwidth=float(result.bandwidth_hz[i]),
                temperature=_temperature_values(result, temperature, axis),
                without_temperature=UNSET
                if temperature is None or axis not in temperature.models
                else CoefficientsWithoutTemperature.coefficients_from_temperature_removal(temperature, axis),
            )
            for i, axis in measured
        }
        return cls(
            rate=estimate.rate_hz,
            samples=estimate.samples,
            seconds=result.seconds,
            notes=result.notes,
            axes=axes,
            motions=[
                MotionValues(t=one.since / estimate.rate_hz, **attributes_with_field_names(MotionValues, one))
                for one in result.motions
            ],
            changes=[ChangeValues.from_change(change, estimate.rate_hz) for change in result.changes],
            dynamic=UNSET
            if dynamic is None
            else DynamicAllanValues(
                dynamic.window_s,
                dynamic.t_s,
                dynamic.tau_s,
                {axis: DynamicAllanAxis.from_dynamic_allan(dynamic, i) for i, axis in measured},
            ),
        )

    def encode(self) -> bytes:
        """Encode the output as JSON."""
        return encode_json(self)


class FailedAnalysisMessage(msgspec.Struct, frozen=True, tag_field="schema", tag=SCHEMA):
    """JSON object that ``analyze --json`` writes if no estimate is possible. ``notes`` contains the reason."""

    samples: int
    notes: list[str]
    axes: dict[str, AxisAnalysis] = {}

    def encode(self) -> bytes:
        """Encode the output as JSON."""
        return encode_json(self)


def _temperature_values(
    result: RecordingAnalysis, temperature: TemperatureRemovalComparison | None, axis: str
) -> TemperatureDependenceValues | UnsetType:
    if temperature is None or axis not in result.axes_of_temperature:
        return UNSET
    return TemperatureDependenceValues(
        **attributes_with_field_names(TemperatureDependenceValues, temperature.dependences[axis])
    )
