"""Result types of ``reconcile``, as used by the report, the JSON output and the viewer.

A ``Reconciliation`` holds one ``AxisResult`` for each axis. An ``AxisResult`` holds one ``ReconciliationStep`` for each
effect that was added or whose size was changed, and a ``Score`` for each difference that is left. A ``PlotData`` holds
the data of one plot: the measurement of one axis and the expectation of the model under test. All values are in SI
units of the axis. Times are in seconds from the start of the recording.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from drivers.sample import Floats
from monitor.noise.model import NoiseModel

Decision = Literal["agrees", "explained", "partly_explained", "unexplained"]
"""Decision for an axis or a recording."""
StepKind = Literal["added", "retuned"]
"""Kind of a step: an effect was added, or the size of a known effect was changed."""
FindingKind = Literal[
    "unit_error",
    "axes_permuted",
    "sample_rate_error",
    "stuck_axis",
    "frozen_rows",
    "missing_rows",
    "corrupt_rows",
    "motion",
    "repeated_rows",
    "too_short",
]
"""Kind of a fault of the recording, the gravest first."""


@dataclass(frozen=True, slots=True)
class Location:
    """Location of a difference. A dimension that the diagnostic does not resolve is None."""

    frequency: tuple[float, float] | None = None  # Hz
    tau: tuple[float, float] | None = None  # s
    time: tuple[float, float] | None = None  # s from the start
    temperature: tuple[float, float] | None = None  # °C
    value: tuple[float, float] | None = None  # of the axis, SI
    source: str | None = None  # another axis

    def found(self) -> dict[str, tuple[float, float] | str]:
        """Return the dimensions that are known, by name."""
        names = ("frequency", "tau", "time", "temperature", "value", "source")
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}


@dataclass(frozen=True, slots=True)
class Score:
    """Difference between measurement and model in one diagnostic, and the location of its maximum."""

    lens: str
    where: Location
    gap: float  # 0 = perfect agreement
    null95: float  # 95 of 100 recordings of a true model stay below this gap in this diagnostic
    threshold: float  # 99 of 100 recordings of a true model stay below it in all diagnostics, at all places and axes

    @property
    def passes(self) -> bool:
        """True if the difference is larger than chance allows."""
        return self.gap > self.threshold


@dataclass(frozen=True, slots=True)
class ParameterInterval:
    """Value of a parameter with its 95 % interval. The name of a source axis has no interval."""

    value: float | str
    lo: float | None = None
    hi: float | None = None


@dataclass(frozen=True, slots=True)
class RecordingFinding:
    """Fault of the recording itself, found before any spectrum is fitted."""

    kind: FindingKind
    axes: tuple[str, ...]
    sentence: str  # for people: what is wrong, its size, and what was done
    parameters: Mapping[str, ParameterInterval]
    evidence: Mapping[str, float]  # the numbers that decided, by name
    corrected: bool  # True if the search uses corrected samples


@dataclass(frozen=True, slots=True)
class RunnerUp:
    """Alternative effect that was tried for the same difference."""

    effect: str
    confidence: float


@dataclass(frozen=True, slots=True)
class PlotData:
    """Plot data of one axis for one diagnostic."""

    lens: str
    x_name: str  # quantity on the x axis: "frequency", "averaging time", "time", …
    x_unit: str
    y_name: str
    y_unit: str  # SI of the axis
    log: bool  # both scales logarithmic
    x: Floats  # [k]
    measured: Floats  # [k]
    expected: Floats  # [k] expectation of the model
    lo: Floats  # [k] lower limit of the pointwise band that holds 95 of 100 simulated recordings
    hi: Floats  # [k] upper limit of the same band


@dataclass(frozen=True, slots=True)
class DiagnosticSnapshot:
    """Scores and plot data of an axis, compared with one model."""

    scores: tuple[Score, ...]  # one for each diagnostic
    views: tuple[PlotData, ...]  # one for each diagnostic that has a plot


@dataclass(frozen=True, slots=True)
class ReconciliationStep:
    """Effect that was added, or an effect of the model whose size was changed."""

    found: Score  # difference that led to this step
    kind: StepKind
    effect: str
    parameters: Mapping[str, ParameterInterval]
    confidence: float
    runners_up: tuple[RunnerUp, ...]
    before: Score
    after: Score
    held_out_before: Score | None
    held_out_after: Score | None
    held_out_reason: str  # why there is no held-out gap; empty if there is a held-out gap
    because: str  # one sentence of justification that a person can check
    look: DiagnosticSnapshot  # comparison after the step


@dataclass(frozen=True, slots=True)
class AxisResult:
    """Result of the search on one axis."""

    axis: str
    verdict: Decision
    start: DiagnosticSnapshot  # comparison with the given model, or with the five terms
    steps: tuple[ReconciliationStep, ...]
    left_over: tuple[Score, ...]
    end: DiagnosticSnapshot  # comparison with the model that contains everything that was found


@dataclass(frozen=True, slots=True)
class Reconciliation:
    """Result of the comparison of one recording with a model."""

    verdict: Decision
    axes: Mapping[str, AxisResult]  # in AXES order
    baseline: NoiseModel  # the model that was given, or the five terms fitted first
    model: NoiseModel  # with everything that was found
    fitted_first: bool  # True if no model was given and the five terms were fitted
    rate_hz: float
    samples: int
    duration_s: float
    seed: int
    notes: tuple[str, ...] = field(default=())
    recording_findings: tuple[RecordingFinding, ...] = ()  # the gravest first


def combine_decisions(verdicts: Iterable[Decision]) -> Decision:
    """Combine the decisions of all axes into the decision for the recording."""
    every = set(verdicts)
    if every <= {"agrees"}:
        return "agrees"
    if every <= {"agrees", "explained"}:
        return "explained"
    return "unexplained" if every <= {"agrees", "unexplained"} else "partly_explained"
