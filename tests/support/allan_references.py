"""Published data with known Allan deviations."""

import csv
import gzip
from pathlib import Path

import numpy as np

from drivers.data_types import Floats


def nist_1000() -> Floats:
    """Return the 1000 points of NIST SP 1065, section 12.4, from a prime-modulus generator."""
    n, points = 1234567890, []
    for _ in range(1000):
        points.append(n / 2147483647)
        n = 16807 * n % 2147483647
    return np.array(points)


def columns(path: Path, *names: str) -> list[Floats]:
    """Return columns of a CSV file, which may be compressed by gzip."""
    with gzip.open(path, "rt") if path.suffix == ".gz" else path.open() as stream:
        rows = list(csv.DictReader(stream))
    return [np.array([float(row[name]) for row in rows]) for name in names]


def mean_squares_with_gaps(y: Floats, m: int) -> tuple[float, int, float]:
    """Return half the mean square of the differences that count, their number, and the mean of ½(1/n_A + 1/n_B) − 1/m.

    Clusters of m samples are formed one by one. A difference counts if 60 % of each cluster are present.
    """
    squares, shares = [], []
    for k in range(len(y) - 2 * m + 1):
        older, newer = (part[np.isfinite(part)] for part in (y[k : k + m], y[k + m : k + 2 * m]))
        if 10 * min(older.size, newer.size) >= 6 * m:
            squares.append((newer.mean() - older.mean()) ** 2)
            shares.append(0.5 * (1.0 / older.size + 1.0 / newer.size) - 1.0 / m)
    return (0.5 * float(np.mean(squares)), len(squares), float(np.mean(shares))) if squares else (np.nan, 0, np.nan)


def avar_with_gaps(y: Floats, m: int) -> float:
    """Return the Allan variance of rates with missing samples (NaN), corrected for the samples that are missing.

    The variance within clusters follows from the corrected Allan variances at 1, 2, 4, … samples, and is interpolated
    over the logarithm of m.
    """
    sigma2: list[float] = []  # corrected Allan variances at the powers of two

    def within(octave: int) -> float:
        size = 2.0**octave
        return size / (size - 1.0) * sum(sigma2[:octave]) / 2.0 if octave else 0.0

    for octave in range(int(m).bit_length()):
        raw, _, share = mean_squares_with_gaps(y, 2**octave)
        sigma2.append(raw - share * within(octave))
    octave = int(m).bit_length() - 1
    if m == 2**octave:
        return sigma2[octave]
    part = np.log2(m) - octave
    raw, _, share = mean_squares_with_gaps(y, m)
    return raw - share * ((1.0 - part) * within(octave) + part * within(octave + 1))
