"""A whole recording at once: ``overlapping`` and ``analyze`` beside ``allantools.oadev``.

    python -m tests.experiments.benchmarks.bench_batch [--samples 10000000] [--rounds 5]

Both get the same rates in memory and the same τ, an octave grid to a quarter of the recording. allantools does one
axis a call; six times that stand beside ``analyze``, which also checks the times of the samples and fits. Processor
time of one thread; where threads are used, the clock on the wall beside the processor time of all.
"""

import argparse
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Final

import allantools
import numpy as np

from drivers.data_types import AXES, Floats, Ints
from drivers.recordings import Recording, iter_blocks
from monitor.estimation.allan.batch import (
    cluster_sizes,
    overlapping_avar,
    overlapping_avar_axis,
    rate_slope_from_thirds,
)
from monitor.estimation.analysis import analyze
from tests.experiments.benchmarks.machine import Load, about, alternate, console, table

RATE_HZ: Final = 100.0
NOISE: Final = 1e-4
THREADS: Final = 2


def made(n: int) -> Floats:
    """White noise on all axes and gravity on az."""
    values = np.random.default_rng(1).standard_normal((n, len(AXES)))
    values *= NOISE
    values[:, 5] += 9.81
    return values


def peer(column: Floats, factors: Ints) -> Floats:
    """Overlapping Allan deviation of one axis by allantools."""
    deviation: Floats = allantools.oadev(column, rate=1.0, data_type="freq", taus=factors)[1]
    return deviation


def agreement(values: Floats, factors: Ints) -> float:
    """Largest relative difference of the two in deviation."""
    theirs = peer(values[:, 5].copy(), factors)
    ours = np.sqrt(overlapping_avar_axis(values[:, 5], factors)[0][: theirs.size])
    return float(np.abs(ours / theirs - 1.0).max())


def on_the_wall(work: Callable[[], object], rounds: int) -> tuple[float, float]:
    """Median wall and processor seconds."""
    took = []
    for _ in range(rounds):
        wall, processor = time.perf_counter(), time.process_time()
        work()
        took.append((time.perf_counter() - wall, time.process_time() - processor))
    median = np.median(took, axis=0)
    return float(median[0]), float(median[1])


def one_thread(values: Floats, rounds: int) -> None:
    """One axis, six axes, and all of ``analyze``, in turn with allantools."""
    load = Load()
    n = len(values)
    recording = Recording(np.arange(n) / RATE_HZ, values, np.full(n, np.nan), None, AXES, ())
    blocks = list(iter_blocks(recording))
    octave, decade = cluster_sizes(n, RATE_HZ), cluster_sizes(n, RATE_HZ, "decade10")
    column = values[:, 5].copy()
    works = {
        "allantools": lambda: peer(column, octave),
        "one axis": lambda: overlapping_avar_axis(column, octave),
        "of six": lambda: overlapping_avar_axis(values[:, 5], octave),
        "six": lambda: overlapping_avar(values, octave),
        "slope": lambda: rate_slope_from_thirds(values),
        "analyze": lambda: analyze(blocks, RATE_HZ),
        "allantools, decade10": lambda: peer(column, decade),
        "decade10": lambda: overlapping_avar_axis(column, decade),
    }
    took = alternate(works, rounds)  # type: ignore[arg-type]
    shown = table(
        f"{n:,} samples, median (best) of {rounds} rounds, one thread", "", "τ", "processor", "allantools over this"
    )
    theirs, theirs_decade = took["allantools"][0], took["allantools, decade10"][0]
    rows = (
        ("allantools.oadev, one axis", "allantools", octave, theirs),
        ("overlapping_axis, in one piece", "one axis", octave, theirs),
        ("overlapping_axis, a column of six", "of six", octave, theirs),
        ("overlapping, six axes", "six", octave, 6.0 * theirs),
        ("slope, six axes", "slope", octave, None),
        ("analyze, six axes", "analyze", octave, 6.0 * theirs),
        ("allantools.oadev, one axis", "allantools, decade10", decade, theirs_decade),
        ("overlapping_axis, in one piece", "decade10", decade, theirs_decade),
    )
    for said, name, factors, against in rows:
        median, best = took[name]
        ratio = "" if against is None else f"{against / median:.1f}"
        shown.add_row(said, f"{factors.size}", f"{median:.3f} ({best:.3f}) s", ratio)
    console.print(shown)
    rest = took["analyze"][0] - took["six"][0] - took["slope"][0]
    console.print(f"of analyze: times, grid, covariances and fit {rest:.3f} s")
    console.print(f"largest relative difference of deviations, 9.81 on {NOISE:g}: {agreement(values, octave):.1e}")
    console.print(load.said() + "\n")


def threads(values: Floats, rounds: int) -> None:
    """Six axes, mapped over threads by the caller."""
    load = Load()
    factors = cluster_sizes(len(values), RATE_HZ)
    shown = table(f"overlapping, six axes of {len(values):,} samples", "", "on the wall", "processor")
    with ThreadPoolExecutor(THREADS) as pool:
        works = {
            "one thread": lambda: overlapping_avar(values, factors),
            f"{THREADS} threads": lambda: overlapping_avar(values, factors, map_axes=pool.map),
        }
        for name, work in works.items():
            wall, processor = on_the_wall(work, rounds)
            shown.add_row(name, f"{wall:.3f} s", f"{processor:.3f} s")
    console.print(shown)
    console.print(load.said() + "\n")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--samples", type=int, default=10_000_000)
    parser.add_argument("--rounds", type=int, default=5)
    given = parser.parse_args()
    console.print(about())
    values = made(given.samples)
    analyze(list(iter_blocks(Recording(None, values[:10_000], np.full(10_000, np.nan), RATE_HZ, AXES, ()))), RATE_HZ)
    one_thread(values, given.rounds)
    threads(values, given.rounds)


if __name__ == "__main__":
    main()
