"""Messages with the results, events and status of a device."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, Final, NamedTuple, Self

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType
from numpy.typing import NDArray

from drivers.data_types import AXES, Event, Floats
from drivers.secret_masking import mask_secrets
from drivers.validation.number_ranges import RATE_HZ
from monitor.common import topics
from monitor.common.control_characters import remove_control_characters
from monitor.common.device_health import Health
from monitor.common.loss_of_samples import NO_LOSS, LossOfSamples
from monitor.drift.thermal.live_thermal import ThermalIntervalResult
from monitor.drift.thermal.residual_alarm import PredictionInterval
from monitor.estimation.allan.curve import AllanCurve, VarianceCurve
from monitor.estimation.detection.comparison_with_noise_model import ModelComparison
from monitor.estimation.estimate import Estimate
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Coefficients, Status
from monitor.noise.standard_terms import unit_coefficient_allan_variances
from monitor.publishing.messages.message import (
    Count,
    Message,
    attributes_with_field_names,
    decode_message,
)

MAX_AVERAGING_TIMES: Final = 1000
"""Largest number of averaging times that a received message may contain."""
MAX_TEXT_LENGTH: Final = 400
"""Largest length of received texts, which limits the memory use of the receiver."""
MAX_OUTPUTS: Final = 16
MAX_TIME_S: Final = 1e11
"""Largest Unix time, averaging time and duration in a received message [s]. Larger numbers overflow as nanoseconds."""
MIN_TIME_S: Final = 1e-9
MAX_DEVIATION: Final = 1e100
"""Largest Allan deviation in a received message [SI units]. The square of a larger number may overflow."""
STATUSES: Final = {status.name.lower(): status for status in Status}
STATUS_NAMES: Final = tuple(STATUSES)
OTHERS: Final = {"K": "R", "R": "K"}
"""Coefficients that the data may not distinguish from each other."""


class TotalAndHadamardCurves(NamedTuple):
    """Total and Hadamard variances of the samples in the sliding window."""

    total: VarianceCurve
    hadamard: VarianceCurve


class DeviationCurve(msgspec.Struct, frozen=True, eq=False):
    """Allan, total or Hadamard deviations of one axis with 95 % intervals."""

    deviation: Floats
    """Deviations [rad/s, m/s²], one for each averaging time."""
    lo: Floats
    """Lower ends of the 95 % intervals."""
    hi: Floats
    """Upper ends of the 95 % intervals."""


class AllanAxis(DeviationCurve, frozen=True):
    """Allan deviations of one axis."""

    recent: DeviationCurve | UnsetType = UNSET
    """Deviations of the samples in the last 16 τ, but at least in the last 10 s."""


class CoefficientValue(msgspec.Struct, frozen=True):
    """Noise coefficient of one axis with 95 % interval and status."""

    value: float | None = None
    """Coefficient in SI units. ``null`` if it is not estimated."""
    lo: float | None = None
    """Lower end of the 95 % interval."""
    hi: float | None = None
    """Upper end of the 95 % interval, or an upper bound."""
    status: str = ""
    """``estimated``, ``upper_bound`` or ``unestimated``."""
    other: str | UnsetType | None = msgspec.field(name="or", default=UNSET)
    """Other coefficient, K or R, that explains the data equally well. Absent if the data distinguish K from R."""


class SlidingWindowMessage(
    Message,
    frozen=True,
    kw_only=True,
    rename={"rate_hz": "rate", "window_s": "window", "filled_s": "filled", "tau_s": "tau"},
):
    """Base class of messages with results that are computed from the sliding window."""

    rate_hz: float | None = None
    """Sample rate that is used to compute the averaging times [Hz]."""
    window_s: float | None = None
    """Length of the sliding window [s]."""
    filled_s: float | None = None
    """Duration of the samples that the sliding window contains [s]."""


class AllanMessage(SlidingWindowMessage, frozen=True, kw_only=True, tag=topics.ALLAN.schema_name()):
    """Message ``imu/<device>/allan`` with the Allan deviations of each measured axis."""

    topic = topics.ALLAN
    tau_s: Floats
    """Averaging times [s]."""
    axes: dict[str, AllanAxis]
    poorly_fitted_axes: list[str] | UnsetType = UNSET
    """Axes whose Allan deviations are not described by the fitted coefficients. Absent if there are no such axes."""

    @classmethod
    def _convert(cls, _t: float | None, result: Estimate) -> dict[str, Any]:
        recent = [UNSET] * len(AXES) if result.display_curve is None else _deviation_curves(result.display_curve)
        own = _deviation_curves(result.curve)
        return {
            "filled_s": result.curve.n / result.rate_hz,
            "tau_s": result.curve.tau_s,
            "axes": {
                axis: AllanAxis(own[i].deviation, own[i].lo, own[i].hi, recent[i])
                for i, axis in measured_axes(result.curve)
            },
            "poorly_fitted_axes": list(result.poorly_fitted_axes) or UNSET,
        }

    def to_estimate(self, coefficients: Coefficients, k_or_r: frozenset[str]) -> Estimate:
        """Convert the message to an estimate whose degrees of freedom are unknown.

        Parameters
        ----------
        coefficients
            Noise coefficients of the device, from which the fitted Allan variance is computed.
        k_or_r
            Axes on which the data cannot distinguish K from R.

        Raises
        ------
        ValueError
            If the averaging times are not positive and increasing, if the numbers of deviations and averaging times
            differ, or if a number is outside the supported range.
        """
        tau_s, m = self.tau_s, self.tau_s.size
        rate_hz, window_s, filled_s = self.rate_hz or 0.0, self.window_s or 0.0, self.filled_s or 0.0
        rising = tau_s.ndim == 1 and bool(np.all(tau_s > 0.0) and np.all(np.diff(tau_s) > 0.0))
        if not 0 < m <= MAX_AVERAGING_TIMES or not rising or not rate_hz > 0.0 or self.t is None:
            raise ValueError("the averaging times must be positive and increasing")
        if tau_s[0] < MIN_TIME_S or max(tau_s[-1], abs(self.t), abs(filled_s)) > MAX_TIME_S:
            raise ValueError(f"the times must be from {MIN_TIME_S:g} to {MAX_TIME_S:g} s")
        if not RATE_HZ.low <= rate_hz <= RATE_HZ.high:
            raise ValueError(f"the sample rate is {rate_hz:g} Hz")
        deviation, lo, hi = (np.full((m, len(AXES)), np.nan) for _ in range(3))
        for i, axis in enumerate(AXES):
            if curve := self.axes.get(axis):
                if not curve.deviation.shape == curve.lo.shape == curve.hi.shape == (m,):
                    raise ValueError(f"{axis}: the number of deviations differs from {m} averaging times")
                if np.any(np.abs(curve.deviation) > MAX_DEVIATION):
                    raise ValueError(f"{axis}: a deviation is larger than {MAX_DEVIATION:g}")
                deviation[:, i], lo[:, i], hi[:, i] = curve.deviation, curve.lo, curve.hi
        factors, terms = np.rint(tau_s * rate_hz).astype(np.int64), np.zeros((m, len(AXES)), np.int64)
        edf = np.full((m, len(AXES)), np.nan)
        return Estimate(
            t_ns=round(self.t * 1e9),
            rate_hz=rate_hz,
            window_s=window_s,
            samples=self.samples,
            curve=AllanCurve(tau_s, factors, deviation**2, terms, edf, lo, hi, round(filled_s * rate_hz)),
            fitted=fitted_allan_variance(tau_s, rate_hz, coefficients),
            coefficients=coefficients,
            k_or_r=np.array([axis in k_or_r for axis in AXES]),
            poorly_fitted_axes=tuple(axis for axis in AXES if axis in (self.poorly_fitted_axes or ())),
        )


class CoefficientsMessage(SlidingWindowMessage, frozen=True, kw_only=True, tag=topics.COEFFICIENTS.schema_name()):
    """Message ``imu/<device>/coefficients`` with Q, N, B, K and R of each measured axis."""

    topic = topics.COEFFICIENTS
    axes: dict[str, dict[str, CoefficientValue]]
    temperature_shares: dict[str, float] | UnsetType = UNSET
    """Share of the slow variance that the live thermal model explains, by axis. 0 means no significant dependence. Axes
    without a thermal model are absent."""

    @classmethod
    def _convert(cls, _t: float | None, result: Estimate) -> dict[str, Any]:
        values = coefficient_values(result.coefficients, result.k_or_r)
        axes = {axis: values[i] for i, axis in measured_axes(result.curve)}
        shares = {axis: share for axis, share in result.temperature_shares.items() if axis in axes}
        return {
            "filled_s": result.curve.n / result.rate_hz,
            "axes": axes,
            "temperature_shares": shares or UNSET,
        }

    def to_coefficients(self) -> Coefficients:
        """Convert the message to an array of the noise coefficients of all axes.

        Raises
        ------
        ValueError
            If a coefficient has an unknown status.
        """
        value, lo, hi = (np.full((len(SYMBOLS), len(AXES)), np.nan) for _ in range(3))
        status = np.full(value.shape, Status.UNESTIMATED, np.int8)
        for column, axis in enumerate(AXES):
            for row, symbol in enumerate(SYMBOLS):
                if one := self.axes.get(axis, {}).get(symbol):
                    if one.status not in STATUSES:
                        raise ValueError(f'unknown status "{one.status}"')
                    numbers = np.array([one.value, one.lo, one.hi], np.float64)  # None becomes NaN
                    value[row, column], lo[row, column], hi[row, column] = numbers
                    status[row, column] = STATUSES[one.status]
        return Coefficients(value, lo, hi, status)


class TauRange(msgspec.Struct, frozen=True):
    """First and last averaging time of a range [s]."""

    tau: tuple[float, float]
    """First and last averaging time at which the axis differs from the model [s]."""


class AxisModelComparisonValues(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """Comparison of the measured Allan deviation of one axis with the noise model."""

    agrees: bool | None = None
    """True if the axis agrees with the model, based on a test with hysteresis. ``null`` before the first decision."""
    gap: float
    """Largest difference between measured and modelled Allan variance, in standard deviations."""
    where: TauRange
    ratio: float | None = None
    """Measured Allan deviation divided by the Allan deviation of the model, where the difference is largest."""
    null95: float | None = None
    """Limit that the gap of this axis exceeds in 5 % of the windows if the model is true."""
    threshold: float | None = None
    """Limit that the largest gap of all axes exceeds in 1 % of the windows if the model is true."""
    measured: Floats | None = None
    """Measured Allan deviations, one for each averaging time."""
    model: Floats | None = None
    """Allan deviations of the model, one for each averaging time."""
    z: Floats | None = None
    """Differences between measurement and model in standard deviations, one for each averaging time."""


class ModelGapMessage(SlidingWindowMessage, frozen=True, kw_only=True, tag=topics.GAP.schema_name()):
    """Message ``imu/<device>/gap`` that compares the measured Allan deviations with the noise model."""

    topic = topics.GAP
    tau_s: Floats | None = None
    """Averaging times [s]."""
    axes: dict[str, AxisModelComparisonValues]

    @classmethod
    def _convert(cls, _t: float | None, result: ModelComparison) -> dict[str, Any]:
        axes = {
            axis: AxisModelComparisonValues(
                agrees=result.agrees.get(axis),
                where=TauRange(one.tau_s),
                **attributes_with_field_names(AxisModelComparisonValues, one),
            )
            for axis, one in result.axes.items()
        }
        return {"filled_s": result.n / result.rate_hz, "axes": axes}


class AxisBiasPrediction(msgspec.Struct, frozen=True):
    """Measured and predicted mean bias of one axis in an interval."""

    bias: float | None
    """Mean bias in the interval [rad/s, m/s²]."""
    error: float | None
    """Standard error of the mean bias."""
    multi_step: PredictionInterval | None
    """Bias that is predicted from the temperature alone."""
    one_step: PredictionInterval | None
    """Bias that is predicted from the temperature and from the mean bias in the preceding interval."""
    model: str | None
    """Form of the thermal model."""
    slope: float | None
    """Mean slope of the model in the temperature range of the fit, after all lags have settled [rad/s/°C, m/s²/°C]."""
    text: str
    """Reason for a missing prediction."""


class ThermalPredictionMessage(
    Message,
    frozen=True,
    kw_only=True,
    tag=topics.THERMAL.schema_name(),
    rename={"interval_s": "interval", "temperature_c": "temperature"},
):
    """Message ``imu/<device>/thermal`` with the measured and predicted mean bias of the interval that ends at ``t``."""

    topic = topics.THERMAL
    interval_s: float
    """Length of the interval [s]."""
    temperature_c: float | None
    """Mean temperature in the interval [°C]."""
    axes: dict[str, AxisBiasPrediction]

    @classmethod
    def _convert(cls, _t: float | None, result: ThermalIntervalResult) -> dict[str, Any]:
        axes = {
            axis: AxisBiasPrediction(
                **attributes_with_field_names(AxisBiasPrediction, one) | {"model": one.model or None}
            )
            for axis, one in result.axes.items()
        }
        return {"axes": axes}


class DeviationTable(msgspec.Struct, frozen=True, eq=False):
    """Total or Hadamard deviations of all measured axes at the same averaging times."""

    tau: Floats
    """Averaging times [s]."""
    axes: dict[str, DeviationCurve]

    @classmethod
    def from_curve(cls, curve: VarianceCurve) -> Self:
        """Build the table from the variances of all axes, and omit axes without values."""
        known: Any = np.isfinite(curve.variance).any(axis=0)
        return cls(curve.tau_s, {AXES[i]: one for i, one in enumerate(_deviation_curves(curve)) if known[i]})


class TotalAndHadamardMessage(Message, frozen=True, kw_only=True, tag=topics.TOTAL.schema_name()):
    """Message ``imu/<device>/total`` with total and Hadamard deviations."""

    topic = topics.TOTAL
    total: DeviationTable
    hadamard: DeviationTable

    @classmethod
    def _convert(cls, _t: float | None, result: TotalAndHadamardCurves) -> dict[str, Any]:
        return {
            "total": DeviationTable.from_curve(result.total),
            "hadamard": DeviationTable.from_curve(result.hadamard),
        }


class EventMessage(Message, frozen=True, kw_only=True, tag=topics.EVENT.schema_name()):
    """Message ``imu/<device>/event`` with a detected event."""

    topic = topics.EVENT
    kind: str
    """Kind of the event."""
    axis: str | None = None
    """Axis on which the event occurred. ``null`` if the event concerns the whole device."""
    what: dict[str, dict[str, Any]] = msgspec.field(default_factory=dict)
    """Values of the affected coefficients, such as the values before and after a change."""
    since: float | None = None
    """Unix time at which the reported condition began [s]."""
    sigma: float | None = None
    """Size of the reported change, in standard errors."""
    text: str
    """Description of the event for users."""

    @classmethod
    def _convert(cls, t: float | None, result: Event) -> dict[str, Any]:
        return {
            "what": {name: dict(sides) for name, sides in result.values.items()},
            "since": None if t is None else event_start_s(t, result),
            "text": mask_secrets(result.text),
        }

    @classmethod
    def decode(cls, payload: bytes) -> Self:
        """Decode an event from another process, and remove control characters and secrets from all texts.

        Raises
        ------
        ValueError
            If the payload is not an event message, or if the event has no time.
        """
        found = decode_message(cls, payload)
        if found.t is None:
            raise ValueError("the event has no time")
        return msgspec.structs.replace(found, kind=_clean(found.kind), text=_clean(found.text))

    def to_event(self) -> Event:
        """Convert the message to an event with the changed coefficients."""
        values: dict[str, dict[str, float]] = {
            symbol: {side: value for side, value in self.what[symbol].items() if isinstance(value, float | int)}
            for symbol in SYMBOLS
            if symbol in self.what
        }
        axis = self.axis if self.axis in AXES else None
        return Event(self.kind, round((self.t or 0.0) * 1e9), self.text, axis, values)


class LatencyPercentiles(msgspec.Struct, frozen=True):
    """Percentiles of the latency."""

    p50: float | None = None
    """Median time from the receipt of a sample to its publication, over the last second [s]."""
    p99: float | None = None
    """99 % quantile of the time from the receipt of a sample to its publication, over the last second [s]."""


class StatusMessage(
    Message,
    frozen=True,
    kw_only=True,
    tag=topics.STATUS.schema_name(),
    rename={"rate_hz": "rate", "memory_bytes": "memory", "uptime_s": "uptime"},
):
    """Message ``imu/<device>/status`` with the fields of ``Health``."""

    topic = topics.STATUS
    state: str
    """``running``, ``waiting``, ``lost`` or ``ended``."""
    rate_hz: float | None = None
    """Measured sample rate [Hz]. ``null`` until the rate is known."""
    received: Count
    """Number of received samples."""
    lost: Count
    """Number of samples that did not arrive, or that arrived too late."""
    bad: Count
    """Number of samples that were rejected because of a failed check or an impossible value."""
    overflowed: Count = 0
    """Number of samples that were overwritten in the ring buffer before they were processed."""
    latency: LatencyPercentiles = LatencyPercentiles()
    memory_bytes: Count = 0
    """Memory that the whole process uses [bytes]."""
    outputs: dict[str, str] = msgspec.field(default_factory=dict)
    """State of each output: ``ok`` or a description of the problem."""
    uptime_s: float = 0.0
    """Time since the daemon started to read the device [s]."""
    repeated: Count = 0
    """Number of samples that were received twice and discarded."""
    late: Count = 0
    """Number of samples that were discarded because they already counted as missing."""
    moving: bool = False
    """True while the device is in motion."""
    moved: Count = 0
    """Number of samples that were taken during motion."""
    crossed: tuple[str, ...] = ()
    """Limits that are crossed at present, for example ``gz N``."""
    loss: LossOfSamples = NO_LOSS
    """Share of the samples in the window that are missing (``share``, 0 to 1), and the relative increase of the width
    of the interval of each coefficient that they cause (``wider``, by letter)."""
    text: str = ""
    """Description of a problem with the device, or an empty string."""

    @classmethod
    def _convert(cls, _t: float | None, result: Health) -> dict[str, Any]:
        return {
            "samples": result.received,
            "latency": LatencyPercentiles(result.latency_p50_s, result.latency_p99_s),
            "outputs": {name: mask_secrets(state) for name, state in result.outputs.items()},
            "text": mask_secrets(result.text),
        }

    @classmethod
    def decode(cls, payload: bytes) -> Self:
        """Decode a status message from another process, and remove control characters from all texts.

        Raises
        ------
        ValueError
            If the payload is not a status message.
        """
        found = decode_message(cls, payload)
        outputs = {_clean(name): _clean(state) for name, state in list(found.outputs.items())[:MAX_OUTPUTS]}
        crossed = tuple(_clean(one) for one in found.crossed)
        wider = {symbol: found.loss.wider[symbol] for symbol in SYMBOLS if symbol in found.loss.wider}
        return msgspec.structs.replace(
            found, state=_clean(found.state), text=_clean(found.text), outputs=outputs, crossed=crossed,
            loss=LossOfSamples(found.loss.share, wider),
        )  # fmt: skip

    def to_health(self) -> Health:
        """Convert the message to a ``Health`` object."""
        known = {field.name: getattr(self, field.name) for field in fields(Health) if hasattr(self, field.name)}
        return Health(**known, latency_p50_s=self.latency.p50, latency_p99_s=self.latency.p99)


class ResetReply(Message, frozen=True, kw_only=True, tag=topics.RESET.schema_name()):
    """Reply to ``imu/<device>/command/reset`` with a text for the user."""

    topic = topics.RESET
    text: str
    """Result of the command, described for users."""

    @classmethod
    def _convert(cls, _t: float | None, result: str) -> dict[str, Any]:
        return {"text": result}


class ReconcileReply(Message, frozen=True, kw_only=True, tag=topics.RECONCILE.schema_name()):
    """Reply to ``imu/<device>/command/reconcile``. The keys of this class precede the keys of the report."""

    topic = topics.RECONCILE

    def encode_report(
        self, report: Mapping[str, Any], exit_status: int, folder: str | None, kept_reports: int
    ) -> bytes:
        """Encode the reply and the report as one JSON object.

        Parameters
        ----------
        report
            JSON report of the command ``reconcile``.
        exit_status
            Exit status of the command ``reconcile``.
        folder
            Folder that contains the complete report. None if the report was not saved.
        kept_reports
            Number of newest reports of the device that are kept.
        """
        kept = {} if folder is None else {"kept_reports": kept_reports}
        head = msgspec.to_builtins(self)
        keys = {key: value for key, value in report.items() if key not in head}
        return msgspec.json.encode({**head, **keys, "exit": exit_status, "folder": folder, **kept})


def coefficient_values(
    coefficients: Coefficients, k_or_r: NDArray[np.bool_] | Sequence[bool]
) -> list[dict[str, CoefficientValue]]:
    """Return the noise coefficients of each axis by symbol.

    Parameters
    ----------
    coefficients
        Noise coefficients of all axes.
    k_or_r
        True for axes [6] on which the data cannot distinguish K from R.
    """
    arrays = (coefficients.value, coefficients.lo, coefficients.hi, coefficients.status)
    value, lo, hi, status = (array.T.tolist() for array in arrays)
    return [
        {
            symbol: CoefficientValue(a, b, c, STATUS_NAMES[d], OTHERS.get(symbol, UNSET) if either else UNSET)
            for symbol, a, b, c, d in zip(SYMBOLS, value[i], lo[i], hi[i], status[i], strict=True)
        }
        for i, either in enumerate(k_or_r)
    ]


def event_start_s(unix_s: float, event: Event) -> float | None:
    """Return the Unix time [s] at which the condition that an event reports began, or None if it is unknown.

    Parameters
    ----------
    unix_s
        Unix time of the event [s].
    event
        Event of a device.
    """
    return None if event.since_ns is None else unix_s - (event.t_ns - event.since_ns) / 1e9


def fitted_allan_variance(tau_s: Floats, rate_hz: float, coefficients: Coefficients) -> Floats:
    """Return the sum of the Allan variances of all estimated noise terms, shape [m, 6], NaN for axes without estimates.

    Parameters
    ----------
    tau_s
        Averaging times [s], shape [m].
    rate_hz
        Sample rate [Hz].
    coefficients
        Noise coefficients of all axes.
    """
    total: Floats = unit_coefficient_allan_variances(tau_s, 1.0 / rate_hz) @ np.nan_to_num(coefficients.value) ** 2
    total[:, np.isnan(coefficients.value).all(axis=0)] = np.nan
    return total


def deviations_with_interval_ends(curve: AllanCurve | VarianceCurve, axis: int) -> tuple[Floats, Floats, Floats]:
    """Return the deviations of one axis and the ends of the 95 % intervals, each of shape [m].

    Parameters
    ----------
    curve
        Allan, total or Hadamard variances of all axes.
    axis
        Column of the axis.
    """
    variance = curve.avar if isinstance(curve, AllanCurve) else curve.variance
    return np.sqrt(variance[:, axis]), curve.lo[:, axis], curve.hi[:, axis]


def measured_axes(curve: AllanCurve) -> list[tuple[int, str]]:
    """Return the column index and the name of each axis with Allan variances."""
    unmeasured: Any = np.isnan(curve.avar).all(axis=0)
    return [(i, axis) for i, axis in enumerate(AXES) if not unmeasured[i]]


def _deviation_curves(curve: AllanCurve | VarianceCurve) -> list[DeviationCurve]:
    """Return the curve of each axis. The curves contain lists, which are encoded much faster than arrays."""
    variance = curve.avar if isinstance(curve, AllanCurve) else curve.variance
    lists: Any = (array.T.tolist() for array in (np.sqrt(variance), curve.lo, curve.hi))
    return [DeviationCurve(*axis) for axis in zip(*lists, strict=True)]


def _clean(text: str) -> str:
    return remove_control_characters(mask_secrets(text[:MAX_TEXT_LENGTH]))
