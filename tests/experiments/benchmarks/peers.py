"""``reconcile`` beside its nearest peers on the blind set: names right, false names, processor seconds an axis.

    python -m tests.experiments.benchmarks.peers --seeds 4 --level plain --out peers.jsonl
    python -m tests.experiments.benchmarks.peers --report peers.jsonl                          # prints again

Each peer gets what a user has, the recording and the baseline model, and gives names of effects that the model lacks.
They are scored as those of ``reconcile`` are (``tests.experiments.blind.score``), without their confidences and
intervals.

- *GMWM ranking*: all nested models of WN, QN, RW, DR and up to three AR1 are ranked for each axis by itself, and the
  terms of the best one that the baseline has not are names. As there is no flicker among them, AR1 have to stand for
  it: only those beyond the number that the same ranking takes for the baseline's own wavelet variance are a name.
- *GMWM beside the baseline*: as strong as it can be made here; the baseline's wavelet variance is a part of every
  model, and what is ranked is what to add to it. More of a term that the baseline has is no name, but retuned.
- *five-term fit*: coefficients and notes of ``analyze``, see ``fit_five_terms``.
- *reconcile*: in this process.

All run in one thread. Seconds are processor seconds of this process, of the whole answer, over the number of axes.
"""

import argparse
import json
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from drivers.data_types import AXES, Floats
from monitor.noise.model import NoiseModel
from monitor.reconcile.preparation.reconcile_input import Recording
from monitor.reconcile.reconcile import reconcile
from tests.experiments.benchmarks import five_terms, gmwm
from tests.experiments.blind import run
from tests.experiments.blind.cases import SINGLES, Case
from tests.experiments.blind.score import Outcome, score
from tests.experiments.blind.tables import format_share, format_table

NAMES: Final = {
    "WN": "angle_random_walk",
    "QN": "quantization_noise",
    "RW": "rate_random_walk",
    "DR": "rate_ramp",
    "AR1": "exponentially_correlated",
}


@dataclass(frozen=True, slots=True)
class Named:
    """One effect that a peer finds missing."""

    axis: str
    effect: str
    source: str | None = None
    confidence: float | None = None


Peer = Callable[[Mapping[str, Floats], float, NoiseModel, int], Iterable[Named]]
"""Columns of a recording, its rate in Hz, the baseline and a seed -> names."""


# --- the peers


def ranking(columns: Mapping[str, Floats], rate_hz: float, model: NoiseModel, seed: int) -> Iterable[Named]:
    """GMWM by itself."""
    for axis in _axes(columns):
        best = gmwm.rank(gmwm.moments(columns[axis]))[0]
        own = gmwm.with_intervals(law_of(axis, columns[axis].size, rate_hz, model).variance, columns[axis].size)
        of_baseline = len(gmwm.rank(own)[0].times)
        yield from _added(axis, best, model, of_baseline)


def beside(columns: Mapping[str, Floats], rate_hz: float, model: NoiseModel, seed: int) -> Iterable[Named]:
    """GMWM of what the baseline leaves."""
    for axis in _axes(columns):
        law = law_of(axis, columns[axis].size, rate_hz, model)
        yield from _added(axis, gmwm.rank(gmwm.moments(columns[axis]), law)[0], model, 0)


def five(columns: Mapping[str, Floats], rate_hz: float, model: NoiseModel, seed: int) -> Iterable[Named]:
    """The five-term fit alone."""
    shown = {axis: columns[axis] for axis in _axes(columns)}
    for axis, effect in sorted(five_terms.names(shown, rate_hz, model)):
        yield Named(axis, effect)


def this(columns: Mapping[str, Floats], rate_hz: float, model: NoiseModel, seed: int) -> Iterable[Named]:
    """``reconcile``."""
    shown = {axis: columns[axis] for axis in _axes(columns)}
    found = reconcile(Recording(shown, rate_hz, columns.get("temperature")), model, seed)
    for axis, result in found.axes.items():
        for step in result.steps:
            if step.kind == "added":
                source = step.parameters.get("source")
                yield Named(axis, step.effect, None if source is None else str(source.value), step.confidence)


