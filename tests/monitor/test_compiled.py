"""Kernels are compiled where nothing can be kept on disk, too; what is kept is not taken when it is stale."""

import inspect
import subprocess
import sys
import textwrap
from pathlib import Path

import monitor.compiled
from monitor.compiled import IMPORTS, stamp
from monitor.estimate import fit_kernel
from tests.support.waiting import PATIENCE_S


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
    subprocess.run([sys.executable, "-c", textwrap.dedent(program)], cwd=root, timeout=PATIENCE_S, check=True)


def test_cached_code_is_stale_when_what_it_calls_has_changed(tmp_path):
    files = {name: tmp_path / "monitor" / f"{name}.py" for name in "abcdef"}
    files["a"].parent.mkdir()
    files["a"].write_text("from monitor.b import called\n")
    files["b"].write_text("import math\nfrom monitor.c import LIMIT\nfrom monitor.a import other\n")
    files["c"].write_text("from monitor import e\nfrom monitor import (\n    f,\n)\nLIMIT = 1.0\n")
    files["e"].write_text("x = 1\n")
    files["f"].write_text("x = 1\n")
    files["d"].write_text("x = 1\n")

    def now():
        stamp.cache_clear()
        return stamp(files["a"], tmp_path)

    before = now()
    files["d"].write_text("x = 2\n")
    assert now() == before
    for name in "fec":  # modules that are imported by name, too
        files[name].write_text("LIMIT = 2.0\n")
        assert now() != before
        before = now()


def test_the_stamp_of_a_kernel_covers_the_files_it_calls():
    imported = [package for package, *_ in IMPORTS.findall(Path(inspect.getfile(fit_kernel)).read_text())]
    assert imported.count("monitor.estimate.verdict") == 1
    assert fit_kernel.fit_axes._cache._cache_file._source_stamp[1] == stamp(Path(inspect.getfile(fit_kernel)))
