"""Comparison of a report with the truth: right names, missing names, false names and intervals.

A name is right if an ``added`` step has the hidden effect, on the same axis, and with the same source if it leaks from
another axis. There are no near misses, not even for names with equal spectra. There are two exceptions. A clock error
concerns the whole recording, so any axis and several axes may name it. ``foreign.HONEST`` lists names that are right
for foreign effects, which have no name of their own. A term with a changed size is no name. All other added effects are
false names. A name that is given twice and hidden once is false once.

An *honest* answer to a foreign effect has the verdict ``unexplained`` or ``partly_explained``, or all its names are in
``foreign.HONEST``.
"""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Final

import numpy as np

from tests.experiments.blind import foreign

Json = Mapping[str, Any]

PARAMETERS_WITHOUT_INTERVAL: Final = ("reference", "order", "source")
"""The reference is arbitrary, and integers and names have no interval."""
RECORDING_WIDE_EFFECTS: Final = ("sample_rate_error",)
MIN_IDENTIFIABLE_GAINS: Final = (15.0, 5.0)
"""Gains of the oracle over the baseline and over the best wrong name, as for faint effects."""
OPEN_VERDICTS: Final = ("unexplained", "partly_explained")


@dataclass(frozen=True)
class NamedEffect:
    """Effect that the report names or misses."""

    axis: str
    effect: str
    confidence: float | None = None
    right: bool = False


@dataclass(frozen=True)
class Outcome:
    """Score of one case."""

    case: str
    level: str
    seed: int
    baseline: str
    exit_status: int
    verdict: str  # empty without a report
    names: tuple[NamedEffect, ...]  # names in the report
    missed: tuple[NamedEffect, ...]
    confused: tuple[tuple[str, str], ...]  # hidden effect, and the name or verdict of its axis in the report
    coverage: tuple[tuple[str, str, bool], ...]  # effect, parameter, True if the interval contains the truth
    retuned: int
    closed: bool  # True if nothing is left unexplained
    seconds: float
    foreign: tuple[str, ...] = field(default=())
    gain: float | None = None  # smallest gain of the oracle over the baseline
    size: float = 1.0  # factor on the size of the level
    margin: float | None = None  # smallest gain of the oracle over the best wrong name

    @property
    def false(self) -> tuple[NamedEffect, ...]:
        """Names that are wrong."""
        return tuple(name for name in self.names if not name.right)

    @property
    def right(self) -> bool:
        """True if exactly the hidden effects are named, or the answer to a foreign effect is honest."""
        if self.foreign:
            return self.honest
        return bool(self.verdict) and not self.missed and not self.false

    @property
    def is_identifiable(self) -> bool:
        """True if the gains of the oracle are at least those of a faint effect."""
        return (self.gain is None or self.gain >= MIN_IDENTIFIABLE_GAINS[0]) and (
            self.margin is None or self.margin >= MIN_IDENTIFIABLE_GAINS[1]
        )

    @property
    def honest(self) -> bool:
        """True if the report states an unexplained part, or all its names are right."""
        return self.verdict in OPEN_VERDICTS or (bool(self.names) and not self.false)

    def json(self) -> dict[str, Any]:
        """Return the score as a line of a result file."""
        return asdict(self)

    @classmethod
    def from_json(cls, line: Json) -> "Outcome":
        """Return the score of a line of a result file."""
        values = dict(line)
        for key in ("names", "missed"):
            values[key] = tuple(NamedEffect(**one) for one in values[key])
        for key in ("confused", "coverage"):
            values[key] = tuple(tuple(one) for one in values[key])
        values["foreign"] = tuple(values["foreign"])
        return cls(**values)