PEERS: Final[Mapping[str, Peer]] = {
    "GMWM ranking": ranking,
    "GMWM beside the baseline": beside,
    "five-term fit": five,
    "reconcile": this,
}
WORDS: Final[Mapping[str, frozenset[str]]] = {
    "GMWM ranking": frozenset(NAMES.values()),
    "GMWM beside the baseline": frozenset(NAMES.values()),
    "five-term fit": five_terms.SAID,
    "reconcile": frozenset(SINGLES),
}
"""What each can name at all."""


def _axes(columns: Mapping[str, Floats]) -> list[str]:
    return [axis for axis in AXES if axis in columns]


def law_of(axis: str, n: int, rate_hz: float, model: NoiseModel) -> gmwm.Known:
    """The baseline of an axis as GMWM sees it: Allan variance at τ/2 is twice the wavelet variance at τ."""
    variance = 0.5 * model.avar(axis, 0.5 * gmwm.dyadic(n) / rate_hz, 1.0 / rate_hz)
    f_hz = (rate_hz / n) * np.arange(1, n // 2 + 1, dtype=np.float64)
    return gmwm.Known(variance, rate_hz * model.two_sided_psd(axis, f_hz, 1.0 / rate_hz))


def _added(axis: str, best: gmwm.Ranked, model: NoiseModel, expected: int) -> Iterable[Named]:
    """Names of the terms that the baseline has not; ``expected``: AR1 that are none."""
    has = {effect.name for effect in model.effects.get(axis, ())}
    for term in best.terms:
        if NAMES[term] not in has:
            yield Named(axis, NAMES[term])
    if len(best.times) > expected and NAMES["AR1"] not in has:
        yield Named(axis, NAMES["AR1"])


# --- run and score


def judged(case: Case, peer: str, seed: int) -> Outcome:
    """A peer on a case; the seconds are of the processor, for all axes."""
    model = NoiseModel.from_toml(case.model)
    begin = time.process_time()
    names = list(PEERS[peer](case.columns, case.rate_hz, model, seed))
    return score(case.truth, as_report(names), 0, time.process_time() - begin)


def as_report(names: Sequence[Named]) -> dict[str, Any]:
    """What the scorer reads of a ``report.json``."""
    axes: dict[str, Any] = {axis: {"verdict": "agrees", "steps": [], "left_over": []} for axis in AXES}
    for one in names:
        parameters = {} if one.source is None else {"source": {"value": one.source}}
        step = {"kind": "added", "effect": one.effect, "parameters": parameters, "confidence": one.confidence}
        axes[one.axis]["steps"].append(step)
        axes[one.axis]["verdict"] = "explained"
    return {"verdict": "explained" if names else "agrees", "axes": axes}


def run_all(todo: Sequence[run.Job], peers: Sequence[str], file: Path) -> None:
    """Append what ``file`` lacks, a line for each case and peer."""
    done = {(line["key"], line["peer"]) for line in run.read_lines(file)}
    with file.open("a") as results:
        for job in todo:
            left = [peer for peer in peers if (job.key, peer) not in done]
            if not left:
                continue
            case = job.case()
            for peer in left:
                outcome = judged(case, peer, job.seed)
                results.write(json.dumps({"key": job.key, "peer": peer, **outcome.json()}) + "\n")
                results.flush()
                said = ", ".join(f"{one.axis} {one.effect}" for one in outcome.names) or "no name"
                mark = "right" if outcome.right else "WRONG"
                print(f"{mark} {job.key}: {peer}: {said}; {outcome.seconds:.2f} s", file=sys.stderr, flush=True)


def warm(peers: Sequence[str]) -> None:
    """A short recording through each, so that compiled kernels are there before anything is timed."""
    case = run.Job("null", "plain", 0, 120.0).case()
    for peer in peers:
        judged(case, peer, 0)


def outcomes(file: Path) -> dict[str, list[Outcome]]:
    """Peer -> its scored cases."""
    found: dict[str, list[Outcome]] = defaultdict(list)
    for line in run.read_lines(file):
        found[line["peer"]].append(Outcome.from_json({k: v for k, v in line.items() if k not in ("key", "peer")}))
    return {peer: found[peer] for peer in PEERS if peer in found}


# --- tables


def report(found: Mapping[str, Sequence[Outcome]]) -> str:
    """Markdown of both tables."""
    return "\n\n".join([summary(found), by_effect(found)])


def summary(found: Mapping[str, Sequence[Outcome]]) -> str:
    """A row a peer; intervals are of Wilson, 95 %."""
    rows = []
    for peer, of_peer in found.items():
        singles = [one for one in of_peer if one.case != "null"]
        sayable = [one for one in singles if one.case in WORDS[peer]]
        nulls = [one for one in of_peer if one.case == "null"]
        seconds = np.array([one.seconds for one in of_peer]) / len(AXES)
        rows.append(
            (
                peer,
                format_share(sum(_named(one) for one in singles), len(singles)),
                format_share(sum(_named(one) for one in sayable), len(sayable)),
                format_share(sum(bool(one.false) for one in singles), len(singles)),
                format_share(sum(bool(one.false) for one in nulls), len(nulls)),
                f"{np.mean([len(one.false) for one in of_peer]):.2f}",
                f"{np.median(seconds):.2f} / {seconds.max():.2f}",
            )
        )
    head = (
        "",
        "named",
        "named, of what it has a word for",
        "a false name beside an effect",
        "a false name on null data",
        "false names a recording",
        "processor seconds an axis, median / most",
    )
    return format_table(head, rows)


def by_effect(found: Mapping[str, Sequence[Outcome]]) -> str:
    """A row an effect: how often it was named, of how many; and false names beside it, all together."""
    cases = [name for name in (*SINGLES, "null") if any(one.case == name for every in found.values() for one in every)]
    rows = []
    for name in cases:
        cells = []
        for every in found.values():
            those = [one for one in every if one.case == name]
            false = sum(len(one.false) for one in those)
            right = "" if name == "null" else f"{sum(_named(one) for one in those)} of {len(those)}"
            cells.append(", ".join(part for part in (right, f"{false} false" if false else "") if part) or "none false")
        rows.append((f"`{name}`" if name != "null" else "null", *cells))
    return format_table(("hidden", *found), rows)


def _named(one: Outcome) -> bool:
    """Whether what was hidden was named, whatever else was."""
    return not one.missed


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, default=1, help="recordings of each effect, and null ones")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--level", choices=("plain", "faint"), default="plain")
    parser.add_argument("--seconds", type=float, default=3600.0, help="length of recordings")
    parser.add_argument("--only", nargs="+", metavar="EFFECT", choices=(*SINGLES, "null"), help="these and no others")
    parser.add_argument("--peers", nargs="+", choices=tuple(PEERS), default=tuple(PEERS))
    parser.add_argument("--out", type=Path, metavar="FILE.jsonl", help="results, continued where they end")
    parser.add_argument("--report", type=Path, metavar="FILE.jsonl", help="print results, run nothing")
    options = parser.parse_args()
    if options.report:
        print(report(outcomes(options.report)))
        return
    if options.out is None:
        parser.error("one of --out and --report is needed")
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    names = options.only or (*SINGLES, "null")
    warm(options.peers)
    run_all([run.Job(name, options.level, seed, options.seconds) for seed in seeds for name in names],
            options.peers, options.out)  # fmt: skip
    print(report(outcomes(options.out)))


if __name__ == "__main__":
    main()
