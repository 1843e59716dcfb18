"""Right names, false names and processor time of ``reconcile`` and of similar methods in the blind trials.

    python -m tests.experiments.benchmarks.peers --seeds 4 --level plain --out peers.jsonl
    python -m tests.experiments.benchmarks.peers --report peers.jsonl                          # print results

Each method gets the recording and the baseline model, and returns the names of effects that the model does not contain.
The names are scored by ``tests.experiments.blind.score``, without confidences and intervals. The methods are:

- *GMWM ranking*: all nested models of WN, QN, RW, DR and up to three AR1 are ranked for each axis. The terms of the
  best model that the baseline does not contain are names. AR1 also replace flicker noise, which is not among the terms.
  An AR1 is therefore a name only if the same ranking has fewer AR1 for the wavelet variance of the baseline.
- *GMWM with the given model*: the wavelet variance of the baseline is a part of every model, and the additional terms
  are ranked. More of a term that the baseline contains is no name.
- *five-term fit*: coefficients and notes of ``analyze``, see ``fit_five_terms``.
- *reconcile*: the program in this process.

All methods run in one thread. The times are processor times of this process for a complete answer, divided by the
number of axes.
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
from monitor.reconcile.preparation.reconcile_input import RecordedAxes
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
class FoundEffect:
    """Effect that a method finds and the model does not contain."""

    axis: str
    effect: str
    source: str | None = None
    confidence: float | None = None


Peer = Callable[[Mapping[str, Floats], float, NoiseModel, int], Iterable[FoundEffect]]
"""Function from columns of a recording, rate in Hz, baseline and seed to the found effects."""


# --- methods


def rank_models(columns: Mapping[str, Floats], rate_hz: float, model: NoiseModel, seed: int) -> Iterable[FoundEffect]:
    """Yield the effects of the GMWM ranking."""
    for axis in _axes(columns):
        best = gmwm.rank(gmwm.wavelet_variance(columns[axis]))[0]
        own = gmwm.with_intervals(
            describe_baseline(axis, columns[axis].size, rate_hz, model).variance, columns[axis].size
        )
        baseline_ar1 = len(gmwm.rank(own)[0].times)
        yield from _yield_additions(axis, best, model, baseline_ar1)


def rank_additions(
    columns: Mapping[str, Floats], rate_hz: float, model: NoiseModel, seed: int
) -> Iterable[FoundEffect]:
    """Yield the effects of the GMWM ranking of additions to the baseline."""
    for axis in _axes(columns):
        baseline = describe_baseline(axis, columns[axis].size, rate_hz, model)
        yield from _yield_additions(axis, gmwm.rank(gmwm.wavelet_variance(columns[axis]), baseline)[0], model, 0)


def fit_five_terms(
    columns: Mapping[str, Floats], rate_hz: float, model: NoiseModel, seed: int
) -> Iterable[FoundEffect]:
    """Yield the effects of the five-term fit."""
    shown = {axis: columns[axis] for axis in _axes(columns)}
    for axis, effect in sorted(five_terms.find_names(shown, rate_hz, model)):
        yield FoundEffect(axis, effect)


def run_reconcile(columns: Mapping[str, Floats], rate_hz: float, model: NoiseModel, seed: int) -> Iterable[FoundEffect]:
    """Yield the effects of ``reconcile``."""
    shown = {axis: columns[axis] for axis in _axes(columns)}
    found = reconcile(RecordedAxes(shown, rate_hz, columns.get("temperature")), model, seed)
    for axis, result in found.axes.items():
        for step in result.steps:
            if step.kind == "added":
                source = step.parameters.get("source")
                yield FoundEffect(axis, step.effect, None if source is None else str(source.value), step.confidence)


PEERS: Final[Mapping[str, Peer]] = {
    "GMWM ranking": rank_models,
    "GMWM with the given model": rank_additions,
    "five-term fit": fit_five_terms,
    "reconcile": run_reconcile,
}
POSSIBLE_NAMES: Final[Mapping[str, frozenset[str]]] = {
    "GMWM ranking": frozenset(NAMES.values()),
    "GMWM with the given model": frozenset(NAMES.values()),
    "five-term fit": five_terms.POSSIBLE_NAMES,
    "reconcile": frozenset(SINGLES),
}
"""Names that each method can give."""


def _axes(columns: Mapping[str, Floats]) -> list[str]:
    return [axis for axis in AXES if axis in columns]


def describe_baseline(axis: str, n: int, rate_hz: float, model: NoiseModel) -> gmwm.KnownPart:
    """Return wavelet variance and spectrum of the baseline of an axis, from its Allan variance and PSD."""
    variance = 0.5 * model.avar(axis, 0.5 * gmwm.dyadic_scales(n) / rate_hz, 1.0 / rate_hz)
    f_hz = (rate_hz / n) * np.arange(1, n // 2 + 1, dtype=np.float64)
    return gmwm.KnownPart(variance, rate_hz * model.two_sided_psd(axis, f_hz, 1.0 / rate_hz))


def _yield_additions(axis: str, best: gmwm.FittedModel, model: NoiseModel, expected: int) -> Iterable[FoundEffect]:
    """Yield the terms that the baseline does not contain. ``expected`` is the number of AR1 that are no names."""
    has = {effect.name for effect in model.effects.get(axis, ())}
    for term in best.terms:
        if NAMES[term] not in has:
            yield FoundEffect(axis, NAMES[term])
    if len(best.times) > expected and NAMES["AR1"] not in has:
        yield FoundEffect(axis, NAMES["AR1"])


# --- run and score


def score_method(case: Case, peer: str, seed: int) -> Outcome:
    """Run a method on a case and score its answer, with the processor time for all axes."""
    model = NoiseModel.from_toml(case.model)
    begin = time.process_time()
    names = list(PEERS[peer](case.columns, case.rate_hz, model, seed))
    return score(case.truth, make_report(names), 0, time.process_time() - begin)


def make_report(names: Sequence[FoundEffect]) -> dict[str, Any]:
    """Return the part of a ``report.json`` that the score needs."""
    axes: dict[str, Any] = {axis: {"verdict": "agrees", "steps": [], "left_over": []} for axis in AXES}
    for one in names:
        parameters = {} if one.source is None else {"source": {"value": one.source}}
        step = {"kind": "added", "effect": one.effect, "parameters": parameters, "confidence": one.confidence}
        axes[one.axis]["steps"].append(step)
        axes[one.axis]["verdict"] = "explained"
    return {"verdict": "explained" if names else "agrees", "axes": axes}


def run_all(todo: Sequence[run.Job], peers: Sequence[str], file: Path) -> None:
    """Run the missing cases and methods, and append a line for each to ``file``."""
    done = {(line["key"], line["peer"]) for line in run.read_lines(file)}
    with file.open("a") as results:
        for job in todo:
            left = [peer for peer in peers if (job.key, peer) not in done]
            if not left:
                continue
            case = job.case()
            for peer in left:
                outcome = score_method(case, peer, job.seed)
                results.write(json.dumps({"key": job.key, "peer": peer, **outcome.json()}) + "\n")
                results.flush()
                names = ", ".join(f"{one.axis} {one.effect}" for one in outcome.names) or "no name"
                mark = "right" if outcome.right else "WRONG"
                print(f"{mark} {job.key}: {peer}: {names}; {outcome.seconds:.2f} s", file=sys.stderr, flush=True)


def compile_kernels(peers: Sequence[str]) -> None:
    """Run each method on a short recording, so that all kernels are compiled."""
    case = run.Job("null", "plain", 0, 120.0).case()
    for peer in peers:
        score_method(case, peer, 0)


def read_outcomes(file: Path) -> dict[str, list[Outcome]]:
    """Return the scored cases of each method."""
    found: dict[str, list[Outcome]] = defaultdict(list)
    for line in run.read_lines(file):
        found[line["peer"]].append(Outcome.from_json({k: v for k, v in line.items() if k not in ("key", "peer")}))
    return {peer: found[peer] for peer in PEERS if peer in found}


# --- tables


def format_report(found: Mapping[str, Sequence[Outcome]]) -> str:
    """Return both tables in Markdown."""
    return "\n\n".join([summary(found), by_effect(found)])


def summary(found: Mapping[str, Sequence[Outcome]]) -> str:
    """Return a row for each method, with 95 % Wilson intervals."""
    rows = []
    for peer, of_peer in found.items():
        singles = [one for one in of_peer if one.case != "null"]
        sayable = [one for one in singles if one.case in POSSIBLE_NAMES[peer]]
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
        "named, of effects that it can name",
        "a false name with a hidden effect",
        "a false name on null data",
        "false names per recording",
        "processor seconds per axis, median / maximum",
    )
    return format_table(head, rows)


def by_effect(found: Mapping[str, Sequence[Outcome]]) -> str:
    """Return a row for each effect with the numbers of right names and of false names."""
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
    """Return True if all hidden effects were named."""
    return not one.missed


def main() -> None:
    """Run the methods and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, default=1, help="recordings of each effect, and null ones")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--level", choices=("plain", "faint"), default="plain")
    parser.add_argument("--seconds", type=float, default=3600.0, help="length of recordings")
    parser.add_argument("--only", nargs="+", metavar="EFFECT", choices=(*SINGLES, "null"), help="only these effects")
    parser.add_argument("--peers", nargs="+", choices=tuple(PEERS), default=tuple(PEERS))
    parser.add_argument("--out", type=Path, metavar="FILE.jsonl", help="result file, which a later run continues")
    parser.add_argument("--report", type=Path, metavar="FILE.jsonl", help="print stored results only")
    options = parser.parse_args()
    if options.report:
        print(format_report(read_outcomes(options.report)))
        return
    if options.out is None:
        parser.error("one of --out and --report is needed")
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    names = options.only or (*SINGLES, "null")
    compile_kernels(options.peers)
    run_all([run.Job(name, options.level, seed, options.seconds) for seed in seeds for name in names],
            options.peers, options.out)  # fmt: skip
    print(format_report(read_outcomes(options.out)))


if __name__ == "__main__":
    main()
