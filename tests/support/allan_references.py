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
