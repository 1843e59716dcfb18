"""Compilation of the numerical kernels before the first test.

Numba compiles a kernel at its first call, which takes minutes on a loaded machine, and keeps the result in a cache on
disk. The kernels are compiled in the process that starts the tests, before any test and outside every time limit. The
workers of pytest-xdist and the processes that tests start then load each kernel from the cache at its first call.
"""

from collections.abc import Callable

from monitor.daemon.kernels import kernel_compilation, kernel_groups
from tests.monitor.publishing.example_results import make_total_and_hadamard_curves


def compile_kernels(say: Callable[[str], None]) -> None:
    """Compile the kernels that a running service and the analysis need, if the cache on disk does not contain them.

    Parameters
    ----------
    say
        Called with a line for each part that is being compiled.
    """
    for group in kernel_groups.GROUPS:
        if kernel_compilation.is_warm(group):
            continue
        for _ in kernel_compilation.prepare_kernels(group, lambda progress: say(str(progress))):
            pass
        make_total_and_hadamard_curves()  # otherwise, every worker would compile their kernels while it collects tests
