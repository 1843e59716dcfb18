"""Tables of scored cases: how often the name was right, what was said instead, what intervals hold."""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import Final

import numpy as np
from scipy.special import ndtri

from tests.experiments.blind.score import Outcome

SURE: Final = 0.95
SIZES: Final = (0.0, 0.21, 0.3, 0.42, 0.6, 0.85, np.inf)  # edges of the columns of a power curve: 0.25, 0.35, 0.5, …
CONFIDENCES: Final = (0.0, 0.5, 0.8, 0.9, 0.99, np.inf)


def wilson(held: int, looks: int) -> tuple[float, float]:
    """Ends of the 95 % interval of a share (Wilson, J. Am. Stat. Assoc. 22 (1927) 209).

    >>> lo, hi = wilson(0, 300)
    >>> print(f"{lo:.4f} {hi:.4f}")
    0.0000 0.0126
    """
    z2 = float(ndtri(0.975)) ** 2
    centre = (held + 0.5 * z2) / (looks + z2)
    reach = np.sqrt(z2 * (held * (looks - held) / looks + 0.25 * z2)) / (looks + z2)
    return max(0.0, float(centre - reach)), min(1.0, float(centre + reach))


def share(held: int, looks: int) -> str:
    """``97.5 % (93.1–99.2) 117 of 120``."""
    if looks == 0:
        return "—"
    lo, hi = wilson(held, looks)
    return f"{100 * held / looks:.1f} % ({100 * lo:.1f}–{100 * hi:.1f}) {held} of {looks}"


def report(outcomes: Sequence[Outcome]) -> str:
    """Markdown of everything."""
    tables = (_summary, _power, _reliability, _by_case, _matrix, _coverage, _false_names)
    parts = [table(outcomes) for table in tables]
    return "\n\n".join(part for part in parts if part)


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """One table."""
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def kind(outcome: Outcome) -> str:
    """What sort of case it is."""
    if outcome.foreign:
        return "foreign"
    if outcome.case == "null":
        return "null"
    return "pair" if "+" in outcome.case else "single"


def _groups(outcomes: Iterable[Outcome], key: Callable[[Outcome], str]) -> dict[str, list[Outcome]]:
    groups: dict[str, list[Outcome]] = defaultdict(list)
    for outcome in outcomes:
        groups[key(outcome)].append(outcome)
    return dict(groups)


def _summary(outcomes: Sequence[Outcome]) -> str:
    def key(one: Outcome) -> str:
        level = "" if kind(one) in ("null", "foreign") else f" {one.level}"
        return f"{kind(one)}{level}, {one.baseline} baseline"

    rows = []
    for name, group in sorted(_groups(outcomes, key).items()):
        times = np.array([one.seconds for one in group])
        rows.append(
            (
                name,
                share(sum(one.right for one in group), len(group)),
                share(sum(bool(one.false) for one in group), len(group)),
                share(sum(one.closed for one in group), len(group)),
                share(sum(one.exit_status == 0 for one in group), len(group)),
                f"{np.median(times):.1f} / {times.max():.1f}",
            )
        )
    head = ("set", "right", "a false name", "nothing left over", "exit status 0", "seconds, median / most")
    table = markdown(head, rows)
    given = [name for one in outcomes for name in one.names]
    sure = [name for name in given if (name.confidence or 0.0) >= SURE]
    lines = [
        table,
        f"Names given with a confidence of {SURE} or more that are wrong, of all names: "
        f"{share(sum(not name.right for name in sure), len(given))}.",
        f"Truth within the 95 % interval: {share(*_held([c for one in outcomes for c in one.coverage]))}.",
    ]
    return "\n\n".join(lines)


