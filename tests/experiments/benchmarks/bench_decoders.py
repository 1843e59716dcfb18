"""Frames per second of every decoder: ``python -m tests.experiments.benchmarks.bench_decoders``.

Each decoder gets large portions of 4 KiB for byte streams and of 100 frames or messages. It also gets portions of ten
samples and of one sample, as from a sensor at 1 kHz and at 100 Hz. ``encode`` generates the bytes. The table contains
the best of three runs.
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


def simulate_samples(n: int) -> SampleBlock:
    """Return samples of a resting sensor with noise at 1 kHz."""
    rng = np.random.default_rng(1)
    values = rng.normal(0.0, 0.01, (n, 6)) + np.array([0.0, 0.0, 0.0, 0.0, 0.0, 9.8])
    at = np.arange(n)
    return make_block(at * 1_000_000, values, np.full(n, 25.0), at * 10)


def join_byte_stream(chunks: Sequence[Chunk], carrier: str) -> list[Chunk]:
    """Return the chunks for one call of ``feed``. Chunks of a byte stream are joined."""
    return [Chunk(b"".join(c.data for c in chunks), chunks[-1].t_ns)] if carrier == "bytes" else list(chunks)


def divide_stream(chunks: Sequence[Chunk], size: int) -> list[list[Chunk]]:
    """Divide a byte stream into chunks of one size."""
    data = b"".join(c.data for c in chunks)
    return [[Chunk(data[i : i + size], i)] for i in range(0, len(data), size)]


def measure_rate(example: Example, folder: Path, portions: list[list[Chunk]]) -> float:
    """Return the largest number of samples per second of several runs."""
    best = np.inf
    for _ in range(RUNS):
        decoder = example.build(folder)
        start = time.perf_counter()
        got = sum(len(b) for part in portions for b in decoder.feed(part))
        best = min(best, time.perf_counter() - start)
        if got < 0.99 * SAMPLES or decoder.bad:
            raise SystemExit(f"{example}: {got} of {SAMPLES} samples came back, {decoder.bad} bad")
    return SAMPLES / best


def measure(example: Example, folder: Path) -> tuple[str, int, list[float]]:
    """Return carrier, bytes per sample, and samples per second for large, small and single portions."""
    decoder = example.build(folder)
    samples = simulate_samples(SAMPLES)
    # ten samples at a time: a message may hold more than one
    tens = [decoder.encode(samples[i : i + 10]) for i in range(0, SAMPLES, 10)]
    flat = [chunk for ten in tens for chunk in ten]
    if decoder.carrier == "bytes":
        large = divide_stream(flat, CHUNK_BYTES)
    else:
        large = [[c for ten in tens[i : i + 10] for c in ten] for i in range(0, len(tens), 10)]
    small = [join_byte_stream(ten, decoder.carrier) for ten in tens]
    ones = [decoder.encode(samples[i : i + 1]) for i in range(SAMPLES)]
    single = [join_byte_stream(one, decoder.carrier) for one in ones]
    size = sum(len(c.data) for c in flat) // SAMPLES
    return decoder.carrier, size, [measure_rate(example, folder, portions) for portions in (large, small, single)]


def main() -> None:
    """Measure the first example of every decoder, or of the decoders in the arguments, and print the table."""
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
