"""Compilation of the numerical kernels before the first test.

Numba compiles a kernel at its first call, which takes minutes on a loaded machine, and keeps the result in a cache on
disk. The kernels are compiled in the process that starts the tests, before any test and outside every time limit. The
workers of pytest-xdist and the processes that tests start then load each kernel from the cache at its first call.

One process needs a quarter less processor time than the child processes of the program, which compile inner functions
again.
"""

import sys
from collections.abc import Callable

from monitor.common.compiled import Kernel
from monitor.daemon.kernels import kernel_compilation, kernel_groups
from tests.monitor.publishing.example_results import make_total_and_hadamard_curves


def compile_kernels(say: Callable[[str], None]) -> None:
    """Compile the kernels that a running service and the analysis need, if the cache on disk does not contain them.

    Parameters
    ----------
    say
        Called with a line for each part that is being compiled.

    Raises
    ------
    AssertionError
        If a kernel is compiled for more than one combination of argument types, which lengthens the first start.
    """
    cold = [group for group in kernel_groups.GROUPS if not kernel_compilation.is_warm(group)]
    for group in cold:
        for _ in kernel_compilation.prepare_kernels(group, lambda progress: say(str(progress)), processes=0):
            signatures = {name: (one.signatures, one.intermediate.signatures) for name, one in find_kernels().items()}
            repeated = {name: both for name, both in signatures.items() if max(map(len, both)) > 1}
            assert not repeated, f"compiled for several argument types: {repeated}"
    if cold:
        make_total_and_hadamard_curves()  # otherwise, every worker would compile their kernels while it collects tests


def find_kernels() -> dict[str, Kernel]:
    """Return the kernels of all imported modules by qualified name."""
    return {
        f"{kernel.__module__}.{kernel.__name__}": kernel
        for module in list(sys.modules.values())
        for kernel in vars(module).values()
        if module.__name__.startswith("monitor.") and isinstance(kernel, Kernel)
    }


if __name__ == "__main__":
    compile_kernels(print)
