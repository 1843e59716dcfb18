"""Output of ``analyze --json``: coefficients and deviations of a recording."""

from typing import Final, Self

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType
from numpy.typing import NDArray

from drivers.data_types import AXES, Floats
from monitor.drift.thermal.temperature_removal import SLOW_LETTERS, TemperatureRemoval
from monitor.estimation.allan.curve import AllanCurve
from monitor.estimation.allan.dynamic_allan import DynamicAllan
from monitor.estimation.allan.hadamard import HadamardCurve
from monitor.estimation.allan.total import TotalCurve
from monitor.estimation.analysis import Analysis
from monitor.estimation.detection.change_detection import Change
from monitor.estimation.fit.coefficient_values import SYMBOLS, Status
from monitor.publishing.messages.message import encode_json, shared_fields
from monitor.publishing.messages.results import (
    CoefficientValue,
    coefficient_values,
    deviations_with_interval_ends,
    measured_axes,
)

SCHEMA: Final = "imu-monitor/analyze/1"


class AxisDeviations(msgspec.Struct, frozen=True, eq=False):
    """Deviations of one axis with their averaging times and the ends of their 95 % intervals."""

    tau: Floats
    deviation: Floats
    lo: Floats
    hi: Floats

    @classmethod
    def of(cls, curve: AllanCurve | TotalCurve | HadamardCurve, axis: int) -> Self:
        """Return the deviations of column ``axis`` of a curve."""
        return cls(curve.tau_s, *deviations_with_interval_ends(curve, axis))


class TemperatureDependenceValues(msgspec.Struct, frozen=True, rename={"interval_s": "interval"}):
    """Measures of the dependence of the bias of an axis on temperature."""

    share: float
    p_value: float
    form: str
    one_way: bool
    interval_s: float


class CoefficientsWithoutTemperature(msgspec.Struct, frozen=True):
    """K and R of an axis after its temperature-correlated bias has been removed."""

    model: str
    coefficients: dict[str, CoefficientValue]
    share: dict[str, float | None]

    @classmethod
    def of(cls, found: TemperatureRemoval, axis: str) -> Self:
        """Return the values of one axis."""
        i = AXES.index(axis)
        values = coefficient_values(found.coefficients, i, found.k_or_r[i])
        return cls(
            found.models[axis],
            {symbol: values[symbol] for symbol in SLOW_LETTERS},
            {symbol: found.variance_share_of_temperature(symbol, axis) for symbol in SLOW_LETTERS},
        )


class AxisAnalysis(msgspec.Struct, frozen=True, kw_only=True):
    """Results of one axis. Deviations that were not computed are absent."""

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
    def of(cls, change: Change, rate_hz: float) -> Self:
        """Return the values of a change."""
        t = change.since / rate_hz
        return cls(change.kind, AXES[change.axis], t, change.sigma, change.sides(), change.text)


class CoefficientSeries(msgspec.Struct, frozen=True, eq=False):
    """Coefficient of one axis at each time step."""

    value: Floats
    lo: Floats
    hi: Floats
    status: list[str]


class DynamicAxis(msgspec.Struct, frozen=True, eq=False):
    """Dynamic Allan deviations of one axis, shape [time steps, τ], and its coefficients over time."""

    deviation: NDArray[np.float64]
    lo: NDArray[np.float64]
    hi: NDArray[np.float64]
    coefficients: dict[str, CoefficientSeries]

    @classmethod
    def of(cls, dynamic: DynamicAllan, axis: int) -> Self:
        """Return the values of column ``axis``."""
        coefficients = {
            symbol: CoefficientSeries(
                dynamic.value[:, row, axis],
                dynamic.value_lo[:, row, axis],
                dynamic.value_hi[:, row, axis],
                [Status(one).name.lower() for one in dynamic.status[:, row, axis].tolist()],
            )
            for row, symbol in enumerate(SYMBOLS)
        }
        return cls(dynamic.deviation[:, :, axis], dynamic.lo[:, :, axis], dynamic.hi[:, :, axis], coefficients)


class DynamicValues(msgspec.Struct, frozen=True, eq=False):
    """Dynamic Allan deviations. ``t`` is the time from the first sample to the end of each window [s]."""

    window: float
    t: Floats
    tau: Floats
    axes: dict[str, DynamicAxis]


class AnalysisMessage(msgspec.Struct, frozen=True, kw_only=True, eq=False, tag_field="schema", tag=SCHEMA):
    """Output of ``analyze --json``."""

    rate: float
    samples: int
    seconds: float
    notes: tuple[str, ...]
    axes: dict[str, AxisAnalysis]
    motions: list[MotionValues]
    changes: list[ChangeValues]
    dynamic: DynamicValues | UnsetType = UNSET

    @classmethod
    def of(
        cls,
        result: Analysis,
        total: TotalCurve | None = None,
        hadamard: HadamardCurve | None = None,
        dynamic: DynamicAllan | None = None,
        temperature: TemperatureRemoval | None = None,
    ) -> Self:
        """Build the output of an analysis.

        Parameters
        ----------
        result
            The analysis.
        total
            Total variance.
        hadamard
            Hadamard variance.
        dynamic
            Dynamic Allan variance.
        temperature
            K and R after the temperature-correlated bias has been removed.
        """
        estimate = result.estimate
        measured = measured_axes(estimate.curve)
        axes = {
            axis: AxisAnalysis(
                allan=AxisDeviations.of(estimate.curve, i),
                total=UNSET if total is None else AxisDeviations.of(total, i),
                hadamard=UNSET if hadamard is None else AxisDeviations.of(hadamard, i),
                coefficients=coefficient_values(estimate.coefficients, i, bool(estimate.k_or_r[i])),
                bandwidth=float(result.bandwidth_hz[i]),
                temperature=_temperature_values(result, temperature, axis),
                without_temperature=UNSET
                if temperature is None or axis not in temperature.models
                else CoefficientsWithoutTemperature.of(temperature, axis),
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
                MotionValues(t=one.since / estimate.rate_hz, **shared_fields(MotionValues, one))
                for one in result.motions
            ],
            changes=[ChangeValues.of(change, estimate.rate_hz) for change in result.changes],
            dynamic=UNSET
            if dynamic is None
            else DynamicValues(
                dynamic.window_s,
                dynamic.t_s,
                dynamic.tau_s,
                {axis: DynamicAxis.of(dynamic, i) for i, axis in measured},
            ),
        )

    def encode(self) -> bytes:
        """Encode the output as JSON."""
        return encode_json(self)


class FailedAnalysisMessage(msgspec.Struct, frozen=True, tag_field="schema", tag=SCHEMA):
    """Output of ``analyze --json`` if no estimate is possible. ``notes`` contains the reason."""

    samples: int
    notes: list[str]
    axes: dict[str, AxisAnalysis] = {}

    def encode(self) -> bytes:
        """Encode the output as JSON."""
        return encode_json(self)


def _temperature_values(
    result: Analysis, temperature: TemperatureRemoval | None, axis: str
) -> TemperatureDependenceValues | UnsetType:
    """Return the measures of an axis if temperature explains most of its slow variance."""
    if temperature is None or axis not in result.axes_of_temperature:
        return UNSET
    return TemperatureDependenceValues(**shared_fields(TemperatureDependenceValues, temperature.dependences[axis]))
