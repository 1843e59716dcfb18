"""Frames per second of every decoder: ``python -m tests.experiments.benchmarks.bench_decoders``.

Byte streams are fed in 4 KiB chunks, frames and messages 100 at a time; and all of them ten samples and one at
a time, as a sensor of 1 kHz and one of 100 Hz deliver them. ``encode`` makes the bytes; the best of three runs counts.
"""

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[3]))

from drivers.data_types import Chunk, SampleBlock, make_block
from tests.contracts.decoder_examples import EXAMPLES, Example

SAMPLES = 20_000
CHUNK_BYTES = 4096
RUNS = 3


def made(n: int) -> SampleBlock:
    """A resting sensor with noise, at 1 kHz."""
    rng = np.random.default_rng(1)
    values = rng.normal(0.0, 0.01, (n, 6)) + np.array([0.0, 0.0, 0.0, 0.0, 0.0, 9.8])
    at = np.arange(n)
    return make_block(at * 1_000_000, values, np.full(n, 25.0), at * 10)


def fed_at(chunks: Sequence[Chunk], carrier: str) -> list[Chunk]:
    """What one call of ``feed`` gets: a byte stream's chunks are joined."""
    return [Chunk(b"".join(c.data for c in chunks), chunks[-1].t_ns)] if carrier == "bytes" else list(chunks)


def cut(chunks: Sequence[Chunk], size: int) -> list[list[Chunk]]:
    """A byte stream in chunks of one size."""
    data = b"".join(c.data for c in chunks)
    return [[Chunk(data[i : i + size], i)] for i in range(0, len(data), size)]


def rate(example: Example, folder: Path, fed: list[list[Chunk]]) -> float:
    """Samples a second, the best of some runs."""
    best = np.inf
    for _ in range(RUNS):
        decoder = example.build(folder)
        start = time.perf_counter()
        got = sum(len(b) for part in fed for b in decoder.feed(part))
        best = min(best, time.perf_counter() - start)
        if got < 0.99 * SAMPLES or decoder.bad:
            raise SystemExit(f"{example}: {got} of {SAMPLES} samples came back, {decoder.bad} bad")
    return SAMPLES / best


def measure(example: Example, folder: Path) -> tuple[str, int, list[float]]:
    """(carrier, bytes a sample, samples a second in large, small and single portions)."""
    decoder = example.build(folder)
    samples = made(SAMPLES)
    # ten samples at a time: a message may hold more than one
    tens = [decoder.encode(samples[i : i + 10]) for i in range(0, SAMPLES, 10)]
    flat = [chunk for ten in tens for chunk in ten]
    if decoder.carrier == "bytes":
        large = cut(flat, CHUNK_BYTES)
    else:
        large = [[c for ten in tens[i : i + 10] for c in ten] for i in range(0, len(tens), 10)]
    small = [fed_at(ten, decoder.carrier) for ten in tens]
    ones = [decoder.encode(samples[i : i + 1]) for i in range(SAMPLES)]
    single = [fed_at(one, decoder.carrier) for one in ones]
    size = sum(len(c.data) for c in flat) // SAMPLES
    return decoder.carrier, size, [rate(example, folder, fed) for fed in (large, small, single)]


def main() -> None:
    """Measure and print: the first example of every decoder, or of those named as arguments."""
    table = Table(title="decoders: samples a second")
    table.add_column("decoder")
    for heading in ("carrier", "bytes a sample", "4 KiB / 100 at a time", "10 at a time", "1 at a time"):
        table.add_column(heading, justify="right")
    firsts = {example.name: example for example in reversed(EXAMPLES)}
    with TemporaryDirectory() as folder:
        for name in sys.argv[1:] or sorted(firsts):
            carrier, size, rates = measure(firsts[name], Path(folder))
            table.add_row(name, carrier, f"{size}", *(f"{one:,.0f}" for one in rates))
    Console().print(table)


if __name__ == "__main__":
    main()
