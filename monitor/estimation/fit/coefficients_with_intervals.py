"""Noise coefficients of IEEE Std 952 for six axes, each with a confidence interval and a status."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.data_types import Floats

SYMBOLS: Final = ("Q", "N", "B", "K", "R")
"""Symbols of quantization noise, angle random walk, bias instability, rate random walk and rate ramp."""


class Status(IntEnum):
    """Status of a noise coefficient."""

    UNESTIMATED = 0  # not known, for example because of too little data; value, lo and hi are NaN
    UPPER_BOUND = 1  # only an upper bound is known; value is NaN, lo is 0, hi is the one-sided 95 % upper bound
    ESTIMATED = 2  # the value and the two-sided 95 % confidence interval are known


@dataclass(frozen=True, slots=True)
class Coefficients:
    """Noise coefficients of six axes with 95 % confidence intervals, in SI units (rad, m, s).

    The rows are in the order Q, N, B, K, R, and the columns in the order gx, gy, gz, ax, ay, az.
    """

    value: Floats  # [5, 6] NaN unless the status is ESTIMATED
    lo: Floats  # [5, 6] lower end of the 95 % confidence interval
    hi: Floats  # [5, 6] upper end of the 95 % confidence interval
    status: NDArray[np.int8]  # [5, 6] values of ``Status``
