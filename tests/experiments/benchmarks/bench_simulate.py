"""Speed of the simulator compared with a Python loop and plain NumPy, and the share of random number generation.

    python -m tests.experiments.benchmarks.bench_simulate [--rounds 7] [--memory 1e9]

All methods run alternately in one process. The times are processor times of one core, and a sample has six axes. The
other methods are:

- a Python loop: vectorised white noise and a first-order Gauss–Markov drift, which is computed sample by sample for
  three axes, as in ``gyro_gen`` of gnss-ins-sim. This method has two terms instead of five.
- plain NumPy: the five terms of a whole record at once. B is white noise that is shaped by a fast Fourier transform.
  This method needs the whole record in memory.
- normal numbers: only the normal random numbers that the terms need. A faster simulator would need another generator.

``--memory N`` draws N samples and prints the resident memory in between. 1e9 samples take about ten minutes.
"""

import argparse
from collections.abc import Callable
from typing import Final

import numpy as np
import psutil

from drivers.data_types import AXES, Floats
from monitor.noise.effect import Effect
from monitor.noise.effects import (
    AngleRandomWalk,
    BiasInstability,
    ExponentiallyCorrelated,
    QuantizationNoise,
    RandomTelegraph,
    RateRamp,
    RateRandomWalk,
    Sinusoidal,
)
from monitor.noise.model import NoiseModel
from tests.experiments.benchmarks.machine import Load, console, create_table, describe_machine, time_alternately

RATE_HZ: Final = 100.0
Q, N, B, K, R = 8e-6, 1.5e-4, 2e-4, 4e-5, 1e-7
CORRELATION_S: Final = 100.0
FIVE: Final[tuple[Effect, ...]] = (
    QuantizationNoise(Q=Q),
    AngleRandomWalk(N=N),
    BiasInstability(B=B),
    RateRandomWalk(K=K),
    RateRamp(R=R),
)
THREE_MORE: Final[tuple[Effect, ...]] = (
    ExponentiallyCorrelated(sigma=1e-4, correlation_time=CORRELATION_S),
    Sinusoidal(amplitude=1e-4, frequency=17.3),
    RandomTelegraph(amplitude=1e-4, dwell_time=20.0),
)
SAMPLES: Final = 1 << 18
LOOP_SAMPLES: Final = 1 << 13
BLOCK: Final = 10_000
NORMALS: Final = {"five": 4, "eight": 5}
"""Normal numbers per sample and axis, for Q, N, B and K, and with correlated noise. Telegraph flips are rare."""


