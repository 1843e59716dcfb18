"""Result types of ``reconcile``, as used by the report, the JSON output and the viewer.

A ``Reconciliation`` contains one ``AxisResult`` for each axis. An ``AxisResult`` contains one ``AddedOrResizedEffect``
for each effect that was added or whose size was changed. It also contains one ``DiagnosticGap`` for each significant
difference that remains. All values are in SI units. Times are in seconds from the start of the recording.
"""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Literal

from drivers.data_types import Floats
from monitor.noise.model import NoiseModel

Decision = Literal["agrees", "explained", "partly_explained", "unexplained"]
"""Decision for an axis or a recording."""
StepKind = Literal["added", "retuned"]
"""Kind of a change of the model: an effect was added, or the size of an effect was changed."""


@dataclass(frozen=True, slots=True)
class Location:
    """Location of a difference in up to six dimensions. None: the diagnostic does not resolve the dimension."""

    frequency: tuple[float, float] | None = None  # Hz
    tau: tuple[float, float] | None = None  # s
    time: tuple[float, float] | None = None  # s from the start
    temperature: tuple[float, float] | None = None  # °C
    value: tuple[float, float] | None = None  # of the axis, SI
    source: str | None = None  # another axis

    def resolved_dimensions(self) -> dict[str, tuple[float, float] | str]:
        """Return the dimensions that are not None, by name."""
        return {name: place for name, place in asdict(self).items() if place is not None}


@dataclass(frozen=True, slots=True)
class DiagnosticGap:
    """Difference between measurement and model in one diagnostic, with the location of the largest difference."""

    lens: str  # name of the diagnostic
    where: Location
    gap: float  # size of the difference in standard deviations
    null95: float  # gap that 95 of 100 recordings of a true model do not exceed in this diagnostic on one axis
    threshold: float  # gap that 99 of 100 recordings of a true model do not exceed in any diagnostic on any axis

    @property
    def is_significant(self) -> bool:
        """True if the gap exceeds the threshold."""
        return self.gap > self.threshold


@dataclass(frozen=True, slots=True)
class ParameterInterval:
    """Value of a parameter with the 95 % interval. The ends are None for a parameter without an interval."""

    value: float | str
    lo: float | None = None
    hi: float | None = None


@dataclass(frozen=True, slots=True)
class RunnerUp:
    """Alternative effect for the same difference."""

    effect: str
    confidence: float


@dataclass(frozen=True, slots=True)
class PlotData:
    """Plot of one axis: the measurement and the expectation of a model."""

    lens: str  # name of the diagnostic
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
class DiagnosticSnapshot:
    """Comparison of an axis with one model in all diagnostics."""

    gaps: tuple[DiagnosticGap, ...]  # one for each diagnostic
    plots: tuple[PlotData, ...]  # one for each diagnostic that has a plot


@dataclass(frozen=True, slots=True)
class AddedOrResizedEffect:
    """Effect that was added to the model, or effect of the model whose size was changed."""

    kind: StepKind
    effect: str
    parameters: Mapping[str, ParameterInterval]
    confidence: float
    runners_up: tuple[RunnerUp, ...]
    before: DiagnosticGap  # difference that led to the change of the model
    after: DiagnosticGap  # the same diagnostic after the change
    held_out_before: DiagnosticGap | None
    held_out_after: DiagnosticGap | None
    held_out_reason: str  # reason why no held-out gap exists, or empty
    because: str  # justification in sentences
    snapshot_after: DiagnosticSnapshot


@dataclass(frozen=True, slots=True)
class AxisResult:
    """Result of the search on one axis."""

    axis: str
    verdict: Decision
    start: DiagnosticSnapshot  # comparison with the model under test
    steps: tuple[AddedOrResizedEffect, ...]
    left_over: tuple[DiagnosticGap, ...]  # significant differences that remain
    end: DiagnosticSnapshot  # comparison with the extended model


@dataclass(frozen=True, slots=True)
class Reconciliation:
    """Result of the comparison of one recording with a model."""

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


def combine_decisions(verdicts: Iterable[Decision]) -> Decision:
    """Combine the decisions of all axes into the decision for the recording."""
    every = set(verdicts)
    if every <= {"agrees"}:
        return "agrees"
    if every <= {"agrees", "explained"}:
        return "explained"
    return "unexplained" if every <= {"agrees", "unexplained"} else "partly_explained"
