"""Decorators that compile numerical functions (kernels) with Numba and cache the machine code on disk.

Without a writable cache folder, kernels are compiled at every start of the program.

A cached kernel becomes invalid if the source file of the kernel or any imported module changes.

By default, Numba generates machine code for every function that a kernel calls, even if Python never calls the
function. ``Kernel`` keeps such functions as intermediate code, which shortens the first start by more than a quarter
(``docs/measurements/benchmarks-service.md``).

Kernels copy array fields of a NamedTuple to local variables before a loop, because Numba counts a reference at each
access to a field.

``interpret_uncompiled_kernels`` runs kernels in the Python interpreter during compilation.
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
from numpy.typing import NDArray

_masked = "scipy" not in sys.modules
if _masked:
    # no kernel needs scipy.linalg, which Numba imports if SciPy is installed (17 MB of memory)
    sys.modules["scipy"] = None  # type: ignore[assignment]
try:
    import numba.np.arraymath
    from numba import _dynfunc, types
    from numba.core.codegen import JITCodeLibrary
    from numba.core.compiler import Compiler
    from numba.core.registry import CPUDispatcher
    from numba.extending import lower_builtin, type_callable
finally:
    if _masked:
        del sys.modules["scipy"]

P = ParamSpec("P")
R = TypeVar("R")
A = TypeVar("A")

PACKAGE_ROOT: Final = Path(__file__).parents[2]
IDENTIFIER: Final = re.compile(r"\w+")
"""Regular expression for a name in a list of imported names."""
IMPORT_STATEMENT: Final = re.compile(r"^ *from (monitor[\w.]*) import (?:\(([^)]*)\)|(.*))", re.MULTILINE)
"""Regular expression for an import from a module of the package, with names in parentheses or on one line."""


class _IntermediateLibrary(JITCodeLibrary):  # type: ignore[misc]
    """LLVM module without machine code, which is linked into other modules."""

    def _optimize_final_module(self) -> None: ...

    def _finalize_final_module(self) -> None:
        self._finalized = True


class _IntermediateCompiler(Compiler):  # type: ignore[misc]
    def __init__(self, typing_context: Any, target_context: Any, library: Any, *more: Any) -> None:
        library = _IntermediateLibrary(target_context.codegen(), "intermediate")
        super().__init__(typing_context, target_context, library, *more)
        self.state.targetctx.get_executable = _without_machine_code  # this context serves only this compilation


def _without_machine_code(library: Any, description: Any, environment: Any) -> Any:
    """Return a placeholder that represents the compiled function inside Numba. The placeholder must never be called."""
    library._ensure_finalized()  # noqa: SLF001
    return _dynfunc.make_function(description.lookup_module(), description.qualname, "", 0, environment, (library,))


class _IntermediateDispatcher(CPUDispatcher):  # type: ignore[misc]
    """Numba dispatcher that compiles a function to intermediate code for calls from other kernels."""

    def __init__(self, function: Callable[..., Any], options: dict[str, bool | str]) -> None:
        super().__init__(function, targetoptions=options, pipeline_class=_IntermediateCompiler)

    def __call__(self, *_: object) -> Any:
        raise TypeError(f"{self.py_func.__name__} is intermediate code, which only other kernels can call")


class Kernel(CPUDispatcher):  # type: ignore[misc]
    """Numba dispatcher that compiles a function at the first call from Python or from another kernel.

    ``signatures`` lists the compiled argument types for calls from Python, and ``intermediate.signatures`` for calls
    from other kernels.

    Parameters
    ----------
    function : callable
        Python function to compile.
    inline : bool
        True if LLVM must inline the function into every calling kernel.
    """

    def __init__(self, function: Callable[..., Any], inline: bool) -> None:
        options: dict[str, bool | str] = {
            "nopython": True, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, "forceinline": inline,
        }  # fmt: skip
        super().__init__(function, targetoptions=options)
        self.intermediate = _IntermediateDispatcher(function, options | {"no_cpython_wrapper": True})

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Compile the function for a call from another kernel. Numba calls this method during type inference.

        Constant arguments are treated as variables, so that the function is compiled only once for all constants.
        """
        kws = {name: types.unliteral(one) for name, one in kws.items()}
        return self.intermediate.get_call_template([types.unliteral(one) for one in args], kws)

    def get_overload(self, sig: Any) -> Any:
        """Return the function that ``get_call_template`` compiled. Numba calls this method during code generation."""
        return self.intermediate.get_overload(sig)

    def _compile_for_args(self, *args: Any, **kws: Any) -> Any:
        """Return the function to call. Numba calls this method if no machine code for the argument types is loaded."""
        if _interprets.get():
            return self.py_func
        return super()._compile_for_args(*args, **kws)

    def compile(self, sig: Any) -> Any:
        """Compile the function for a call from Python, or load cached machine code."""
        with _no_garbage_collection():
            return super().compile(sig)