def make_stream(effects: tuple[Effect, ...], n: int) -> Callable[[], None]:
    """Return a function that draws a stream of six axes in blocks."""
    stream = NoiseModel(dict.fromkeys(AXES, effects)).start_stream(RATE_HZ, 1)
    stream.draw_next_samples(BLOCK)  # compiles the kernels

    def work() -> None:
        for _ in range(n // BLOCK):
            stream.draw_next_samples(BLOCK)

    return work


def make_normal_numbers(normals: int, n: int) -> Callable[[], None]:
    """Return a function that draws only normal numbers, into a small array."""
    rng, buffer = np.random.default_rng(1), np.empty(2048)

    def work() -> None:
        for _ in range(n * normals * len(AXES) // buffer.size):
            rng.standard_normal(out=buffer)

    return work


def make_python_loop(n: int) -> Callable[[], None]:
    """Return a function that simulates white noise and a drift in a Python loop, for three axes at a time."""
    rng = np.random.default_rng(1)
    keep = 1.0 - 1.0 / (RATE_HZ * CORRELATION_S)
    drive = B * np.sqrt(1.0 - np.exp(-2.0 / (RATE_HZ * CORRELATION_S)))

    def triad() -> Floats:
        white = N * np.sqrt(RATE_HZ) * rng.standard_normal((n, 3))
        shocks = rng.standard_normal((n, 3))
        drift = np.zeros((n, 3))
        for i in range(1, n):
            drift[i, :] = keep * drift[i - 1, :] + drive * shocks[i - 1, :]
        return np.asarray(drift + white)

    def work() -> None:
        np.hstack([triad(), triad()])

    return work


def make_numpy_record(n: int) -> Callable[[], None]:
    """Return a function that simulates the five terms of a whole record in plain NumPy."""
    rng = np.random.default_rng(1)
    f = np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    shape = np.zeros(f.size)
    shape[1:] = B * np.sqrt(RATE_HZ / (2.0 * np.pi * f[1:]))

    def work() -> None:
        values = np.empty((n, len(AXES)))
        for axis in range(len(AXES)):
            values[:, axis] = np.diff(Q * rng.standard_normal(n + 1)) * RATE_HZ
            values[:, axis] += N * np.sqrt(RATE_HZ) * rng.standard_normal(n)
            values[:, axis] += np.fft.irfft(shape * np.fft.rfft(rng.standard_normal(n)), n)
            values[:, axis] += np.cumsum(K / np.sqrt(RATE_HZ) * rng.standard_normal(n))
            values[:, axis] += R / RATE_HZ * np.arange(n)

    return work


def print_speed(rounds: int) -> None:
    """Print the table of the print_speed."""
    load = Load()
    whole = SAMPLES // BLOCK * BLOCK
    works = {
        "five": (make_stream(FIVE, SAMPLES), whole),
        "eight": (make_stream(FIVE + THREE_MORE, SAMPLES), whole),
        "draw five": (make_normal_numbers(NORMALS["five"], SAMPLES), SAMPLES),
        "draw eight": (make_normal_numbers(NORMALS["eight"], SAMPLES), SAMPLES),
        "at once": (make_numpy_record(SAMPLES), SAMPLES),
        "looped": (make_python_loop(LOOP_SAMPLES), LOOP_SAMPLES),
    }
    took = time_alternately({name: work for name, (work, _) in works.items()}, rounds)
    a_sample = {name: np.array(took[name]) / count for name, (_, count) in works.items()}
    title = f"simulation of six axes on one core; median (best) of {rounds} rounds"
    table = create_table(title, "", "ns a sample", "million samples/s", "five terms make_stream are")
    names = {
        "five": "five terms, streamed",
        "eight": "and three more: correlated, line, telegraph",
        "at once": "five terms, plain NumPy and FFT, whole record",
        "looped": "two terms, Gauss–Markov in a Python loop",
    }
    for key, name in names.items():
        median, best = a_sample[key]
        times = f"{median / a_sample['five'][0]:.1f} times as fast"
        million = f"{1e-6 / median:.3g} ({1e-6 / best:.3g})"
        table.add_row(name, f"{median * 1e9:.0f} ({best * 1e9:.0f})", million, times)
    console.print(table)
    for key in ("five", "eight"):
        share = a_sample[f"draw {key}"][0] / a_sample[key][0]
        console.print(f"{names[key]}: {100.0 * share:.0f} % of the time is spent on normal numbers")
    console.print(load.describe() + "\n")


def print_memory(samples: int) -> None:
    """Print the resident memory while samples are drawn."""
    stream = NoiseModel(dict.fromkeys(AXES, FIVE + THREE_MORE)).start_stream(RATE_HZ, 1)
    process = psutil.Process()
    table = create_table(f"resident memory, five terms and three more, blocks of {BLOCK}", "samples drawn", "MB")
    drawn = 0
    for mark in np.unique(np.geomspace(BLOCK, samples, 6).astype(np.int64) // BLOCK * BLOCK):
        while drawn < mark:
            stream.draw_next_samples(BLOCK)
            drawn += BLOCK
        table.add_row(f"{drawn:,}", f"{process.memory_info().rss / 1e6:.1f}")
    console.print(table)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--memory", type=float, default=1e7, help="samples to draw for the table of memory")
    arguments = parser.parse_args()
    console.print(describe_machine())
    print_speed(arguments.rounds)
    print_memory(int(arguments.memory))


if __name__ == "__main__":
    main()
