"""Tables of scored cases: shares of right names, confusions, false names and coverage of intervals."""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import Final

import numpy as np
from scipy.special import ndtri

from tests.experiments.blind.score import Outcome

HIGH_CONFIDENCE: Final = 0.95
SIZE_EDGES: Final = (0.0, 0.21, 0.3, 0.42, 0.6, 0.85, np.inf)  # edges of the columns of a power curve
CONFIDENCE_EDGES: Final = (0.0, 0.5, 0.8, 0.9, 0.99, np.inf)


def wilson_interval(count: int, total: int) -> tuple[float, float]:
    """Return the 95 % interval of a share (Wilson, J. Am. Stat. Assoc. 22 (1927) 209).

    >>> lo, hi = wilson_interval(0, 300)
    >>> print(f"{lo:.4f} {hi:.4f}")
    0.0000 0.0126
    """
    z2 = float(ndtri(0.975)) ** 2
    centre = (count + 0.5 * z2) / (total + z2)
    reach = np.sqrt(z2 * (count * (total - count) / total + 0.25 * z2)) / (total + z2)
    return max(0.0, float(centre - reach)), min(1.0, float(centre + reach))


def format_share(count: int, total: int) -> str:
    """Return a share with its interval, such as ``97.5 % (93.1–99.2) 117 of 120``."""
    if total == 0:
        return "—"
    lo, hi = wilson_interval(count, total)
    return f"{100 * count / total:.1f} % ({100 * lo:.1f}–{100 * hi:.1f}) {count} of {total}"


def format_report(outcomes: Sequence[Outcome]) -> str:
    """Return all tables in Markdown."""
    tables = (_summary, _power, _reliability, _by_case, _confusions, _coverage, _false_names)
    parts = [table(outcomes) for table in tables]
    return "\n\n".join(part for part in parts if part)


def format_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def get_case_kind(outcome: Outcome) -> str:
    """Return "foreign", "null", "pair" or "single"."""
    if outcome.foreign:
        return "foreign"
    if outcome.case == "null":
        return "null"
    return "pair" if "+" in outcome.case else "single"


def _group_outcomes(outcomes: Iterable[Outcome], key: Callable[[Outcome], str]) -> dict[str, list[Outcome]]:
    groups: dict[str, list[Outcome]] = defaultdict(list)
    for outcome in outcomes:
        groups[key(outcome)].append(outcome)
    return dict(groups)


def _summary(outcomes: Sequence[Outcome]) -> str:
    def key(outcome: Outcome) -> str:
        level = "" if get_case_kind(outcome) in ("null", "foreign") else f" {outcome.level}"
        return f"{get_case_kind(outcome)}{level}, {outcome.baseline} baseline"

    rows = []
    for name, group in sorted(_group_outcomes(outcomes, key).items()):
        times = np.array([outcome.seconds for outcome in group])
        rows.append(
            (
                name,
                format_share(sum(outcome.right for outcome in group), len(group)),
                format_share(sum(bool(outcome.false) for outcome in group), len(group)),
                format_share(sum(outcome.closed for outcome in group), len(group)),
                format_share(sum(outcome.exit_status == 0 for outcome in group), len(group)),
                f"{np.median(times):.1f} / {times.max():.1f}",
            )
        )
    head = ("set", "right", "a false name", "nothing unexplained", "exit status 0", "seconds, median / maximum")
    table = format_table(head, rows)
    given = [name for outcome in outcomes for name in outcome.names]
    confident = [name for name in given if (name.confidence or 0.0) >= HIGH_CONFIDENCE]
    covered, intervals = _count_covered([item for outcome in outcomes for item in outcome.coverage])
    lines = [
        table,
        f"Names given with a confidence of {HIGH_CONFIDENCE} or more that are wrong, of all names: "
        f"{format_share(sum(not name.right for name in confident), len(given))}.",
        f"Truth within the 95 % interval: {format_share(covered, intervals)}.",
    ]
    return "\n\n".join(lines)