_interprets = ContextVar("interprets", default=False)  # each thread has its own


@contextlib.contextmanager
def interpret_uncompiled_kernels() -> Iterator[None]:
    """Run uncompiled kernels in the Python interpreter in the current thread.

    Interpreted kernels are about a hundred times slower than compiled kernels. The results agree except for the last
    digit of exponentials.
    """
    token = _interprets.set(True)
    try:
        with np.errstate(all="ignore"):  # compiled code does not report NaN and overflow either
            yield
    finally:
        _interprets.reset(token)


@contextlib.contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """Pause the garbage collector, which would take a tenth of the compilation time and free almost no memory."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function with Numba in nopython mode. Fast-math is off, because compensated sums need a fixed order."""
    return _cached(Kernel(function, inline=False), function)


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function with Numba, and inline the function into every calling kernel.

    The decorator is for bodies of inner loops that are too long for automatic inlining by LLVM.
    """
    return _cached(Kernel(function, inline=True), function)


def _cached(kernel: Kernel, function: Callable[P, R]) -> Callable[P, R]:
    """Enable the disk cache of a kernel if a cache folder is writable."""
    with contextlib.suppress(RuntimeError):  # no cache folder can be written
        kernel.enable_caching()
        kept = cast("Any", kernel)._cache._cache_file  # noqa: SLF001
        # Numba compares the version before reading the index, which may refer to types that no longer exist
        kept._version = f"{kept._version} {hash_module_with_imports(Path(inspect.getfile(function)))}"  # noqa: SLF001
    return cast("Callable[P, R]", kernel)


def as_read_only(values: NDArray[Any]) -> NDArray[Any]:
    """Return a read-only view.

    Numba compiles a kernel separately for writable and for read-only arrays, such as the columns of a file. A kernel
    that gets only read-only views is compiled once.

    >>> as_read_only(np.zeros(2)).flags.writeable
    False
    """
    view = values.view()
    view.flags.writeable = False
    return view


def without_reference_count(array: A) -> A:
    """Return an array whose slices change no reference count, which saves 10 ns for each slice in a kernel.

    The caller of the kernel must keep the array alive.
    """
    return array


@type_callable(without_reference_count)  # type: ignore[untyped-decorator]
def _infer_type(_context: Any) -> Callable[[Any], Any]:
    return lambda array: array


@lower_builtin(without_reference_count, types.Array)  # type: ignore[untyped-decorator]
def _remove_owner(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    array = context.make_array(signature.return_type)(context, builder, arguments[0])
    array.meminfo = context.get_constant_null(types.MemInfoPointer(signature.return_type.dtype))
    array.parent = context.get_constant_null(types.pyobject)
    return array._getvalue()  # noqa: SLF001


def kernel_cache_folder() -> Path | None:
    """Return the cache folder of compiled kernels, or None if no cache folder is writable."""
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
    """Return a hash of a Python file and of all imported modules of this program, including indirect imports.

    Parameters
    ----------
    path : Path
        Python file.
    root : Path, optional
        Folder that contains the package.

    Returns
    -------
    str
        SHA-256 hash in hexadecimal notation.
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
