"""Published data with known Allan deviations."""

import csv
import gzip
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from drivers.data_types import Floats, Ints


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


def variance_within_clusters_with_gaps(y: Floats, m: int) -> float:
    """Return the mean variance within clusters of m samples, from the corrected Allan variances at 1, 2, 4, … samples.

    The variance is interpolated over the logarithm of m. White noise is assumed where no difference counts.
    """
    sigma2: list[float] = []  # corrected Allan variances at the powers of two
    within = [0.0]
    for octave in range(int(m - 1).bit_length()):
        raw, count, share = mean_squares_with_gaps(y, 2**octave)
        sigma2.append(raw - share * within[octave] if count or not octave else sigma2[-1] / 2.0)
        within.append(2.0 ** (octave + 1) / (2.0 ** (octave + 1) - 1.0) * sum(sigma2) / 2.0)
    return float(np.interp(np.log2(m), np.arange(len(within)), within))


def avar_with_gaps(y: Floats, m: int) -> float:
    """Return the Allan variance of rates with missing samples (NaN), corrected for the samples that are missing."""
    raw, _, share = mean_squares_with_gaps(y, m)
    return raw - share * variance_within_clusters_with_gaps(y, m)


def mean_square_of_contrasts_with_gaps(
    y: Floats, contrasts: Sequence[Sequence[Ints]], weights: Sequence[float]
) -> tuple[float, int, float]:
    """Return the mean square of the differences that count, their number, and their mean excess for white noise.

    A difference is the weighted sum of the means of clusters, which are given as arrays of sample numbers. A sample may
    occur several times. The excess is the variance of the difference for white noise of unit variance, minus the
    variance if no samples are missing.
    """
    squares, excess = [], []
    for clusters in contrasts:
        parts = [own[np.isfinite(y[own])] for own in clusters]
        if all(10 * part.size >= 6 * own.size for part, own in zip(parts, clusters, strict=True)):
            squares.append(sum(w * y[part].mean() for w, part in zip(weights, parts, strict=True)) ** 2)
            variances = []
            for chosen in (parts, clusters):
                of_samples = np.zeros(len(y))
                for w, part in zip(weights, chosen, strict=True):
                    np.add.at(of_samples, part, w / part.size)
                variances.append(np.sum(of_samples**2))
            excess.append(variances[0] - variances[1])
    return (float(np.mean(squares)), len(squares), float(np.mean(excess))) if squares else (np.nan, 0, 0.0)
