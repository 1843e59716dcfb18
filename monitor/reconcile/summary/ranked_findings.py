"""Findings of a whole recording, ranked by the share of the gap that each finding explains.

The steps of all axes are grouped, so that steps with the same cause on several axes form one finding. Effects with an
identifying parameter, such as a frequency or a time, must agree in this parameter. Changed sizes of the model must
belong to the same triad and have nearly the same ratio of new to old size. All other effects with the same name form
one finding. The gap of a finding is the sum over its axes. If the model was fitted to the same recording, changed sizes
do not count as findings.

The whole gap is the sum of the explained and the remaining gaps of all axes. Each share lies between 0 and 1, and the
sum of all shares is 1. The measure is described in ``effect_contributions``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import log
from typing import Final

from drivers.data_types import AXES
from monitor.noise.effect import Effect
from monitor.noise.effects import BandwidthLimit, Narrowband, Sinusoidal
from monitor.reconcile.effect_properties import EFFECT_PROPERTIES, SIZE_PARAMETERS
from monitor.reconcile.result import (
    AddedOrResizedEffect,
    AllanInfluence,
    ParameterInterval,
    Reconciliation,
    RemainingGap,
    StepKind,
)
from monitor.reconcile.several_recordings.effect_matching import (
    distance_if_parameters_match,
    find_closest_effect,
    find_identifying_parameter,
    identifying_parameter_name,
)

PEAK_NAMES: Final = ("sinusoidal", "narrowband", "wandering_line")
"""Effects that one oscillation produces on different axes."""
MAX_LOG_RATIO_DIFFERENCE: Final = log(1.1)
"""Largest difference between the logarithms of two size ratios in the same finding."""
_SIZE_NAMES: Final = SIZE_PARAMETERS | {"scale_factor": "factor", "resolution": "step"}


@dataclass(frozen=True, slots=True)
class RankedGapCause:
    """Cause of a part of the gap on one or more axes."""

    kind: StepKind
    effect: str
    axes: tuple[str, ...]
    strongest_axis: str  # axis with the largest gain
    parameters: dict[str, ParameterInterval]  # on this axis
    size_ratio: float | None  # new size relative to the size in the model, on this axis
    old_frequency: float | None  # Hz, of a line, resonance or cutoff that has moved, on this axis
    confidence: float  # of the name, on this axis
    gain_nats: float  # explained part of the gap, over all axes
    share: float  # of the whole gap of the recording
    influences: Mapping[str, AllanInfluence]  # largest influence on the Allan deviation, by axis

    @property
    def most_influenced_axis(self) -> str | None:
        """Axis whose Allan deviation changes most, or None if the influence is unknown."""
        return max(self.influences, key=lambda axis: abs(log(self.influences[axis].ratio)), default=None)


@dataclass(frozen=True, slots=True)
class RankedRemainingGap:
    """Remaining part of the gap on one axis."""

    axis: str
    gap: RemainingGap
    share: float  # of the whole gap of the recording


@dataclass(frozen=True, slots=True)
class GapRanking:
    """Whole gap of a recording, and the parts in descending order."""

    whole_nats: float
    findings: tuple[RankedGapCause, ...]
    remainders: tuple[RankedRemainingGap, ...]

    @property
    def explained_share(self) -> float:
        """Share of the gap that the findings explain. For a recording without a gap, the share is 1."""
        return 1.0 - sum(one.share for one in self.remainders)


_AxisStep = tuple[str, AddedOrResizedEffect]


def rank_findings(r: Reconciliation) -> GapRanking:
    """Group the steps of all axes into findings, and rank findings and remaining gaps by their share of the gap."""
    steps = [
        (axis, step)
        for axis in AXES
        if axis in r.axes
        for step in r.axes[axis].steps
        if step.kind == "added" or not r.fitted_first
    ]
    steps.sort(key=lambda one: -one[1].gain_nats)
    groups: list[list[_AxisStep]] = []
    for one in steps:
        group = next((group for group in groups if _belongs_to(group, one, r)), None)
        if group is None:
            groups.append([one])
        else:
            group.append(one)
    left = _remaining_gaps(r)
    whole = sum(step.gain_nats for _, step in steps) + sum(gap.gain_nats for _, gap in left)
    findings = [_describe_group(group, whole, r) for group in groups]
    remainders = [RankedRemainingGap(axis, gap, _share(gap.gain_nats, whole)) for axis, gap in left]
    return GapRanking(
        whole,
        tuple(sorted(findings, key=lambda one: -one.gain_nats)),
        tuple(sorted(remainders, key=lambda one: -one.share)),
    )


def _remaining_gaps(r: Reconciliation) -> list[tuple[str, RemainingGap]]:
    """Return the remaining gaps of all axes. The mutual dependence of two axes counts once."""
    left = [(axis, gap) for axis in AXES if axis in r.axes for gap in r.axes[axis].remaining]
    gains = {(axis, source): gap.gain_nats for axis, gap in left if (source := gap.strongest.where.source) is not None}
    return [
        (axis, gap)
        for axis, gap in left
        if (source := gap.strongest.where.source) is None
        or (gap.gain_nats, axis) >= (gains.get((source, axis), 0.0), source)
    ]


def _share(gain_nats: float, whole_nats: float) -> float:
    return gain_nats / whole_nats if whole_nats > 0.0 else 0.0


def _belongs_to(group: Sequence[_AxisStep], one: _AxisStep, r: Reconciliation) -> bool:
    """Return True if a step has the same cause as the strongest step of a group."""
    (first_axis, first), (axis, step) = group[0], one
    if step.kind != first.kind or axis in (known for known, _ in group):
        return False
    if step.effect != first.effect and not {step.effect, first.effect} <= set(PEAK_NAMES):
        return False
    ratio, first_ratio = _size_ratio(axis, step, r), _size_ratio(first_axis, first, r)
    both_moved = step.moved_from is not None and first.moved_from is not None
    if ratio and first_ratio and not _factors_agree(axis, ratio, first_axis, first_ratio, both_moved):
        return False
    a, b = (find_identifying_parameter(two, name, r.model) for name, two in (group[0], one))
    return distance_if_parameters_match(step.effect, a, b) is not None


def _factors_agree(axis: str, ratio: float, other_axis: str, other_ratio: float, both_moved: bool) -> bool:
    """Return True if two sizes changed by nearly the same factor.

    Only axes of one triad have a common factor. A moved effect whose size is unchanged is common to both triads.
    """
    if ratio * other_ratio < 0.0:
        return False
    unchanged = both_moved and abs(log(abs(ratio))) <= MAX_LOG_RATIO_DIFFERENCE
    return (axis[0] == other_axis[0] or unchanged) and abs(log(ratio / other_ratio)) <= MAX_LOG_RATIO_DIFFERENCE


def _size_ratio(axis: str, step: AddedOrResizedEffect, r: Reconciliation) -> float | None:
    """Return the ratio of the new size to the old size, or None for an added effect or an unknown size."""
    name = _SIZE_NAMES.get(step.effect)
    now = step.parameters.get(name) if name is not None else None
    if name is None or now is None or isinstance(now.value, str) or not now.value:
        return None
    if step.effect == "scale_factor":
        return now.value
    if any(coefficient in step.parameters for coefficient in EFFECT_PROPERTIES[step.effect].sizes[1:]):
        return None  # several coefficients have no common ratio
    if step.kind != "retuned":
        return None
    before = _effect_before(axis, step, r, name)
    old = getattr(before, name, None)  # an optional size is None if the model lacks it
    return now.value / old if old else None


def _old_frequency(axis: str, step: AddedOrResizedEffect, r: Reconciliation) -> float | None:
    """Return the frequency in the model, in Hz, of a line, resonance or cutoff that has moved, or None."""
    before, place = step.moved_from, find_identifying_parameter(step, axis, r.model)
    if not isinstance(before, Sinusoidal | Narrowband | BandwidthLimit) or place is None:
        return None
    old = before.cutoff if isinstance(before, BandwidthLimit) else before.frequency
    unchanged = old == place.value or (place.lo is not None and place.hi is not None and place.lo <= old <= place.hi)
    return None if unchanged else old


def _effect_before(axis: str, step: AddedOrResizedEffect, r: Reconciliation, size_name: str) -> Effect | None:
    """Return the effect of the model under test that a step has changed, or None if the model lacks the effect."""
    if step.moved_from is not None:
        return step.moved_from
    known = [effect for effect in r.baseline.effects.get(axis, ()) if effect.name == step.effect]
    identity = find_identifying_parameter(step, axis, r.model)
    name, compared = size_name, step.parameters.get(size_name)
    if identity is not None:
        name, compared = identifying_parameter_name(step.effect), identity
    return find_closest_effect(known, step.effect, {name: compared.value}) if known and compared is not None else None


def _describe_group(group: Sequence[_AxisStep], whole_nats: float, r: Reconciliation) -> RankedGapCause:
    (axis, strongest), gain = group[0], sum(step.gain_nats for _, step in group)
    place = find_identifying_parameter(strongest, axis, r.model)
    identity = {} if place is None else {identifying_parameter_name(strongest.effect): place}
    return RankedGapCause(
        kind=strongest.kind,
        effect=strongest.effect,
        axes=tuple(name for name in AXES if name in dict(group)),
        strongest_axis=axis,
        parameters=identity | dict(strongest.parameters),
        size_ratio=_size_ratio(axis, strongest, r),
        old_frequency=_old_frequency(axis, strongest, r),
        confidence=strongest.confidence,
        gain_nats=gain,
        share=_share(gain, whole_nats),
        influences={name: step.allan for name, step in group if step.allan is not None},
    )
