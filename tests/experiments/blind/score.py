"""A report beside the truth: which names are right, which are missing, which are wrong, and what was said of them.

A name is right when an ``added`` step gives the very effect on the very axis, with the very source where it leaks
in; there are no near misses, not even for names of equal spectrum. Two exceptions: a clock error is one fact about
the recording, so any axis may tell it and several may; and ``foreign.HONEST`` lists names that are right for effects
outside the vocabulary. A retuned term is no name. Everything else that is added is a false name, and so is a name
given twice where it was hidden once.

An *honest* answer to a foreign effect is ``unexplained`` or ``partly_explained`` (or all names are in ``HONEST``);
*unnamed* says that besides no false name was given.
"""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Final

import numpy as np

from tests.experiments.blind import foreign

Json = Mapping[str, Any]

NOT_JUDGED: Final = ("reference", "order", "source")  # the mean is free; whole numbers and names have no interval
ANYWHERE: Final = ("sample_rate_error",)
FAINT: Final = (15.0, 5.0)  # gains of the oracle: see the package
OPEN: Final = ("unexplained", "partly_explained")


@dataclass(frozen=True)
class Name:
    """One name that was given, or should have been."""

    axis: str
    effect: str
    confidence: float | None = None
    right: bool = False


@dataclass(frozen=True)
class Outcome:
    """One case, scored."""

    case: str
    level: str
    seed: int
    baseline: str
    exit_status: int
    verdict: str  # empty without a report
    names: tuple[Name, ...]  # that were given
    missed: tuple[Name, ...]
    confused: tuple[tuple[str, str], ...]  # hidden effect -> what was said of its axis
    coverage: tuple[tuple[str, str, bool], ...]  # effect, parameter, whether its interval holds the truth
    retuned: int
    closed: bool  # nothing was left over
    seconds: float
    foreign: tuple[str, ...] = field(default=())
    gain: float | None = None  # the smallest of the oracle's
    size: float = 1.0  # multiple of the level's size
    margin: float | None = None  # the smallest of the oracle's, over the best wrong name

    @property
    def false(self) -> tuple[Name, ...]:
        """Names that are wrong."""
        return tuple(name for name in self.names if not name.right)

    @property
    def right(self) -> bool:
        """All that was hidden was named, and nothing else; of what is foreign, that an honest answer was given."""
        if self.foreign:
            return self.honest
        return bool(self.verdict) and not self.missed and not self.false

    @property
    def is_identifiable(self) -> bool:
        """Whether the oracle gains what a faint effect gains, over the baseline and over the best wrong name."""
        return (self.gain is None or self.gain >= FAINT[0]) and (self.margin is None or self.margin >= FAINT[1])

    @property
    def honest(self) -> bool:
        """That something is there which no name explains was said, or its parts were named."""
        return self.verdict in OPEN or (bool(self.names) and not self.false)

    def json(self) -> dict[str, Any]:
        """A line of a result file."""
        return asdict(self)

    @classmethod
    def from_json(cls, line: Json) -> "Outcome":
        """Of such a line."""
        values = dict(line)
        for key in ("names", "missed"):
            values[key] = tuple(Name(**one) for one in values[key])
        for key in ("confused", "coverage"):
            values[key] = tuple(tuple(one) for one in values[key])
        values["foreign"] = tuple(values["foreign"])
        return cls(**values)


def score(truth: Json, report: Json | None, exit_status: int, seconds: float) -> Outcome:
    """Compare.

    Args:
        truth: of ``cases.Case``
        report: the parsed ``report.json``; None where none was written
        exit_status, seconds: of the program's run
    """
    added = [] if report is None else list(_steps(report, "added"))
    open_truths = list(truth["hidden"])
    names, coverage = [], []
    told_anywhere: set[str] = set()
    for axis, step in added:
        match = next((one for one in open_truths if _is(one, axis, step)), None)
        again = step["effect"] in told_anywhere
        welcome = any(
            one["axis"] == axis and step["effect"] in foreign.HONEST.get(one["name"], ()) for one in truth["foreign"]
        )
        names.append(Name(axis, step["effect"], step["confidence"], match is not None or again or welcome))
        if match is not None:
            open_truths.remove(match)
            coverage += _coverage(match, step)
            if step["effect"] in ANYWHERE:
                told_anywhere.add(step["effect"])
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
        missed=tuple(Name(one["axis"], one["effect"]) for one in open_truths),
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


def _is(hidden: Json, axis: str, step: Json) -> bool:
    if hidden["effect"] != step["effect"]:
        return False
    if hidden["effect"] in ANYWHERE:
        return True
    source = step["parameters"].get("source", {}).get("value")
    return bool(hidden["axis"] == axis and hidden["parameters"].get("source") == source)


def _confusions(truth: Json, names: list[Name], report: Json | None) -> Iterable[tuple[str, str]]:
    """For each hidden effect: its own name, else a false name on its axis, else the verdict about the axis."""
    free = [name for name in names if not name.right]
    told = [(name.axis, name.effect) for name in names if name.right]
    for one in truth["hidden"]:
        effect, axis = one["effect"], one["axis"]
        if (axis, effect) in told or (effect in ANYWHERE and effect in [name for _, name in told]):
            yield effect, effect
            continue
        wrong = next((name for name in free if name.axis == axis or effect in ANYWHERE), None)
        if wrong is not None:
            free.remove(wrong)
            yield effect, wrong.effect
        elif report is None:
            yield effect, "(no report)"
        else:
            retuned = any(where == axis for where, _ in _steps(report, "retuned"))
            verdict = report["axes"].get(axis, {}).get("verdict", "absent")
            yield effect, "(retuned)" if retuned and verdict == "explained" else f"({verdict})"


def _coverage(hidden: Json, step: Json) -> list[tuple[str, str, bool]]:
    """Of every parameter that has an interval."""
    found = []
    for name, truth in hidden["parameters"].items():
        bounds = step["parameters"].get(name)
        if name in NOT_JUDGED or bounds is None or bounds.get("lo") is None or bounds.get("hi") is None:
            continue
        lo, hi = float(bounds["lo"]), float(bounds["hi"])
        if name == "phase":  # a full turn changes nothing
            truth += 2.0 * np.pi * np.round((0.5 * (lo + hi) - truth) / (2.0 * np.pi))
        slack = 1e-9 * abs(truth)  # an exact answer: a step of a grid
        found.append((hidden["effect"], name, bool(lo - slack <= truth <= hi + slack)))
    return found
