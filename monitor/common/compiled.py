"""Decorators for numerical kernels: compile with Numba at the first call, cache on disk, release the GIL.

If no cache folder can be written (a read-only system, a user without a home folder), kernels are compiled at every
start.

Before loading cached code, Numba only checks whether the file of the kernel has changed. A kernel also contains
functions and constants from other files. The version of the cache therefore covers all imported files.

By default, Numba generates machine code for each kernel, and again for the copy of the kernel inside every calling
kernel. LLVM would compile a function at the fifth level of calls five times. ``Kernel`` therefore keeps a function that
other kernels call as intermediate code. This code is optimised once, as a part of the kernel that Python calls. The
first start takes more than a quarter less time (``docs/benchmarks-service.md``). The machine code of the outer kernels
does not change.

Kernels receive and return NamedTuples of arrays. In a loop, array fields are first copied to local names, because Numba
counts a reference at each access to a field.

Until the kernels are compiled, a thread can run them in the Python interpreter (``interpret_uncompiled_kernels``).
"""

import contextlib
import gc
import inspect
import os
import re
import sys
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, Final, ParamSpec, TypeVar, cast

import numpy as np

_masked = "scipy" not in sys.modules
if _masked:
    # Numba imports scipy.linalg if SciPy is installed. The import takes 17 MB, and no kernel of the program uses it.
    sys.modules["scipy"] = None  # type: ignore[assignment]
try:
    import numba.np.arraymath
    from numba import _dynfunc, types
    from numba.core.codegen import JITCodeLibrary
    from numba.core.compiler import Compiler
    from numba.core.registry import CPUDispatcher
finally:
    if _masked:
        del sys.modules["scipy"]

P = ParamSpec("P")
R = TypeVar("R")

PACKAGE_ROOT: Final = Path(__file__).parents[2]
IDENTIFIER: Final = re.compile(r"\w+")
"""Regular expression for a name in a list of imported names."""
IMPORT_STATEMENT: Final = re.compile(r"^ *from (monitor[\w.]*) import (?:\(([^)]*)\)|(.*))", re.MULTILINE)
"""Regular expression for an import from a module of the package, with names in parentheses or on one line."""


class _IntermediateLibrary(JITCodeLibrary):  # type: ignore[misc]
    """LLVM module that is only linked into other modules. It is neither optimised as a whole nor translated to machine
    code."""

    def _optimize_final_module(self) -> None: ...

    def _finalize_final_module(self) -> None:
        self._finalized = True


class _IntermediateCompiler(Compiler):  # type: ignore[misc]
    """Compiler that compiles a function to an ``_IntermediateLibrary``."""

    def __init__(self, typing_context: Any, target_context: Any, library: Any, *more: Any) -> None:
        library = _IntermediateLibrary(target_context.codegen(), "intermediate")
        super().__init__(typing_context, target_context, library, *more)
        self.state.targetctx.get_executable = _without_machine_code  # this context serves only this compilation


def _without_machine_code(library: Any, description: Any, environment: Any) -> Any:
    """Return a placeholder object that identifies the compiled function inside Numba and must never be called."""
    library._ensure_finalized()  # noqa: SLF001
    return _dynfunc.make_function(description.lookup_module(), description.qualname, "", 0, environment, (library,))


class _IntermediateDispatcher(CPUDispatcher):  # type: ignore[misc]
    """Dispatcher that compiles a function for calls from other kernels."""

    def __init__(self, function: Callable[..., Any], options: dict[str, bool | str]) -> None:
        super().__init__(function, targetoptions=options, pipeline_class=_IntermediateCompiler)

    def __call__(self, *_: object) -> Any:
        """Raise TypeError, because there is no machine code to call."""
        raise TypeError(f"{self.py_func.__name__} is intermediate code, which only other kernels can call")


