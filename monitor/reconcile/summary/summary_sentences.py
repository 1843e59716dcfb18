"""Summary of a reconciliation in at most five sentences.

The sentences contain, in this order, the faults of the recording, the result with the explained share of the gap, the
findings that explain ``MAIN_SHARE`` of the gap, the remaining differences, and a recommendation. The terminal,
``report.json`` and the HTML report begin with this summary.
"""

from collections.abc import Sequence
from typing import Final

from drivers.data_types import AXES
from monitor.reconcile.result import Location, Reconciliation
from monitor.reconcile.summary.ranked_findings import GapRanking, RankedGapCause, RankedRemainingGap, rank_findings

MAIN_SHARE: Final = 0.95
"""Share of the gap that the listed findings explain together."""
MAX_LISTED: Final = 5
"""Largest number of listed findings."""
MAX_LISTED_REMAINDERS: Final = 2
UNMENTIONED_SIZE_CHANGE: Final = 0.05
"""Largest relative change of the size of a moved line that the summary does not mention."""
MIN_REMAINDER_SHARE: Final = 0.01
"""Smallest share of the gap that a remaining difference needs to be described."""
EFFECT_PHRASES: Final = {
    "angle_random_walk": "white noise N",
    "bias_instability": "bias instability B",
    "bandwidth_limit": "low-pass filter",
    "bias_step": "bias step",
    "cross_axis": "leak",
    "exponentially_correlated": "correlated noise",
    "g_sensitivity": "g sensitivity",
    "narrowband": "resonance",
    "noise_step": "step of the noise",
    "poisson_steps": "random steps",
    "quantization_noise": "quantization noise Q",
    "rate_ramp": "ramp R",
    "rate_random_walk": "random walk K",
    "resolution": "quantization steps",
    "sample_hold": "repeated samples",
    "sinusoidal": "line",
    "wandering_variance": "random variation of the noise level",
}
"""Phrase for each effect whose name cannot be used as a phrase."""
GROUP_PHRASES: Final = {
    "spectrum": "a difference in the spectrum",
    "level": "a change of the mean",
    "other_axes": "a dependence on other axes",
    "distribution": "noise that is not stationary and Gaussian",
    "values": "irregular values",
}
"""Phrase for each group of diagnostics."""
OSCILLATIONS: Final = frozenset({"sinusoidal", "narrowband", "wandering_line", "common_vibration"})
ADVISED_SHARE: Final = 0.5
"""Share of the gap above which the recommendation refers to vibration or to disturbances."""
UNIT_FAULTS: Final = frozenset({"unit_error", "axes_permuted", "sample_rate_error"})
FAULT_ADVICE: Final = (
    (UNIT_FAULTS, "Correct the unit, the axes or the sample rate where the data are recorded."),
    (frozenset({"too_short"}), "Record for longer to determine the slow terms."),
    (frozenset({"motion"}), "Repeat the recording without motion."),
    (frozenset({"temporary_vibration"}), "Repeat the recording while the source of the vibration is off."),
    (frozenset({"stuck_axis", "frozen_rows", "missing_rows", "corrupt_rows"}), "Check the connection to the sensor."),
)
"""Recommendation for each kind of fault, the most important kind first."""


def summarize(r: Reconciliation) -> tuple[str, ...]:
    """Return the summary of a reconciliation, in at most five sentences."""
    ranking = rank_findings(r)
    sentences = (
        _describe_faults(r),
        _describe_result(r, ranking),
        _describe_findings(main_findings(ranking), ranking),
        _describe_remaining_gaps(ranking),
        _recommend(r, ranking),
    )
    return tuple(sentence for sentence in sentences if sentence)


def main_findings(ranking: GapRanking) -> list[RankedGapCause]:
    """Return the first findings that explain ``MAIN_SHARE`` of the explained gap, but at most ``MAX_LISTED``."""
    aim = MAIN_SHARE * ranking.explained_share
    listed: list[RankedGapCause] = []
    for one in ranking.findings[:MAX_LISTED]:
        if listed and sum(other.share for other in listed) >= aim:
            break
        listed.append(one)
    return listed


