"""Compilation of the numerical kernels before the first test.

Numba compiles a kernel at its first call, which takes minutes on a loaded machine, and keeps the result in a cache on
disk. The kernels are compiled in the process that starts the tests, before any test and outside every time limit. The
workers of pytest-xdist and the processes that tests start then load them from the cache.
"""

from collections.abc import Callable

from monitor.daemon.kernels import kernel_compilation, kernel_groups


def compile_kernels(say: Callable[[str], None]) -> None:
    """Compile the kernels that a running service and the analysis need, or load them from the cache on disk.

    Parameters
    ----------
    say
        Called with a line for each part that is being compiled.
    """
    for group in kernel_groups.GROUPS:
        for _ in kernel_compilation.prepare_kernels(group, lambda progress: say(str(progress))):
            pass
