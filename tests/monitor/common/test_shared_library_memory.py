"""Test of the release of the pages of a shared library."""

import re
import subprocess
import sys

PROGRAM = """
import re
from pathlib import Path
from monitor.common import shared_library_memory
from monitor.estimation.estimator import Estimator
from drivers.data_types import make_block
import numpy as np

def resident_kb():
    smaps = Path("/proc/self/smaps").read_text()
    found = re.findall(r"^\\\\w+-\\\\w+ .*/libllvmlite.*\\n(?:\\\\w+: .*\\n)*?Rss: +(\\\\d+) kB", smaps, re.M)
    return sum(map(int, found))

def estimate():
    estimator = Estimator(100.0, 1.0)
    estimator.add_samples(make_block(np.arange(100), np.random.default_rng(1).standard_normal((100, 6))))
    return estimator.get_estimate().curve.avar.tobytes()

first, before = estimate(), resident_kb()
shared_library_memory.release_library_pages(shared_library_memory.LLVM_LIBRARY)
after = resident_kb()
assert estimate() == first
import numba
assert numba.njit(lambda x: x + 1)(1) == 2  # the compiler works with released pages
print(before, after)
"""


def test_kernels_and_compiler_work_after_the_release() -> None:
    run = subprocess.run(
        [sys.executable, "-c", PROGRAM.replace("\\\\", "\\")], capture_output=True, text=True, check=True
    )
    before, after = map(int, re.findall(r"\d+", run.stdout))
    assert before > 20_000
    assert after < 0.3 * before