def _describe_faults(r: Reconciliation) -> str:
    if not r.recording_findings:
        return ""
    kinds = dict.fromkeys(finding.kind for finding in r.recording_findings)
    texts = []
    for kind in kinds:
        axes = {axis for finding in r.recording_findings if finding.kind == kind for axis in finding.axes}
        texts.append(f"{kind.replace('_', ' ')}{_on_axes(axes)}")
    return f"The recording has {format_count(len(texts), 'fault')}: {', '.join(texts)}."


def _describe_result(r: Reconciliation, ranking: GapRanking) -> str:
    model = "model of five classic terms" if r.fitted_first else "model"
    if r.verdict == "agrees":
        axes = "one axis" if len(r.axes) == 1 else f"all {len(r.axes)} axes"
        return f"The {model} agrees with the recording on {axes}."
    differ = join_words([axis for axis in AXES if axis in r.axes and r.axes[axis].verdict != "agrees"])
    head = f"The {model} differs from the recording on {differ}"
    if r.verdict == "unexplained":
        return f"{head}, and no known effect explains the difference."
    share = "all" if r.verdict == "explained" else format_share(ranking.explained_share)
    if not ranking.findings:
        return f"{head}, and other sizes of the model explain {share} of the difference."
    return f"{head}, and {format_count(len(ranking.findings), 'finding')} explain {share} of the difference.".replace(
        "1 finding explain ", "1 finding explains "
    )


def _describe_findings(listed: Sequence[RankedGapCause], ranking: GapRanking) -> str:
    if not listed:
        return ""
    texts = [f"{describe_finding(one)} ({format_share(one.share)})" for one in listed]
    rest = ranking.findings[len(listed) :]
    if rest:
        smaller = format_count(len(rest), "smaller finding")
        texts.append(f"{smaller} ({format_share(sum(one.share for one in rest))})")
    said = join_words(texts)
    return f"{said[0].upper()}{said[1:]}."


def describe_finding(finding: RankedGapCause) -> str:
    """Return a finding as a phrase with its location and its axes, such as "line at 17.3 Hz on gx and gy"."""
    phrase = EFFECT_PHRASES.get(finding.effect, finding.effect.replace("_", " "))
    numbers = {name: one.value for name, one in finding.parameters.items() if not isinstance(one.value, str)}
    source = finding.parameters.get("source")
    details = [
        text
        for name, text in (
            ("frequency", "at {:.4g} Hz"),
            ("cutoff", "with a cutoff of {:.4g} Hz"),
            ("time", "at {:.5g} s"),
            ("correlation_time", "with a correlation time of {:.3g} s"),
            ("time_constant", "with a time constant of {:.3g} s"),
            ("ratio", "of {:.6g}" if finding.effect == "sample_rate_error" else "by a factor of {:.3g}"),
            ("factor", "of {:.4g}"),
        )
        if name in numbers
        for text in [text.format(numbers[name])]
    ]
    if source is not None:
        details.append(f"from {source.value}")
    if finding.old_frequency is not None:
        start, name = ("moved", "frequency") if "frequency" in numbers else ("with a cutoff that moved", "cutoff")
        details[0] = f"{start} from {finding.old_frequency:.4g} to {numbers[name]:.4g} Hz"
    has_new_shape = finding.old_frequency is not None
    if finding.kind == "retuned" and not has_new_shape and {"bandwidth", "order"} & numbers.keys():
        shape = "with a bandwidth of {bandwidth:.3g} Hz" if "bandwidth" in numbers else "of order {order:.0f}"
        details.append(shape.format(**numbers))
        has_new_shape = True
    if finding.kind == "retuned" and not (has_new_shape and _is_nearly_one(finding.size_ratio)):
        change = _describe_size_ratio(finding.size_ratio)
        details.append(f"and {change}" if has_new_shape else change)
    elif finding.kind == "absent":
        phrase = f"no {phrase}"
    return " ".join([phrase, *details]) + _on_axes(finding.axes)


def _describe_size_ratio(ratio: float | None) -> str:
    if not ratio:
        return "of another size"
    if ratio > 0.0:
        return f"changed by a factor of {ratio:.3g}"
    size = "" if _is_nearly_one(-ratio) else f" and {-ratio:.3g} times the size"
    return f"with the opposite sign{size}"


