"""Tests of the compilation of kernels and of their cache on disk."""

import gc
import inspect
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

import monitor.common.compiled
from monitor.common.compiled import IMPORT_STATEMENT, Kernel, compiled, hash_module_with_imports
from monitor.estimation.fit import fit_kernel
from tests.support.waiting import PATIENCE_S


@pytest.mark.long
def test_kernel_is_compiled_without_a_cache_folder() -> None:
    program = """
        from numba.core import caching
        caching.CompileResultCacheImpl._locator_classes = []  # as on a read-only system without a home folder
        from monitor.common.compiled import compiled

        @compiled
        def twice(x):
            return x + x

        assert twice(21) == 42
        assert twice.nopython_signatures
    """
    root = Path(monitor.common.compiled.__file__).parents[2]
    subprocess.run([sys.executable, "-c", textwrap.dedent(program)], cwd=root, timeout=PATIENCE_S, check=True)


def test_cache_is_invalid_after_a_change_of_an_imported_module(tmp_path):
    files = {name: tmp_path / "monitor" / f"{name}.py" for name in "abcdef"}
    files["a"].parent.mkdir()
    files["a"].write_text("from monitor.b import called\n")
    files["b"].write_text("import math\nfrom monitor.c import LIMIT\nfrom monitor.a import other\n")
    files["c"].write_text("from monitor import e\nfrom monitor import (\n    f,\n)\nLIMIT = 1.0\n")
    files["e"].write_text("x = 1\n")
    files["f"].write_text("x = 1\n")
    files["d"].write_text("x = 1\n")

    def compute_hash():
        hash_module_with_imports.cache_clear()
        return hash_module_with_imports(files["a"], tmp_path)

    before = compute_hash()
    files["d"].write_text("x = 2\n")
    assert compute_hash() == before
    for name in "fec":  # modules that are imported by name, too
        files[name].write_text("LIMIT = 2.0\n")
        assert compute_hash() != before
        before = compute_hash()


def test_cache_version_of_a_kernel_covers_its_imported_files():
    imported = [package for package, *_ in IMPORT_STATEMENT.findall(Path(inspect.getfile(fit_kernel)).read_text())]
    assert imported.count("monitor.estimation.fit.term_selection") == 1
    assert fit_kernel.fit_axes._cache._cache_file._version.endswith(
        hash_module_with_imports(Path(inspect.getfile(fit_kernel)))
    )


def test_cache_with_a_type_of_an_earlier_revision_is_replaced(tmp_path):
    root = Path(monitor.common.compiled.__file__).parents[2]
    revision = """
        from typing import NamedTuple
        from monitor.common.compiled import compiled

        class {0}(NamedTuple):
            left: float

        @compiled
        def double(pair):
            return pair.left + pair.left

        assert double({0}(21.0)) == 42.0
        print(len(double._cache_hits))
    """

    def run_revision(name: str) -> str:
        (tmp_path / "kernels.py").write_text(textwrap.dedent(revision.format(name)))
        command = [sys.executable, "-c", "import kernels"]
        paths = os.pathsep.join((str(tmp_path), str(root)))
        environment = os.environ | {"PYTHONPATH": paths}
        done = subprocess.run(
            command, env=environment, cwd=tmp_path, timeout=PATIENCE_S, check=False, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    assert [run_revision(name) for name in ("Pair", "Pair", "Couple", "Couple")] == ["0", "1", "0", "1"]


def test_machine_code_is_generated_only_for_the_kernel_that_python_calls():
    def sum_from(values, total):
        for value in values:
            total += value
        return total

    add = Kernel(sum_from, inline=False)  # the disk cache would provide only the outer kernel

    def sum_twice(values):
        return add(values, add(values, 0.0))

    add_twice, values = Kernel(sum_twice, inline=False), np.arange(5.0)
    assert add_twice(values) == 20.0
    assert len(add_twice.signatures) == 1
    assert not add.signatures
    assert len(add.intermediate.signatures) == 1
    (whole,), (part,) = add_twice.overloads.values(), add.intermediate.overloads.values()
    engine = whole.library.codegen._engine
    assert engine.is_symbol_defined(whole.fndesc.llvm_cpython_wrapper_name)
    assert not engine.is_symbol_defined(part.fndesc.llvm_cpython_wrapper_name)
    assert add(values, 1.0) == 11.0  # called from Python, it is compiled as a separate kernel
    assert len(add.signatures) == 1


def test_an_inner_function_is_compiled_once_for_all_constant_arguments():
    @compiled
    def scale(x, factor, negative):
        return -factor * x if negative else factor * x

    @compiled
    def outer(x, factor):
        return scale(x, 2, False) + scale(x, 3, True) + scale(x, factor, x > 0.0)

    assert outer(1.0, 5) == 2.0 - 3.0 - 5.0
    assert len(scale.intermediate.signatures) == 1


def test_intermediate_code_refuses_a_call_from_python():
    @compiled
    def half(x):
        return 0.5 * x

    with pytest.raises(TypeError, match="half is intermediate code"):
        half.intermediate(3.0)


def test_an_exception_in_an_inner_function_reaches_python():
    @compiled
    def fill(target, source):
        target[:] = source

    @compiled
    def outer(target, source):
        fill(target, source)

    with pytest.raises(ValueError, match="cannot assign slice of shape"):
        outer(np.zeros(3), np.zeros(4))


def test_the_garbage_collector_runs_again_after_a_compilation():
    @compiled
    def half(x):
        return 0.5 * x

    assert half(3.0) == 1.5
    assert gc.isenabled()
