"""Do the intervals hold what they promise? Simulates records of known noise and counts.

    python -m tests.experiments.benchmarks.coverage --json coverage.jsonl                # all cells, 20 minutes
    python -m tests.experiments.benchmarks.coverage --json coverage.jsonl --records 120  # fewer

With ``--records 0 --page docs/statistics-measurements.md``, the program only writes the tables into the page.

Counted for each cell (a noise and a length of record at 100 Hz), in percent with the 95 % interval of Wilson:

- how often the two-sided 95 % interval of a deviation holds the true one, at all τ up to an eighth of the record
  together. Neighbouring τ of a record err together, so its interval is that of as many independent looks as the
  scatter between records shows;
- for each term that is there: how often what is said of it is true, be it a two-sided 95 % interval or a one-sided 95 %
  bound; how often it is estimated; and the shares of true intervals and of true bounds by themselves. A term enters
  when its estimate comes out large, so the few intervals of a term that is seldom in are those of lucky records,
  and the few bounds of one that is nearly always in those of unlucky ones: where a kind of answer is given
  in less than half of the records, its share is shown but not judged;
- for each term that is absent: how often it is estimated all the same.

Each record goes through ``analyze``, and is looked at once. One process, one thread; a run can be broken off and
taken up again.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import Ints, make_block
from monitor.estimation.analysis import analyze
from monitor.estimation.fit.coefficient_values import SYMBOLS, Coefficients, Status
from tests.experiments.benchmarks.records import (
    HOURS_3,
    MIN_45,
    MIX,
    RATE_HZ,
    Chunk,
    Noise,
    length,
    markdown,
    merged,
    program,
    sixes,
    true_avar,
    wilson,
)

CELLS: Final = {
    "white": Noise(N=MIX.N),
    "flicker": Noise(B=MIX.B),
    "random walk": Noise(K=MIX.K),
    "mix": MIX,
    "mix without Q": Noise(N=MIX.N, B=MIX.B, K=MIX.K),
    "mix without B": Noise(Q=MIX.Q, N=MIX.N, K=MIX.K),
    "mix without K": Noise(Q=MIX.Q, N=MIX.N, B=MIX.B),
    "mix with K × 10": Noise(MIX.Q, MIX.N, MIX.B, 10.0 * MIX.K),
    "mix, ramp 2e-7": Noise(MIX.Q, MIX.N, MIX.B, MIX.K, R=2e-7),
    "mix, ramp 1e-6": Noise(MIX.Q, MIX.N, MIX.B, MIX.K, R=1e-6),
}
TWO_SIDED: Final = (0.93, 0.97)
ONE_SIDED: Final = (0.94, 1.0)
FALSE: Final = (0.0, 0.05)
SAID: Final = (0.93, 1.0)
ANY: Final = (0.0, 1.0)
COUNTED: Final = ("estimated", "held", "bounded", "bound_held")


BoolMatrix = NDArray[np.bool_]


def count(cell: str, seconds: int, seed: int, chunk: int) -> Chunk:
    """Simulate, analyze and count one chunk."""
    noise = CELLS[cell]
    n = round(seconds * RATE_HZ)
    t_ns = np.arange(n) * round(1e9 / RATE_HZ)
    by_tau: list[BoolMatrix] = []
    letters = np.zeros((len(SYMBOLS), len(COUNTED)), np.int64)
    for values in sixes(noise, cell, seconds, seed, chunk):
        found = analyze([make_block(t_ns, values)], RATE_HZ).estimate
        truth = np.sqrt(true_avar(noise, found.curve.factors))[:, None]
        by_tau.append((found.curve.lo <= truth) & (truth <= found.curve.hi))
        letters += _counted(found.coefficients, noise)
    inside, m = np.concatenate(by_tau, axis=1), found.curve.factors
    shares = inside[m <= n // 8].mean(axis=0)
    return {
        "m": m.tolist(),
        "deviations": inside.sum(axis=1).tolist(),
        "shares": [shares.sum(), (shares**2).sum()],
        "letters": {c: dict(zip(COUNTED, row, strict=True)) for c, row in zip(SYMBOLS, letters.tolist(), strict=True)},
    }


def _counted(given: Coefficients, noise: Noise) -> Ints:
    """[5, 4] of COUNTED in six axes."""
    truth = np.array([getattr(noise, letter) for letter in SYMBOLS])[:, None]
    held = (given.lo <= truth) & (truth <= given.hi)
    estimated, bounded = given.status == Status.ESTIMATED, given.status == Status.UPPER_BOUND
    return np.stack([flags.sum(axis=1) for flags in (estimated, estimated & held, bounded, bounded & held)], axis=1)


def tables(chunks: list[Chunk]) -> str:
    """Markdown of all that was counted."""
    groups = merged(chunks)
    parts = [
        "Two-sided 95 % intervals of deviations, for τ up to an eighth of the record:",
        markdown(
            ("record", "noise", "records", "holds, %", "worst and best τ, %"), [_deviations(*g) for g in groups.items()]
        ),
        "Terms that are present:",
        markdown(
            ("record", "noise", "term", "result holds, %", "estimated, %", "interval holds, %", "bound holds, %"),
            [row for group in groups.items() for row in _present(*group)],
        ),
        "Absent terms that are estimated, %:",
        markdown(("record", "noise", *SYMBOLS), [_absent(*group) for group in groups.items()]),
        "A figure is bold if its interval lies entirely outside the expected range. The expected range is "
        f"{_percent(*TWO_SIDED)} % for intervals, {_percent(*ONE_SIDED)} % for bounds, {_percent(*SAID)} % for all "
        f"results of a term together, and {_percent(*FALSE)} % for absent terms.",
    ]
    return "\n\n".join(parts)


def _deviations(key: tuple[int, str], group: list[Chunk]) -> tuple[str, ...]:
    seconds, cell = key
    records = sum(chunk["records"] for chunk in group)
    total, square = np.sum([chunk["shares"] for chunk in group], axis=0)
    share = total / records
    scatter = (square / records - share**2) / records  # variance of the mean share
    looks = share * (1.0 - share) / scatter
    m = np.array(group[0]["m"])
    by_tau = np.sum([chunk["deviations"] for chunk in group], axis=0)[m <= seconds * RATE_HZ / 8] / records
    worst = f"{100 * by_tau.min():.1f}, {100 * by_tau.max():.1f}"
    return length(seconds), cell, str(records), _share(share * looks, looks, TWO_SIDED), worst


def _present(key: tuple[int, str], group: list[Chunk]) -> list[tuple[str, ...]]:
    seconds, cell = key
    records = sum(chunk["records"] for chunk in group)
    rows: list[tuple[str, ...]] = []
    for letter in CELLS[cell].present():
        counts = [sum(chunk["letters"][letter][name] for chunk in group) for name in COUNTED]
        estimated, held, bounded, bound_held = counts
        rows.append(
            (
                length(seconds),
                cell,
                letter,
                _share(held + bound_held, estimated + bounded, SAID),
                _share(estimated, records),
                _share(held, estimated, TWO_SIDED if 2 * estimated >= records else ANY),
                _share(bound_held, bounded, ONE_SIDED if 2 * bounded >= records else ANY),
            )
        )
    return rows


def _absent(key: tuple[int, str], group: list[Chunk]) -> tuple[str, ...]:
    seconds, cell = key
    records = sum(chunk["records"] for chunk in group)
    there = CELLS[cell].present()
    entered = [
        "–" if c in there else _share(sum(chunk["letters"][c]["estimated"] for chunk in group), records, FALSE)
        for c in SYMBOLS
    ]
    return length(seconds), cell, *entered


def _share(held: float, looks: float, target: tuple[float, float] = ANY) -> str:
    """A share with its interval, bold where the interval does not meet the target."""
    if not looks:
        return "–"
    lo, hi = wilson(held, looks)
    text = f"{100 * held / looks:.1f} [{100 * lo:.1f}, {100 * hi:.1f}]"
    return text if lo <= target[1] and hi >= target[0] else f"**{text}**"


def _percent(lo: float, hi: float) -> str:
    return f"{100 * lo:.0f}–{100 * hi:.0f}"


if __name__ == "__main__":
    program("coverage", __doc__ or "", CELLS, (MIN_45, HOURS_3), count, tables)
