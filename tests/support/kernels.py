"""Compilation of the numerical kernels before the first test.

Numba compiles a kernel at its first call, which takes minutes on a loaded machine, and keeps the result in a cache on
disk. The kernels are compiled in the process that starts the tests, before any test and outside every time limit. The
workers of pytest-xdist and the processes that tests start then load them from the cache.
"""

from monitor.drift import compensator, heat
from monitor.estimate.estimator import warm_up


def compile_kernels() -> None:
    """Compile the kernels that a running service needs, or load them from the cache on disk."""
    for _ in warm_up():
        pass
    heat.warm_up()
    compensator.warm_up()
