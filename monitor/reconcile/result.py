"""Result types of ``reconcile``, in SI units. Times are in seconds from the start of the recording."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Literal

import numpy as np

from drivers.data_types import Floats
from monitor.noise.effect import Effect
from monitor.noise.model import NoiseModel

Decision = Literal["agrees", "explained", "partly_explained", "unexplained"]
"""Decision for an axis or a recording."""
StepKind = Literal["added", "retuned", "absent"]
"""Kind of change: an effect was added, the size of an effect was changed, or an effect has the size zero."""
FindingKind = Literal[
    "unit_error",
    "axes_permuted",
    "sample_rate_error",
    "stuck_axis",
    "frozen_rows",
    "missing_rows",
    "corrupt_rows",
    "motion",
    "temporary_vibration",
    "repeated_rows",
    "too_short",
]
"""Kinds of faults of a recording, the most serious first."""


@dataclass(frozen=True, slots=True)
class Location:
    """Location of a difference between recording and noise model."""

    frequency: tuple[float, float] | None = None  # Hz
    tau: tuple[float, float] | None = None  # s
    time: tuple[float, float] | None = None  # s from the start
    temperature: tuple[float, float] | None = None  # °C
    value: tuple[float, float] | None = None  # of the axis, SI
    source: str | None = None  # another axis

    def resolved_location_dimensions(self) -> dict[str, tuple[float, float] | str]:
        """Return the dimensions that the diagnostic resolves, by name."""
        return {name: place for name, place in asdict(self).items() if place is not None}


@dataclass(frozen=True, slots=True)
class DiagnosticGap:
    """Difference between recording and model (gap) in one diagnostic."""

    diagnostic: str  # name of the diagnostic
    where: Location
    gap: float  # size of the difference in standard deviations
    null95: float  # 95 % quantile of the gap of a true model, for one diagnostic and one axis
    threshold: float  # 99 % quantile of the largest gap of a true model, over all diagnostics and axes

    @property
    def is_significant(self) -> bool:
        """True if the gap exceeds the threshold."""
        return self.gap > self.threshold


@dataclass(frozen=True, slots=True)
class ParameterInterval:
    """Value of a parameter, with the 95 % interval if known."""

    value: float | str
    lo: float | None = None
    hi: float | None = None


@dataclass(frozen=True, slots=True)
class RecordingFinding:
    """Fault of the recording, such as a wrong unit or motion."""

    kind: FindingKind
    axes: tuple[str, ...]
    sentence: str  # description for users: fault, size and correction
    parameters: Mapping[str, ParameterInterval]
    evidence: Mapping[str, float]  # numbers that led to the decision, by name
    corrected: bool  # True if the search uses corrected samples


@dataclass(frozen=True, slots=True)
class AlternativeEffect:
    """Less likely effect that explains the same difference."""

    effect: str
    confidence: float


@dataclass(frozen=True, slots=True)
class DiagnosticPlotData:
    """Data for one plot that compares a recorded axis with the prediction of a noise model."""

    diagnostic: str  # name of the diagnostic
    x_name: str  # quantity on the x axis: "frequency", "averaging time", "time", …
    x_unit: str
    y_name: str
    y_unit: str  # SI of the axis
    log: bool  # both scales logarithmic
    x: Floats  # [k]
    measured: Floats  # [k]
    expected: Floats  # [k] expectation of the model
    lo: Floats  # [k] lower limit of the pointwise 95 % band of a true model
    hi: Floats  # [k] upper limit of the pointwise 95 % band of a true model


@dataclass(frozen=True, slots=True)
class AxisModelDiagnostics:
    """Differences and plots of all diagnostics, for one axis and one noise model."""

    gaps: tuple[DiagnosticGap, ...]  # one for each diagnostic
    plots: tuple[DiagnosticPlotData, ...]  # one for each diagnostic that has a plot


def comparable_allan_deviations(
    start: AxisModelDiagnostics, end: AxisModelDiagnostics
) -> tuple[DiagnosticPlotData, DiagnosticPlotData]:
    """Return the Allan deviations of the model under test and of the extended model.

    If the search replaced samples, such as outliers, their share of the measured Allan variance is added to the
    extended model. The figures show these curves, and the stated ratios are ratios of these curves.

    Parameters
    ----------
    start, end : AxisModelDiagnostics
        Diagnostics with the model under test and with the extended model.
    """
    before, after = (next(view for view in one.plots if view.diagnostic == "allan") for one in (start, end))
    replaced = np.fmax(before.measured**2 - after.measured**2, 0.0)
    curves = {name: np.sqrt(getattr(after, name) ** 2 + replaced) for name in ("measured", "expected", "lo", "hi")}
    return before, replace(after, **curves)


@dataclass(frozen=True, slots=True)
class AllanInfluence:
    """Change of the Allan deviation of an axis at the averaging time that an effect influences most."""

    ratio: float  # Allan deviation of the extended model relative to the model under test, all changes included
    tau_s: float  # averaging time with the largest influence of the effect


@dataclass(frozen=True, slots=True)
class AddedOrResizedEffect:
    """Effect that the search added to the noise model, or effect of the noise model with a new size."""

    kind: StepKind
    effect: str
    parameters: Mapping[str, ParameterInterval]
    confidence: float
    runners_up: tuple[AlternativeEffect, ...]
    before: DiagnosticGap  # difference that led to the change of the model
    after: DiagnosticGap  # the same diagnostic after the change
    held_out: tuple[float, float] | None  # gap before and after the change in cross-validation, standard deviations
    held_out_reason: str  # reason for the missing held-out gap, or empty
    because: str  # justification in sentences
    snapshot_after: AxisModelDiagnostics
    gain_nats: float = 0.0  # part of the gap that the effect closes
    allan: AllanInfluence | None = None
    moved_from: Effect | None = None  # effect of the model under test whose frequency, shape or step has changed


@dataclass(frozen=True, slots=True)
class RemainingGap:
    """Part of the gap of an axis that no effect explains."""

    group: str  # group of diagnostics that detect the same difference
    strongest: DiagnosticGap  # strongest diagnostic of the group
    gain_nats: float


@dataclass(frozen=True, slots=True)
class AxisResult:
    """Result of the search for missing effects on one axis."""

    axis: str
    verdict: Decision
    start: AxisModelDiagnostics  # comparison with the model under test
    steps: tuple[AddedOrResizedEffect, ...]
    left_over: tuple[DiagnosticGap, ...]  # significant differences that remain
    end: AxisModelDiagnostics  # comparison with the extended model
    remaining: tuple[RemainingGap, ...] = ()  # the differences of ``left_over`` in groups, the largest gap first


@dataclass(frozen=True, slots=True)
class Reconciliation:
    """Result of the comparison of one recording with a noise model."""

    verdict: Decision
    axes: Mapping[str, AxisResult]  # in AXES order
    baseline: NoiseModel  # model under test
    model: NoiseModel  # extended model
    fitted_first: bool  # True if the model under test was fitted to this recording
    rate_hz: float
    samples: int
    duration_s: float
    seed: int
    notes: tuple[str, ...] = ()
    recording_findings: tuple[RecordingFinding, ...] = ()  # the most serious fault first
    failed_candidates: tuple[str, ...] = ()  # candidate effects that were dropped because they failed numerically


def combine_decisions(verdicts: Iterable[Decision]) -> Decision:
    """Combine the decisions for all axes into one decision for the recording."""
    every = set(verdicts)
    if every <= {"agrees"}:
        return "agrees"
    if every <= {"agrees", "explained"}:
        return "explained"
    return "unexplained" if every <= {"agrees", "unexplained"} else "partly_explained"
