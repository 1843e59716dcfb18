"""Amounts of a rate in sentences: °/s for gyroscopes, mg or m/s² for accelerometers, two digits, no exponents.

What leaves as a number is SI; this is for people. 1 g = 9.80665 m/s² (CGPM 1901).
"""

from math import degrees
from typing import Final

import numpy as np

MILLI_G: Final = 9.80665e-3
"""m/s²"""


def amount(axis: str, si: float, sign: bool = False) -> str:
    """A rate on an axis of ``AXES``, SI, in the field's unit; ``sign``: a difference.

    >>> amount("gz", 2.79), amount("ax", -0.0324, sign=True), amount("az", 27.0), amount("gx", 1e-6)
    ('160 °/s', '-3.3 mg', '27 m/s²', '0.000057 °/s')
    """
    if axis.startswith("g"):
        return f"{plain(degrees(si), sign)} °/s"
    if abs(si) < 1000.0 * MILLI_G:
        return f"{plain(si / MILLI_G, sign)} mg"
    return f"{plain(si, sign)} m/s²"


def plain(value: float, sign: bool = False) -> str:
    """Two significant digits, no exponent."""
    return np.format_float_positional(float(f"{value:.1e}"), trim="-", sign=sign)
