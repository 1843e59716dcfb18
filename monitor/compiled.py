"""One decorator for every kernel: compiled by Numba at first call, cached on disk, without the GIL.

Where nothing can be kept on disk (a read-only system, a user without a home) it is compiled at every start.

Before it takes cached code Numba asks only whether the kernel's own file has changed; but what the kernel calls from
other files, and their constants, are compiled into it. So here the stamp of the cache covers all that a file imports.

Numba alone optimises each kernel, generates its machine code and makes it callable from Python before another kernel
can call it, and then does the same again for its copy in the calling kernel. A function four calls below the kernel
that Python calls goes through LLVM five times. ``Kernel`` leaves this out: functions that other kernels call remain
intermediate code, which is optimised once, as a part of the kernel that Python calls. This saves more than a quarter of
the time of a first start (``docs/benchmarks.md``). The machine code of the outer kernels is the same.

Until the kernels are compiled, a thread can let Python interpret them (``interpreted``).
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
    # Numba imports scipy.linalg if it is installed: 17 MB that no kernel here uses
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

ROOT: Final = Path(__file__).parents[1]
NAME: Final = re.compile(r"\w+")
IMPORTS: Final = re.compile(r"^ *from (monitor[\w.]*) import (?:\(([^)]*)\)|(.*))", re.MULTILINE)


class IntermediateLibrary(JITCodeLibrary):  # type: ignore[misc]
    """LLVM module that is only linked into others: neither optimised as a whole nor translated to machine code."""

    def _optimize_final_module(self) -> None: ...

    def _finalize_final_module(self) -> None:
        self._finalized = True


class IntermediateCompiler(Compiler):  # type: ignore[misc]
    """Compiles a function to an ``IntermediateLibrary``."""

    def __init__(  # type: ignore[no-untyped-def]
        self, typing_context, target_context, library, args, return_type, flags, local_types
    ) -> None:
        library = IntermediateLibrary(target_context.codegen(), "intermediate")
        super().__init__(typing_context, target_context, library, args, return_type, flags, local_types)
        self.state.targetctx.get_executable = _without_machine_code  # a copy of the context, for this compilation only


def _without_machine_code(library: Any, description: Any, environment: Any) -> Any:
    """Return a function object that identifies the compiled function inside Numba; it must never be called."""
    library._ensure_finalized()  # noqa: SLF001
    return _dynfunc.make_function(description.lookup_module(), description.qualname, "", 0, environment, (library,))


class Intermediate(CPUDispatcher):  # type: ignore[misc]
    """Compiles a function for calls from other kernels."""

    def __init__(self, function: Callable[..., Any], options: dict[str, bool | str]) -> None:
        super().__init__(function, targetoptions=options, pipeline_class=IntermediateCompiler)

    def __call__(self, *_: object) -> Any:
        """Refuse; there is no machine code to call."""
        raise TypeError(f"{self.py_func.__name__} is intermediate code, which only other kernels can call")


class Kernel(CPUDispatcher):  # type: ignore[misc]
    """Function that is compiled at its first call from Python, or as a part of the kernel that calls it.

    ``signatures`` lists the argument types that it has been compiled for to be called from Python,
    ``intermediate.signatures`` those for which it has become a part of other kernels.
    """

    def __init__(self, function: Callable[..., Any], inline: bool) -> None:
        options: dict[str, bool | str] = {
            "nopython": True, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, "forceinline": inline,
        }  # fmt: skip
        super().__init__(function, targetoptions=options)
        self.intermediate = Intermediate(function, options | {"no_cpython_wrapper": True})

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Compile for a call from another kernel; Numba asks this when it infers the types of that kernel.

        A constant argument does not count as a type of its own, so that the function is compiled once for all of them.
        """
        kws = {name: types.unliteral(one) for name, one in kws.items()}
        return self.intermediate.get_call_template([types.unliteral(one) for one in args], kws)

    def get_overload(self, sig: Any) -> Any:
        """Return what ``get_call_template`` compiled; Numba asks this when it lowers the calling kernel."""
        return self.intermediate.get_overload(sig)

    def _compile_for_args(self, *args: Any, **kws: Any) -> Any:
        """Return what is called with arguments of these types; Numba asks this when no machine code is loaded."""
        if _interprets.get():
            return self.py_func
        return super()._compile_for_args(*args, **kws)

    def compile(self, sig: Any) -> Any:
        """Compile for a call from Python, or load from the disk cache."""
        with _no_garbage_collection():
            return super().compile(sig)


_interprets = ContextVar("interprets", default=False)  # each thread has its own


@contextlib.contextmanager
def interpreted() -> Iterator[None]:
    """Let Python interpret the kernels that this thread calls and that are not compiled yet.

    The results are the same but for the last digit of exponentials. A call takes some hundred times as long, but does
    not wait for the compiler. Nothing is slower once the kernel is compiled.
    """
    token = _interprets.set(True)
    try:
        with np.errstate(all="ignore"):  # as in machine code, where NaN and overflow pass in silence
            yield
    finally:
        _interprets.reset(token)


@contextlib.contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """Pause the garbage collector, which takes a tenth of a compilation and finds next to nothing to free."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile in nopython mode. No fast-math: compensated sums must keep their order."""
    return _cached(Kernel(function, inline=False), function)


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Compile as ``compiled`` does, and make LLVM copy the function into every kernel that calls it.

    For the body of an inner loop that LLVM alone holds for too long to copy.
    """
    return _cached(Kernel(function, inline=True), function)


def _cached(kernel: Kernel, function: Callable[P, R]) -> Callable[P, R]:
    """Have machine code of a kernel kept on disk, if there is a folder for it."""
    with contextlib.suppress(RuntimeError):  # no folder for it
        kernel.enable_caching()
        kept = cast("Any", kernel)._cache._cache_file  # noqa: SLF001
        kept._source_stamp = (kept._source_stamp, stamp(Path(inspect.getfile(function))))  # noqa: SLF001
    return cast("Callable[P, R]", kernel)


def cache_folder() -> Path | None:
    """Where this machine keeps compiled kernels; None where it cannot."""
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
def stamp(path: Path, root: Path = ROOT) -> str:
    """Of a file and all that it imports of this package under ``root``, one by the other."""
    texts: dict[Path, bytes] = {}
    left = [path]
    while left:
        one = left.pop()
        if one not in texts and one.is_file():
            texts[one] = one.read_bytes()
            for package, listed, plain in IMPORTS.findall(texts[one].decode()):
                place = root / package.replace(".", "/")
                left.append(place.with_suffix(".py"))
                left += [place / f"{name}.py" for name in NAME.findall(listed or plain)]  # those that are modules
    return sha256(b"\0".join(texts[one] for one in sorted(texts))).hexdigest()
