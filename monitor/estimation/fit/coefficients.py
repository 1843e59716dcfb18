"""The five coefficients of IEEE Std 952 for six axes, each with an interval and a status."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.sample import Floats

LETTERS: Final = ("Q", "N", "B", "K", "R")


class Status(IntEnum):
    """What a coefficient's number is worth; a number without a status is not published."""

    UNESTIMATED = 0  # too few data yet, or withheld: value, lo and hi are NaN
    UPPER_BOUND = 1  # the data only bound it: value NaN, lo 0, hi the one-sided 95 % bound
    ESTIMATED = 2  # value with its two-sided 95 % interval


@dataclass(frozen=True, slots=True)
class Coefficients:
    """Rows Q N B K R, columns gx … az, in SI: rad, m, s."""

    value: Floats  # [5, 6]
    lo: Floats  # [5, 6]
    hi: Floats  # [5, 6]
    status: NDArray[np.int8]  # [5, 6] of Status
