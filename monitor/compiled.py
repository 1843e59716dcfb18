"""One decorator for every kernel: compiled by Numba at first call, cached on disk, without the GIL.

Where nothing can be kept on disk (a read-only system, a user without a home) it is compiled at every start.

Before it takes cached code Numba asks only whether the kernel's own file has changed; but what the kernel calls from
other files, and their constants, are compiled into it. So here the stamp of the cache covers all that a file imports.
"""

import contextlib
import inspect
import os
import re
import sys
from collections.abc import Callable
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, Final, ParamSpec, TypeVar, cast

_masked = "scipy" not in sys.modules
if _masked:
    # Numba imports scipy.linalg if it is installed: 17 MB that no kernel here uses
    sys.modules["scipy"] = None  # type: ignore[assignment]
try:
    import numba
    import numba.np.arraymath
finally:
    if _masked:
        del sys.modules["scipy"]

P = ParamSpec("P")
R = TypeVar("R")

ROOT: Final = Path(__file__).parents[1]
NAME: Final = re.compile(r"\w+")
IMPORTS: Final = re.compile(r"^from (monitor[\w.]*) import (?:\(([^)]*)\)|(.*))", re.MULTILINE)


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile in nopython mode. No fast-math: compensated sums must keep their order."""
    kernel = numba.njit(nogil=True, error_model="numpy")(function)
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
