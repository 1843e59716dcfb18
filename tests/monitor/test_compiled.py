"""Kernels are compiled where nothing can be kept on disk, too."""

import subprocess
import sys
import textwrap
from pathlib import Path

import monitor.compiled


def test_without_a_place_for_the_cache() -> None:
    program = """
        from numba.core import caching
        caching.CompileResultCacheImpl._locator_classes = []  # as of a read-only system and a user without a home
        from monitor.compiled import compiled

        @compiled
        def twice(x):
            return x + x

        assert twice(21) == 42
        assert twice.nopython_signatures
    """
    root = Path(monitor.compiled.__file__).parents[1]
    subprocess.run([sys.executable, "-c", textwrap.dedent(program)], cwd=root, timeout=120, check=True)