def _power(outcomes: Sequence[Outcome]) -> str:
    """The share of right answers against the size of what is hidden.

    An effect is identifiable at its size if the oracle gains what a faint effect gains.
    """
    drawn = [one for one in outcomes if one.size != 1.0]
    if not drawn:
        return ""
    columns = [(lo, hi) for lo, hi in pairwise(SIZES) if any(lo <= one.size < hi for one in drawn)]

    def row(name: str, group: Sequence[Outcome], said: Callable[[int, int], str]) -> tuple[str, ...]:
        within = [[one.right for one in group if lo <= one.size < hi] for lo, hi in columns]
        return (name, *(said(sum(flags), len(flags)) for flags in within))

    kinds = sorted(_groups(drawn, kind).items())
    rows = [row(f"all {name}s", group, share) for name, group in kinds]
    rows += [
        row(f"identifiable {name}s", [one for one in group if one.is_identifiable], share) for name, group in kinds
    ]
    rows += [
        row(name, group, lambda held, looks: f"{held} of {looks}")
        for name, group in sorted(_groups(drawn, lambda one: one.case).items())
    ]
    head = ("hidden", *(f"{lo:g}–{hi:g}" for lo, hi in columns))
    return "Right answers against the multiple of the level's size:\n\n" + markdown(head, rows)


def _reliability(outcomes: Sequence[Outcome]) -> str:
    """Whether names are right as often as their confidence says."""
    given = [name for one in outcomes for name in one.names]
    rows = []
    for lo, hi in pairwise(CONFIDENCES):
        group = [name for name in given if lo <= (name.confidence or 0.0) < hi]
        mean = f"{np.mean([name.confidence for name in group]):.3f}" if group else "—"
        held = share(sum(name.right for name in group), len(group))
        rows.append((f"{lo:g}–{min(hi, 1.0):g}", mean, held))
    return "Names against their confidence:\n\n" + markdown(("confidence", "mean", "right"), rows) if given else ""


def _by_case(outcomes: Sequence[Outcome]) -> str:
    """Each case by itself, worst first."""
    rows = []
    for name, group in _groups(outcomes, lambda one: f"{one.case} {one.level} {one.baseline}").items():
        right = sum(one.right for one in group)
        said = Counter(_said(one) for one in group if not one.right)
        verdicts = Counter(one.verdict or f"exit {one.exit_status}" for one in group)
        rows.append((right / len(group), name, group, right, verdicts, said))
    rows.sort(key=lambda row: row[:2])
    return markdown(
        ("case", "right", "verdicts", "said instead"),
        [
            (name, share(right, len(group)), _counted(verdicts), _counted(said))
            for _, name, group, right, verdicts, said in rows
        ],
    )


def _said(one: Outcome) -> str:
    false = sorted(f"{name.effect}" for name in one.false)
    missed = sorted(f"no {name.effect}" for name in one.missed)
    return ", ".join([*missed, *false]) or one.verdict or f"exit {one.exit_status}"


def _counted(counter: Counter[str]) -> str:
    return "; ".join(f"{count} × {name}" for name, count in counter.most_common())


def _matrix(outcomes: Sequence[Outcome]) -> str:
    """Hidden effect against what was said, levels and pairs together."""
    cells = Counter(pair for one in outcomes for pair in one.confused)
    if not cells:
        return ""
    hidden = sorted({truth for truth, _ in cells})
    said = sorted({name for _, name in cells}, key=lambda name: (name.startswith("("), name))
    rows = []
    for truth in hidden:
        others = [f"{cells[truth, name]} {name}" for name in said if name != truth and cells[truth, name]]
        rows.append((truth, str(cells[truth, truth]), "; ".join(others)))
    return "Confusion matrix, rows without their zeros:\n\n" + markdown(("hidden", "named so", "named otherwise"), rows)


def _held(coverage: Iterable[tuple[str, str, bool]]) -> tuple[int, int]:
    flags = [held for _, _, held in coverage]
    return sum(flags), len(flags)


def _coverage(outcomes: Sequence[Outcome]) -> str:
    found: dict[tuple[str, str], list[bool]] = defaultdict(list)
    for one in outcomes:
        for effect, parameter, held in one.coverage:
            found[effect, parameter].append(held)
    if not found:
        return ""
    rows = [(*key, share(sum(flags), len(flags))) for key, flags in sorted(found.items())]
    return "Truth within the 95 % interval:\n\n" + markdown(("effect", "parameter", "holds"), rows)


def _false_names(outcomes: Sequence[Outcome]) -> str:
    """Each by itself: to be looked at."""
    rows = [
        (f"{one.case} {one.level} {one.baseline}", str(one.seed), f"{name.axis} {name.effect}", f"{name.confidence}")
        for one in outcomes
        for name in one.false
    ]
    return "False names:\n\n" + markdown(("case", "seed", "name", "confidence"), rows) if rows else ""
