"""One decorator for every kernel: compiled by Numba at first call, cached on disk, without the GIL.

Where nothing can be kept on disk (a read-only system, a user without a home) it is compiled at every start.
"""

import contextlib
from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

import numba

P = ParamSpec("P")
R = TypeVar("R")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile in nopython mode. No fast-math: compensated sums must keep their order."""
    kernel = numba.njit(nogil=True, error_model="numpy")(function)
    with contextlib.suppress(RuntimeError):  # no folder for it
        kernel.enable_caching()
    return cast("Callable[P, R]", kernel)
