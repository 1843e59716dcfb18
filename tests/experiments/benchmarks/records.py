"""Exact simulation of records for the statistical experiments, without code of ``monitor.noise``.

A record is the sum of the terms of IEEE Std 952, sampled at τ0. Q is the difference of white angle noise, N is white
noise, B has the spectrum B²/(2πf) up to half the sample rate, K is the cumulative sum of white noise, and R is a
straight line. ``monitor.noise`` uses the same definitions, but its filter for B follows 1/f only to 0.1 %.

Not all terms are stationary, but the differences of successive samples are. Their autocovariance r is known in closed
form. The circulant matrix whose first row is r followed by its mirror image has the eigenvalues DCT-I(r), which are not
negative for these noises. White noise times the square roots of the eigenvalues is Fourier-transformed. The real and
the imaginary part of the result then have exactly this autocovariance (Davies & Harte, Biometrika 74, 1987; Dietrich &
Newsam, SIAM J. Sci. Comput. 18, 1997). The cumulative sum of the differences is the record, except for its mean, which
does not change an Allan variance.

The module also contains the Cramér–Rao limit of such records, and the file of counts with which a run is continued.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any, Final
from zlib import crc32

import numpy as np
from scipy.fft import dct, fft, next_fast_len
from scipy.special import ndtri, sici

from drivers.data_types import Floats, Ints
from monitor.estimation.fit.coefficients_with_intervals import SYMBOLS

RATE_HZ: Final = 100.0
AXES: Final = 6
LARGE_CLUSTER: Final = 4096
"""Cluster size in samples from which the upper end of the spectrum changes flicker by less than 1e-6."""
CHUNK: Final = 60
"""Number of records in a chunk, the smallest unit in the file."""
MIN_45: Final = 2700
HOURS_3: Final = 10_800
HOURS_24: Final = 86_400
NAMES: Final = {MIN_45: "45 min", HOURS_3: "3 h", HOURS_24: "24 h"}

Chunk = dict[str, Any]
"""One line of the file: cell, seconds, seed, chunk, records, cpu_s, and the counts of the experiment."""


@dataclass(frozen=True, slots=True)
class Noise:
    """Coefficients of a record in SI units. A term with 0 is absent."""

    Q: float = 0.0  # rad
    N: float = 0.0  # rad/√s
    B: float = 0.0  # rad/s
    K: float = 0.0  # rad/s/√s
    R: float = 0.0  # rad/s²

    def at_unit_step(self) -> Floats:
        """Return Q² N² B² K² R² [5] for τ0 = 1 in (rad/s)²."""
        return np.array(astuple(self)) ** 2 * RATE_HZ ** np.array([2.0, 1.0, 0.0, -1.0, -2.0])

    def present_terms(self) -> tuple[str, ...]:
        """Return the letters of the present terms."""
        return tuple(letter for letter in SYMBOLS if getattr(self, letter) > 0.0)


MIX: Final = Noise(Q=2e-6, N=1.5e-4, B=4e-5, K=1.5e-6)
"""Noise of a MEMS gyro."""


class Records:
    """Simulation of six independent records of one noise at a time.

    >>> draw = Records(Noise(N=1e-3), 1000)
    >>> draw.simulate_six(np.random.default_rng(0)).shape
    (1000, 6)
    """

    def __init__(self, noise: Noise, n: int) -> None:
        self._n = n
        self._ramp = noise.R / RATE_HZ
        half = next_fast_len(n)
        eigenvalues = dct(_difference_autocovariance(noise, half), type=1)
        if eigenvalues.min() < -1e-12 * eigenvalues.max():
            raise ValueError(f"no circulant for {noise}: eigenvalue {eigenvalues.min()}")
        whole = np.concatenate([eigenvalues, eigenvalues[-2:0:-1]])
        self._amplitudes = np.sqrt(np.maximum(whole, 0.0) / whole.size)

    def simulate_six(self, rng: np.random.Generator) -> Floats:
        """Return six records [n, 6] in rad/s."""
        values = np.empty((self._n, AXES))
        for pair in range(0, AXES, 2):
            white = rng.standard_normal(2 * self._amplitudes.size).view(np.complex128)
            white *= self._amplitudes
            steps = fft(white, overwrite_x=True)[: self._n]
            np.cumsum(steps.real, out=values[:, pair])
            np.cumsum(steps.imag, out=values[:, pair + 1])
        if self._ramp:
            values += self._ramp * np.arange(self._n)[:, None]
        return values


def _difference_autocovariance(noise: Noise, lags: int) -> Floats:
    """Return the autocovariance of the differences of successive samples at lags 0 … ``lags`` for τ0 = 1.

    White noise differenced once is N, twice Q. For 1/f, E|y_{k+t} − y_k|² = (2/π) Cin(πt), Cin(z) = ∫ (1 − cos u)/u du
    from 0 to z, and steps have half the second difference of that. It is the transform of the steps' spectrum:

    >>> f = (np.arange(5000) + 0.5) / 10_000
    >>> spectrum = 4.0 * np.sin(np.pi * f) ** 2 / (2.0 * np.pi * f)
    >>> [round(float(np.mean(spectrum * np.cos(2.0 * np.pi * f * lag))), 6) for lag in range(4)]
    [1.049326, -0.273397, -0.132764, -0.021602]
    >>> _difference_autocovariance(Noise(B=1.0), 3).round(6).tolist()
    [1.049326, -0.273397, -0.132764, -0.021602]
    """
    q, n, b, k, _ = noise.at_unit_step()
    r = np.zeros(lags + 1)
    r[:3] = q * np.array([6.0, -4.0, 1.0])
    r[:2] += n * np.array([2.0, -1.0])
    r[0] += k
    if b:
        cin = _cin(np.arange(lags + 2))
        r += b / np.pi * (cin[1:] + np.concatenate([cin[1:2], cin[:-2]]) - 2.0 * cin[:-1])
    return r


def _cin(lags: Ints) -> Floats:
    """Return Cin(πt) for integers t ≥ 0."""
    z = np.pi * np.maximum(lags, 1)
    return np.where(lags > 0, np.euler_gamma + np.log(z) - sici(z)[1], 0.0)


def true_avar(noise: Noise, factors: Ints) -> Floats:
    """Return the true Allan variance [m] of sampled records in (rad/s)² (IEEE Std 952).

    >>> m = np.array([1, 2, 1000])
    >>> (true_avar(Noise(B=1.0), m) / (2.0 * np.log(2.0) / np.pi)).round(4).tolist()
    [1.189, 1.0887, 1.0]
    """
    m = factors.astype(np.float64)
    flicker = np.array([_flicker_avar(int(k)) for k in factors])
    shapes = np.stack([3.0 / m**2, 1.0 / m, flicker, m / 3.0 + 1.0 / (6.0 * m), 0.5 * m**2])
    return np.asarray(noise.at_unit_step() @ shapes)


def _flicker_avar(m: int) -> float:
    """Return 1/m² Σ (m − |j|) (c(j) − c(j + m)) over |j| < m with c(t) = −Cin(πt)/π, or 2 ln 2/π for large m."""
    if m >= LARGE_CLUSTER:
        return float(2.0 * np.log(2.0) / np.pi)
    j = np.arange(1 - m, m)
    return float((m - np.abs(j)) @ (_cin(j + m) - _cin(np.abs(j))) / (np.pi * m * m))


def cramer_rao(noise: Noise, n: int) -> dict[str, float]:
    """Return the least relative standard deviation of each present random term, from Whittle's information.

    I_ab = ½ Σ_k S_a S_b / S² in the variances, at f_k = k/2n, k = 1 … n − 1, where the DCT-II makes the coefficients of
    white noise and random walk independent exactly; the root of its inverse's diagonal, halved, in deviations. The
    usual k/n, which cannot see half a period, would be as loose as 1.22 times this (K of the mix, 45 min).

    White noise alone: the relative standard deviation of √(mean of squares) of n − 1 numbers.

    >>> print(f"{cramer_rao(Noise(N=1.0), 5001)['N']:.3f}")
    0.010
    """
    letters = [letter for letter in noise.present_terms() if letter != "R"]
    k = np.arange(1, n)
    sine = np.sin(np.pi * k / (2.0 * n))
    shapes = {"Q": 4.0 * sine**2, "N": np.ones(n - 1), "B": n / (np.pi * k), "K": 0.25 / sine**2}
    theta = dict(zip(SYMBOLS, noise.at_unit_step(), strict=True))
    spectra = np.stack([theta[letter] * shapes[letter] for letter in letters])
    shares = spectra / spectra.sum(0)
    limits = 0.5 * np.sqrt(np.diag(np.linalg.inv(0.5 * shares @ shares.T)))
    return dict(zip(letters, limits.tolist(), strict=True))


def generator(cell: str, seconds: int, seed: int, chunk: int) -> np.random.Generator:
    """Return the random generator of a chunk, so that each chunk can be simulated separately."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(crc32(cell.encode()), seconds, chunk)))