def _is_nearly_one(ratio: float | None) -> bool:
    return ratio is None or abs(ratio - 1.0) < UNMENTIONED_SIZE_CHANGE


def _describe_remaining_gaps(ranking: GapRanking) -> str:
    if not ranking.remainders:
        return ""
    left = 1.0 - ranking.explained_share
    large = [one for one in ranking.remainders if one.share >= MIN_REMAINDER_SHARE][:MAX_LISTED_REMAINDERS]
    if not large:
        axes = _on_axes({one.axis for one in ranking.remainders})
        return f"The remaining difference{axes} is significant, but only {format_share(left)} of the whole."
    texts = [f"{describe_remaining_gap(one)} ({format_share(one.share)})" for one in large]
    share = "" if not ranking.findings else f" ({format_share(left)} of the whole)"
    others = ", mainly" if len(ranking.remainders) > len(large) else ":"
    return f"No effect explains the rest{share}{others} {join_words(texts)}."


def describe_remaining_gap(one: RankedRemainingGap) -> str:
    """Return a remaining difference as a phrase with its location and its axis."""
    return f"{GROUP_PHRASES[one.gap.group]}{_describe_location(one.gap.strongest.where)} on {one.axis}"


def _describe_location(where: Location) -> str:
    if where.source is not None:
        return f" such as {where.source}"
    for ends, unit in ((where.frequency, "Hz"), (where.time, "s")):
        if ends is not None:
            lo, hi = (f"{end:.4g}" for end in ends)
            return f" at {lo} {unit}" if lo == hi else f" from {lo} to {hi} {unit}"
    return ""


def _recommend(r: Reconciliation, ranking: GapRanking) -> str:
    """Return what the user should do next, or an empty string if the model agrees with a recording without faults."""
    kinds = {finding.kind for finding in r.recording_findings}
    for faults, advice in FAULT_ADVICE:
        if kinds & faults:
            return advice
    vibration = sum(one.share for one in ranking.findings if one.effect in OSCILLATIONS and len(one.axes) > 1)
    groups = {name: sum(one.share for one in ranking.remainders if one.gap.group == name) for name in GROUP_PHRASES}
    if vibration + groups["other_axes"] > ADVISED_SHARE:
        return "Mount the sensor elsewhere or on a damped support: most of the difference is typical of vibration."
    if groups["distribution"] > ADVISED_SHARE:
        return "Record again without disturbances: most of the difference comes from single large samples or bursts."
    if ranking.findings:
        return "Continue with model.toml, which contains the findings, if the findings belong to the sensor."
    return "" if r.verdict == "agrees" else "Examine the remaining differences in the figures of the report."


def format_share(share: float) -> str:
    """Format a share of the gap as a percentage.

    >>> format_share(0.5432), format_share(0.00321), format_share(0.00003), format_share(0.9996), format_share(1.0)
    ('54 %', '0.3 %', '< 0.1 %', '> 99.9 %', '100 %')
    """
    percent = 100.0 * share
    if percent < 0.1:
        return "< 0.1 %"
    if 99.9 < percent < 100.0 - 1e-9:
        return "> 99.9 %"
    return f"{percent:.1f} %" if percent < 9.95 or 99.0 < percent < 100.0 - 1e-9 else f"{percent:.0f} %"


def _on_axes(axes: Sequence[str] | set[str]) -> str:
    names = [axis for axis in AXES if axis in axes]
    return f" on {join_words(names)}" if names else ""


def format_count(number: int, noun: str) -> str:
    """Return a number and a noun in the singular or plural.

    >>> format_count(1, "axis fault"), format_count(2, "finding")
    ('1 axis fault', '2 findings')
    """
    return f"{number} {noun}{'' if number == 1 else 's'}"


def join_words(texts: Sequence[str]) -> str:
    """Join texts with commas and "and".

    >>> join_words(["gx"]), join_words(["gx", "gy", "gz"])
    ('gx', 'gx, gy and gz')
    """
    return " and ".join([", ".join(texts[:-1]), texts[-1]]) if len(texts) > 1 else "".join(texts)
