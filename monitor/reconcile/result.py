"""What ``reconcile`` finds, as it travels to report, JSON and viewer.

A ``Reconciliation`` has one ``AxisResult`` an axis; that has one ``Step`` for each effect that was added or retuned,
and a ``Score`` for everything that is left. A ``View`` is one axis through one lens, measured beside what the model
under test gives: what a plot shows. All sizes are SI of the axis; times are s from the start of the recording.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from drivers.sample import Floats
from monitor.noise.model import NoiseModel

Verdict = Literal["agrees", "explained", "partly_explained", "unexplained"]
Kind = Literal["added", "retuned"]


@dataclass(frozen=True, slots=True)
class Where:
    """A place: what a lens does not look along is None."""

    frequency: tuple[float, float] | None = None  # Hz
    tau: tuple[float, float] | None = None  # s
    time: tuple[float, float] | None = None  # s from the start
    temperature: tuple[float, float] | None = None  # °C
    value: tuple[float, float] | None = None  # of the axis, SI
    source: str | None = None  # another axis

    def found(self) -> dict[str, tuple[float, float] | str]:
        """What is known of the place, by name."""
        names = ("frequency", "tau", "time", "temperature", "value", "source")
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}


@dataclass(frozen=True, slots=True)
class Score:
    """How far measurement and model are apart through one lens, and where most."""

    lens: str
    where: Where
    gap: float  # 0 = perfect agreement
    null95: float  # 95 of 100 recordings of a true model stay below, through this lens
    threshold: float  # with all lenses, places and axes paid for: 99 of 100 recordings stay below all of theirs

    @property
    def passes(self) -> bool:
        """Whether this is more than chance."""
        return self.gap > self.threshold


@dataclass(frozen=True, slots=True)
class Bounds:
    """A parameter with its 95 % interval; the name of a source axis has none."""

    value: float | str
    lo: float | None = None
    hi: float | None = None


@dataclass(frozen=True, slots=True)
class RunnerUp:
    """Another name that was tried for the same gap."""

    effect: str
    confidence: float


@dataclass(frozen=True, slots=True)
class View:
    """One axis through one lens."""

    lens: str
    x_name: str  # what is along x: "frequency", "averaging time", "time", …
    x_unit: str
    y_name: str
    y_unit: str  # SI of the axis
    log: bool  # both scales logarithmic
    x: Floats  # [k]
    measured: Floats  # [k]
    expected: Floats  # [k] of the model
    lo: Floats  # [k] band that holds 95 of 100 simulated recordings, at each x by itself
    hi: Floats  # [k]


@dataclass(frozen=True, slots=True)
class Look:
    """An axis beside one model, through all lenses."""

    scores: tuple[Score, ...]  # one a lens
    views: tuple[View, ...]  # of those that have a picture


@dataclass(frozen=True, slots=True)
class Step:
    """One effect that was added, or a known one that got another size."""

    found: Score  # what led to it
    kind: Kind
    effect: str
    parameters: Mapping[str, Bounds]
    confidence: float
    runners_up: tuple[RunnerUp, ...]
    before: Score
    after: Score
    held_out_before: Score | None
    held_out_after: Score | None
    held_out_reason: str  # why there is no held-out gap; empty where there is one
    because: str  # one sentence that a person can check
    look: Look  # after the step


@dataclass(frozen=True, slots=True)
class AxisResult:
    """What was found on one axis."""

    axis: str
    verdict: Verdict
    start: Look  # beside the model that was given, or the five terms
    steps: tuple[Step, ...]
    left_over: tuple[Score, ...]
    end: Look  # beside the model with everything that was found


@dataclass(frozen=True, slots=True)
class Reconciliation:
    """What was found in one recording."""

    verdict: Verdict
    axes: Mapping[str, AxisResult]  # in AXES order
    baseline: NoiseModel  # the model that was given, or the five terms fitted first
    model: NoiseModel  # with everything that was found
    fitted_first: bool  # no model was given
    rate_hz: float
    samples: int
    seconds: float
    seed: int
    notes: tuple[str, ...] = field(default=())
