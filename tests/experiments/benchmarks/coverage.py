"""Coverage of the intervals of deviations and coefficients for simulated records with known noise.

    python -m tests.experiments.benchmarks.coverage --json coverage.jsonl                # all cells, 20 minutes
    python -m tests.experiments.benchmarks.coverage --json coverage.jsonl --records 120  # fewer

With ``--records 0 --page docs/measurements/statistics.md``, the program only writes the tables into the page.

A cell is a noise and a length of record at 100 Hz. The tables contain these numbers for each cell, in percent:

- the coverage of the two-sided 95 % intervals of deviations, for all τ up to an eighth of the record. The errors at
  neighbouring τ are correlated, so the number of independent intervals is estimated from the scatter between records.
- for each present term: the share of true results, which are two-sided 95 % intervals or one-sided 95 % bounds. The two
  are counted together: a term is estimated only if its estimate is large, so the intervals of a rarely estimated term
  are a biased sample.
- for each term: the share of records in which it is estimated.

Each record is analysed once by ``analyze``, in one process and one thread. An interrupted run can be continued.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import Ints, make_block
from monitor.estimation.analysis import analyze
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS, Coefficients, Status
from tests.experiments.benchmarks.records import (
    HOURS_3,
    MIN_45,
    MIX,
    RATE_HZ,
    Chunk,
    Noise,
    format_length,
    format_table,
    group_chunks,
    run_experiment,
    simulate_chunk,
    true_avar,
    wilson_interval,
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
ABSENT_TARGET: Final = (0.0, 0.05)
RESULT_TARGET: Final = (0.93, 1.0)
ANY: Final = (0.0, 1.0)
COUNTED: Final = ("estimated", "held", "bounded", "bound_held")


BoolMatrix = NDArray[np.bool_]


def count(cell: str, seconds: int, seed: int, chunk: int) -> Chunk:
    """Simulate and analyse the records of one chunk, and return the counts."""
    noise = CELLS[cell]
    n = round(seconds * RATE_HZ)
    t_ns = np.arange(n) * round(1e9 / RATE_HZ)
    by_tau: list[BoolMatrix] = []
    letters = np.zeros((len(SYMBOLS), len(COUNTED)), np.int64)
    for values in simulate_chunk(noise, cell, seconds, seed, chunk):
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
    """Return the counts [5, 4] of COUNTED in six axes."""
    truth = np.array([getattr(noise, letter) for letter in SYMBOLS])[:, None]
    covered = (given.lo <= truth) & (truth <= given.hi)
    estimated, bounded = given.status == Status.ESTIMATED, given.status == Status.UPPER_BOUND
    return np.stack(
        [flags.sum(axis=1) for flags in (estimated, estimated & covered, bounded, bounded & covered)], axis=1
    )


def tables(chunks: list[Chunk]) -> str:
    """Return the tables in Markdown."""
    groups = group_chunks(chunks)
    parts = [
        "The first table gives the percentage of intervals and bounds that are correct. The figure for Allan "
        "deviations is the average over all τ up to an eighth of the record. The figure in parentheses is that of the "
        "worst τ.",
        format_table(("record", "noise", "deviations", *SYMBOLS), [_correct(*g) for g in groups.items()]),
        "The next table gives the percentage of records in which each term is estimated. Parentheses mark terms that "
        "the noise does not contain.",
        format_table(("record", "noise", *SYMBOLS), [_estimated(*g) for g in groups.items()]),
        "A figure is bold if its 95 % interval lies entirely outside the expected range. The expected range is "
        f"{_percent(*TWO_SIDED)} % for deviations, {_percent(*RESULT_TARGET)} % for terms that the noise contains, and "
        f"{_percent(*ABSENT_TARGET)} % for the estimates of absent terms.",
    ]
    return "\n\n".join(parts)


def _correct(key: tuple[int, str], group: list[Chunk]) -> tuple[str, ...]:
    """Return the shares of deviations and of terms whose interval or bound contains the true value."""
    seconds, cell = key
    records = sum(chunk["records"] for chunk in group)
    total, square = np.sum([chunk["shares"] for chunk in group], axis=0)
    share = total / records
    scatter = (square / records - share**2) / records  # variance of the mean share
    total = share * (1.0 - share) / scatter
    m = np.array(group[0]["m"])
    by_tau = np.sum([chunk["deviations"] for chunk in group], axis=0)[m <= seconds * RATE_HZ / 8] / records
    deviations = f"{_share(share * total, total, TWO_SIDED)} ({100 * by_tau.min():.1f})"
    terms = []
    for letter in SYMBOLS:
        covered, given = (
            sum(chunk["letters"][letter][name] for chunk in group for name in names)
            for names in (("held", "bound_held"), ("estimated", "bounded"))
        )
        terms.append(_share(covered, given, RESULT_TARGET) if letter in CELLS[cell].present_terms() else "–")
    return format_length(seconds), cell, deviations, *terms


def _estimated(key: tuple[int, str], group: list[Chunk]) -> tuple[str, ...]:
    seconds, cell = key
    records = sum(chunk["records"] for chunk in group)
    shares = []
    for letter in SYMBOLS:
        estimated = sum(chunk["letters"][letter]["estimated"] for chunk in group)
        present = letter in CELLS[cell].present_terms()
        shares.append(_share(estimated, records) if present else f"({_share(estimated, records, ABSENT_TARGET)})")
    return format_length(seconds), cell, *shares


def _share(covered: float, total: float, target: tuple[float, float] = ANY) -> str:
    """Return a share, in bold if its 95 % interval is outside the target."""
    if not total:
        return "–"
    lo, hi = wilson_interval(covered, total)
    text = f"{100 * covered / total:.1f}"
    return text if lo <= target[1] and hi >= target[0] else f"**{text}**"


def _percent(lo: float, hi: float) -> str:
    return f"{100 * lo:.0f}–{100 * hi:.0f}"


if __name__ == "__main__":
    run_experiment("coverage", __doc__ or "", CELLS, (MIN_45, HOURS_3), count, tables)