def simulate_chunk(noise: Noise, cell: str, seconds: int, seed: int, chunk: int) -> Iterator[Floats]:
    """Yield the records [n, 6] of a chunk."""
    rng, records = generator(cell, seconds, seed, chunk), Records(noise, round(seconds * RATE_HZ))
    for _ in range(CHUNK // AXES):
        yield records.simulate_six(rng)


def wilson_interval(covered: float, total: float) -> tuple[float, float]:
    """Return the 95 % interval of a share (Wilson 1927).

    >>> lo, hi = wilson_interval(950, 1000)
    >>> print(f"{lo:.3f} {hi:.3f}")
    0.935 0.962
    """
    z2 = float(ndtri(0.975)) ** 2
    centre = (covered + 0.5 * z2) / (total + z2)
    reach = np.sqrt(z2 * (covered * (total - covered) / total + 0.25 * z2)) / (total + z2)
    return float(centre - reach), float(centre + reach)


def run_experiment(
    name: str,
    description: str,
    cells: Mapping[str, Noise],
    lengths: Sequence[int],
    count: Callable[[str, int, int, int], Chunk],
    tables: Callable[[list[Chunk]], str],
) -> None:
    """Run the command line of an experiment: compute the missing chunks of the file, then print the tables.

    ``count(cell, seconds, seed, chunk)`` returns the counts of a chunk. ``tables`` returns the tables of all chunks in
    Markdown. ``--page`` writes them between the comments ``<!-- name -->`` and ``<!-- end of name -->``.
    """
    arguments = _arguments(description, cells, lengths)
    lines = arguments.json.read_text("utf-8").splitlines() if arguments.json and arguments.json.exists() else []
    chunks: list[Chunk] = [json.loads(line) for line in lines]
    done = {(c["cell"], c["seconds"], c["seed"], c["chunk"]) for c in chunks}
    wanted = [
        (cell, seconds, arguments.seed, chunk)
        for chunk in range(-(-arguments.records // CHUNK))  # an interrupted run has equally many of each cell
        for seconds in arguments.seconds
        for cell in arguments.cells
    ]
    for key in wanted:
        if key in done:
            continue
        start = time.process_time()
        result = dict(zip(("cell", "seconds", "seed", "chunk"), key, strict=True)) | {"records": CHUNK} | count(*key)
        result["cpu_s"] = round(time.process_time() - start, 2)
        chunks.append(result)
        print(f"{key[0]}, {key[1]} s, chunk {key[3]}: {result['cpu_s']} s", file=sys.stderr, flush=True)
        if arguments.json:
            with arguments.json.open("a", encoding="utf-8") as file:
                file.write(json.dumps(result) + "\n")
    text = tables(chunks)
    print(text)
    if arguments.page:
        arguments.page.write_text(_replace_section(arguments.page.read_text("utf-8"), name, text), "utf-8")


def _replace_section(page: str, name: str, text: str) -> str:
    """Replace the text between the two comments of this name in a page.

    >>> _replace_section("a <!-- x -->old<!-- end of x --> b", "x", "new")
    'a <!-- x -->\\n\\nnew\\n\\n<!-- end of x --> b'
    """
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    before, rest = page.split(begin)
    return f"{before}{begin}\n\n{text}\n\n{end}{rest.split(end)[1]}"


def _arguments(description: str, cells: Mapping[str, Noise], lengths: Sequence[int]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "--records", type=int, default=1000, help="records of each cell; 0 = print the tables of --json only"
    )
    parser.add_argument("--cells", nargs="+", default=list(cells), choices=list(cells), metavar="CELL")
    parser.add_argument("--seconds", nargs="+", type=int, default=list(lengths), help="lengths of the records")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--json", type=Path, help="file of the counts, with a line for each chunk, which a later run continues"
    )
    parser.add_argument("--page", type=Path, help="a Markdown file to put the tables into")
    return parser.parse_args()


def group_chunks(chunks: list[Chunk]) -> dict[tuple[int, str], list[Chunk]]:
    """Group chunks by (seconds, cell), in ascending order of the lengths."""
    groups: dict[tuple[int, str], list[Chunk]] = {}
    for chunk in sorted(chunks, key=lambda c: int(c["seconds"])):
        groups.setdefault((chunk["seconds"], chunk["cell"]), []).append(chunk)
    return groups


def format_length(seconds: int) -> str:
    """Return a length of time as text."""
    return NAMES.get(seconds, f"{seconds} s")


def format_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
