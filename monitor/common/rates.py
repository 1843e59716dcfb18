"""Formatting of rates for text: °/s for gyroscopes, mg or m/s² for accelerometers, two digits, no exponent.

Numbers in messages to programs are in SI units; this module is only for people. 1 g = 9.80665 m/s² (CGPM 1901).
"""

from math import degrees
from typing import Final

import numpy as np

from drivers.units import G0

MILLI_G: Final = 1e-3 * G0
"""One thousandth of standard gravity, in m/s²."""


def format_rate(axis: str, si: float, sign: bool = False) -> str:
    """Format a rate with its unit.

    Parameters
    ----------
    axis : str
        Axis of ``AXES``.
    si : float
        Rate in rad/s or m/s².
    sign : bool, optional
        True if positive values get a sign, as for a difference.

    Examples
    --------
    >>> format_rate("gz", 2.79), format_rate("ax", -0.0324, sign=True), format_rate("az", 27.0), format_rate("gx", 1e-6)
    ('160 °/s', '-3.3 mg', '27 m/s²', '0.000057 °/s')
    """
    if axis.startswith("g"):
        return f"{plain(degrees(si), sign)} °/s"
    if abs(si) < 1000.0 * MILLI_G:
        return f"{plain(si / MILLI_G, sign)} mg"
    return f"{plain(si, sign)} m/s²"


def plain(value: float, sign: bool = False) -> str:
    """Format a number with two significant digits and without an exponent.

    Parameters
    ----------
    value : float
        Number to format.
    sign : bool, optional
        True if positive values get a sign.
    """
    return np.format_float_positional(float(f"{value:.1e}"), trim="-", sign=sign)