def score(truth: Json, report: Json | None, exit_status: int, seconds: float) -> Outcome:
    """Compare a report with the truth.

    Parameters
    ----------
    truth
        Truth of a ``cases.Case``.
    report
        Content of ``report.json``, or None if the program wrote none.
    exit_status, seconds
        Exit status and duration of the program.
    """
    added = [] if report is None else list(_steps(report, "added"))
    open_truths = list(truth["hidden"])
    names, coverage = [], []
    named_effects: set[str] = set()
    for axis, step in added:
        match = next((one for one in open_truths if _is_match(one, axis, step)), None)
        is_repeated = step["effect"] in named_effects
        is_allowed = any(
            one["axis"] == axis and step["effect"] in foreign.HONEST.get(one["name"], ()) for one in truth["foreign"]
        )
        names.append(
            NamedEffect(axis, step["effect"], step["confidence"], match is not None or is_repeated or is_allowed)
        )
        if match is not None:
            open_truths.remove(match)
            coverage += _coverage(match, step)
            if step["effect"] in RECORDING_WIDE_EFFECTS:
                named_effects.add(step["effect"])
    gains = [one["gain"] for one in truth["hidden"] if np.isfinite(one["gain"])]
    margins = [one["margin"] for one in truth["hidden"] if np.isfinite(one["margin"])]
    return Outcome(
        case=truth["case"],
        level=truth["level"],
        seed=truth["seed"],
        baseline=truth["baseline"],
        exit_status=exit_status,
        verdict="" if report is None else report["verdict"],
        names=tuple(names),
        missed=tuple(NamedEffect(one["axis"], one["effect"]) for one in open_truths),
        confused=tuple(_confusions(truth, names, report)),
        coverage=tuple(coverage),
        retuned=0 if report is None else sum(1 for _ in _steps(report, "retuned")),
        closed=report is not None and not any(axis["left_over"] for axis in report["axes"].values()),
        seconds=seconds,
        foreign=tuple(one["name"] for one in truth["foreign"]),
        gain=min(gains, default=None),
        size=truth.get("size", 1.0),
        margin=min(margins, default=None),
    )


def _steps(report: Json, kind: str) -> Iterable[tuple[str, Json]]:
    for axis, result in report["axes"].items():
        for step in result["steps"]:
            if step["kind"] == kind:
                yield axis, step


def _is_match(hidden: Json, axis: str, step: Json) -> bool:
    if hidden["effect"] != step["effect"]:
        return False
    if hidden["effect"] in RECORDING_WIDE_EFFECTS:
        return True
    source = step["parameters"].get("source", {}).get("value")
    return bool(hidden["axis"] == axis and hidden["parameters"].get("source") == source)


def _confusions(truth: Json, names: list[NamedEffect], report: Json | None) -> Iterable[tuple[str, str]]:
    """Yield each hidden effect with its name, a false name on its axis, or the verdict of the axis."""
    false_names = [name for name in names if not name.right]
    right_names = [(name.axis, name.effect) for name in names if name.right]
    for one in truth["hidden"]:
        effect, axis = one["effect"], one["axis"]
        if (axis, effect) in right_names or (
            effect in RECORDING_WIDE_EFFECTS and effect in [name for _, name in right_names]
        ):
            yield effect, effect
            continue
        wrong = next((name for name in false_names if name.axis == axis or effect in RECORDING_WIDE_EFFECTS), None)
        if wrong is not None:
            false_names.remove(wrong)
            yield effect, wrong.effect
        elif report is None:
            yield effect, "(no report)"
        else:
            retuned = any(where == axis for where, _ in _steps(report, "retuned"))
            verdict = report["axes"].get(axis, {}).get("verdict", "absent")
            yield effect, "(retuned)" if retuned and verdict == "explained" else f"({verdict})"


def _coverage(hidden: Json, step: Json) -> list[tuple[str, str, bool]]:
    """Return for every parameter with an interval whether the interval contains the truth."""
    found = []
    for name, truth in hidden["parameters"].items():
        bounds = step["parameters"].get(name)
        if (
            name in PARAMETERS_WITHOUT_INTERVAL
            or bounds is None
            or bounds.get("lo") is None
            or bounds.get("hi") is None
        ):
            continue
        lo, hi = float(bounds["lo"]), float(bounds["hi"])
        if name == "phase":  # a phase is periodic
            truth += 2.0 * np.pi * np.round((0.5 * (lo + hi) - truth) / (2.0 * np.pi))
        slack = 1e-9 * abs(truth)  # for exact results, such as the step of a grid
        found.append((hidden["effect"], name, bool(lo - slack <= truth <= hi + slack)))
    return found