class Kernel(CPUDispatcher):  # type: ignore[misc]
    """Dispatcher that compiles a function at its first call from Python, or as a part of a kernel that calls it.

    ``signatures`` lists the argument types for which the function has been compiled to be called from Python.
    ``intermediate.signatures`` lists the argument types for which it has become a part of other kernels.

    Parameters
    ----------
    function : callable
        Python function to compile.
    inline : bool
        True if LLVM must copy the function into every kernel that calls it.
    """

    def __init__(self, function: Callable[..., Any], inline: bool) -> None:
        options: dict[str, bool | str] = {
            "nopython": True, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, "forceinline": inline,
        }  # fmt: skip
        super().__init__(function, targetoptions=options)
        self.intermediate = _IntermediateDispatcher(function, options | {"no_cpython_wrapper": True})

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Compile for a call from another kernel. Numba calls this method when it infers the types of that kernel.

        Constant arguments are treated like variables of the same type, so the function is compiled once for all
        constants.
        """
        kws = {name: types.unliteral(one) for name, one in kws.items()}
        return self.intermediate.get_call_template([types.unliteral(one) for one in args], kws)

    def get_overload(self, sig: Any) -> Any:
        """Return the function that ``get_call_template`` compiled. Numba calls this method to lower the calling
        kernel."""
        return self.intermediate.get_overload(sig)

    def _compile_for_args(self, *args: Any, **kws: Any) -> Any:
        """Return the function to call. Numba calls this method if no machine code for the types of the arguments is
        loaded."""
        if _interprets.get():
            return self.py_func
        return super()._compile_for_args(*args, **kws)

    def compile(self, sig: Any) -> Any:
        """Compile for a call from Python, or load the machine code from the cache on disk."""
        with _no_garbage_collection():
            return super().compile(sig)


_interprets = ContextVar("interprets", default=False)  # each thread has its own


@contextlib.contextmanager
def interpret_uncompiled_kernels() -> Iterator[None]:
    """Run kernels that are not compiled yet in the Python interpreter, in this thread.

    The results agree except for the last digit of exponentials. A call takes about a hundred times as long as compiled
    code, but need not wait for the compiler. Compiled kernels are not affected.
    """
    token = _interprets.set(True)
    try:
        with np.errstate(all="ignore"):  # compiled code does not report NaN and overflow either
            yield
    finally:
        _interprets.reset(token)


@contextlib.contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """Pause the garbage collector, which takes a tenth of the compilation time and frees almost nothing."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function in nopython mode, without fast-math, because compensated sums must keep their order."""
    return _cached(Kernel(function, inline=False), function)


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function as ``compiled`` does, and make LLVM copy it into every kernel that calls it.

    Use this decorator for the body of an inner loop that is too long for LLVM to inline automatically.
    """
    return _cached(Kernel(function, inline=True), function)


def _cached(kernel: Kernel, function: Callable[P, R]) -> Callable[P, R]:
    """Enable the cache on disk for a kernel, if a cache folder can be written."""
    with contextlib.suppress(RuntimeError):  # no cache folder can be written
        kernel.enable_caching()
        kept = cast("Any", kernel)._cache._cache_file  # noqa: SLF001
        # Numba compares the version before it reads the index, which may name types that no longer exist
        kept._version = f"{kept._version} {hash_module_with_imports(Path(inspect.getfile(function)))}"  # noqa: SLF001
    return cast("Callable[P, R]", kernel)


def kernel_cache_folder() -> Path | None:
    """Return the folder of compiled kernels on this machine; None if no such folder can be written."""
    kernel: Any = numba.njit(_nothing)
    try:
        kernel.enable_caching()
        folder = Path(kernel._cache.cache_path)  # noqa: SLF001
        folder.mkdir(parents=True, exist_ok=True)
    except (RuntimeError, OSError):
        return None
    return folder if os.access(folder, os.W_OK) else None


def _nothing() -> None: ...


@cache
def hash_module_with_imports(path: Path, root: Path = PACKAGE_ROOT) -> str:
    """Return a hash of a file and of all modules of this program that it imports, directly or through others.

    Parameters
    ----------
    path : Path
        Python file.
    root : Path, optional
        Folder that contains the package.

    Returns
    -------
    str
        SHA-256 of the contents, in hexadecimal.
    """
    texts: dict[Path, bytes] = {}
    left = [path]
    while left:
        one = left.pop()
        if one not in texts and one.is_file():
            texts[one] = one.read_bytes()
            for package, listed, plain in IMPORT_STATEMENT.findall(texts[one].decode()):
                place = root / package.replace(".", "/")
                left.append(place.with_suffix(".py"))
                left += [place / f"{name}.py" for name in IDENTIFIER.findall(listed or plain)]  # names of modules
    return sha256(b"\0".join(texts[one] for one in sorted(texts))).hexdigest()