def _power(outcomes: Sequence[Outcome]) -> str:
    """Return the share of right answers against the size of the hidden effects.

    An effect is identifiable if the gains of the oracle are at least those of a faint effect.
    """
    drawn = [outcome for outcome in outcomes if outcome.size != 1.0]
    if not drawn:
        return ""
    columns = [(lo, hi) for lo, hi in pairwise(SIZE_EDGES) if any(lo <= outcome.size < hi for outcome in drawn)]

    def row(name: str, group: Sequence[Outcome], format_cell: Callable[[int, int], str]) -> tuple[str, ...]:
        within = [[outcome.right for outcome in group if lo <= outcome.size < hi] for lo, hi in columns]
        return (name, *(format_cell(sum(flags), len(flags)) for flags in within))

    kinds = sorted(_group_outcomes(drawn, get_case_kind).items())
    rows = [row(f"all {name}s", group, format_share) for name, group in kinds]
    rows += [
        row(f"identifiable {name}s", [outcome for outcome in group if outcome.is_identifiable], format_share)
        for name, group in kinds
    ]
    rows += [
        row(name, group, lambda count, total: f"{count} of {total}")
        for name, group in sorted(_group_outcomes(drawn, lambda outcome: outcome.case).items())
    ]
    head = ("hidden", *(f"{lo:g}–{hi:g}" for lo, hi in columns))
    return "Right answers against the multiple of the level's size:\n\n" + format_table(head, rows)


def _reliability(outcomes: Sequence[Outcome]) -> str:
    """Return the share of right names against their confidence."""
    given = [name for outcome in outcomes for name in outcome.names]
    rows = []
    for lo, hi in pairwise(CONFIDENCE_EDGES):
        group = [name for name in given if lo <= (name.confidence or 0.0) < hi]
        mean = f"{np.mean([name.confidence for name in group]):.3f}" if group else "—"
        count = format_share(sum(name.right for name in group), len(group))
        rows.append((f"{lo:g}–{min(hi, 1.0):g}", mean, count))
    return "Names against their confidence:\n\n" + format_table(("confidence", "mean", "right"), rows) if given else ""


def _by_case(outcomes: Sequence[Outcome]) -> str:
    """Return a row for each case, the worst case first."""
    rows = []
    for name, group in _group_outcomes(
        outcomes, lambda outcome: f"{outcome.case} {outcome.level} {outcome.baseline}"
    ).items():
        right = sum(outcome.right for outcome in group)
        wrong = Counter(_describe_wrong_answer(outcome) for outcome in group if not outcome.right)
        verdicts = Counter(outcome.verdict or f"exit {outcome.exit_status}" for outcome in group)
        rows.append((right / len(group), name, group, right, verdicts, wrong))
    rows.sort(key=lambda row: row[:2])
    return format_table(
        ("case", "right", "verdicts", "wrong answers"),
        [
            (name, format_share(right, len(group)), _format_counts(verdicts), _format_counts(wrong))
            for _, name, group, right, verdicts, wrong in rows
        ],
    )


def _describe_wrong_answer(outcome: Outcome) -> str:
    false = sorted(f"{name.effect}" for name in outcome.false)
    missed = sorted(f"no {name.effect}" for name in outcome.missed)
    return ", ".join([*missed, *false]) or outcome.verdict or f"exit {outcome.exit_status}"


def _format_counts(counter: Counter[str]) -> str:
    return "; ".join(f"{count} × {name}" for name, count in counter.most_common())


def _confusions(outcomes: Sequence[Outcome]) -> str:
    """Return the names that hidden effects were given, for all levels together."""
    cells = Counter(pair for outcome in outcomes for pair in outcome.confused)
    if not cells:
        return ""
    hidden = sorted({truth for truth, _ in cells})
    answers = sorted({name for _, name in cells}, key=lambda name: (name.startswith("("), name))
    rows = []
    for truth in hidden:
        others = [f"{cells[truth, name]} {name}" for name in answers if name != truth and cells[truth, name]]
        rows.append((truth, str(cells[truth, truth]), "; ".join(others)))
    return "Confusion matrix without zeros:\n\n" + format_table(("hidden", "right name", "other answers"), rows)


def _count_covered(coverage: Iterable[tuple[str, str, bool]]) -> tuple[int, int]:
    flags = [count for _, _, count in coverage]
    return sum(flags), len(flags)


def _coverage(outcomes: Sequence[Outcome]) -> str:
    found: dict[tuple[str, str], list[bool]] = defaultdict(list)
    for outcome in outcomes:
        for effect, parameter, count in outcome.coverage:
            found[effect, parameter].append(count)
    if not found:
        return ""
    rows = [(*key, format_share(sum(flags), len(flags))) for key, flags in sorted(found.items())]
    return "Truth within the 95 % interval:\n\n" + format_table(("effect", "parameter", "coverage"), rows)


def _false_names(outcomes: Sequence[Outcome]) -> str:
    """Return a row for each false name."""
    rows = [
        (
            f"{outcome.case} {outcome.level} {outcome.baseline}",
            str(outcome.seed),
            f"{name.axis} {name.effect}",
            f"{name.confidence}",
        )
        for outcome in outcomes
        for name in outcome.false
    ]
    return "False names:\n\n" + format_table(("case", "seed", "name", "confidence"), rows) if rows else ""
