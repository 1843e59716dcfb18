"""Processor time to compile the kernels: ``python -m tests.experiments.benchmarks.cold_compile``.

The program runs the warm-up of the service in this process with an empty, temporary cache folder. It prints the
processor time until each stage of the warm-up is ready, and the number of compilations and their processor time per
module. The time of a function excludes the functions that it calls. ``--functions`` lists each compilation.
"""

import argparse
import os
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from numba.core import config, event


@dataclass
class Compilation:
    """One function compiled for one signature."""

    module: str
    function: str
    signature: str
    began_s: float
    within_s: float = 0.0  # of the functions compiled for it
    own_s: float = 0.0


@dataclass
class Recorder(event.Listener):  # type: ignore[misc]
    """Records each compilation with its processor time, less that of the functions compiled for it."""

    done: list[Compilation] = field(default_factory=list)
    _open: list[Compilation] = field(default_factory=list)

    def on_start(self, event: Any) -> None:
        """Begin a compilation."""
        function = event.data["dispatcher"].py_func
        self._open.append(
            Compilation(function.__module__, function.__qualname__, str(event.data["args"]), time.thread_time())
        )

    def on_end(self, event: Any) -> None:
        """End the compilation that began last."""
        compilation = self._open.pop()
        total_s = time.thread_time() - compilation.began_s
        compilation.own_s = total_s - compilation.within_s
        if self._open:
            self._open[-1].within_s += total_s
        self.done.append(compilation)


def stages() -> Iterator[str]:
    """Yield the name of each part after it has been compiled by this process."""
    from monitor.daemon.kernels import kernel_groups

    yield "imports"
    for group in kernel_groups.GROUPS:
        for part in group.parts:
            part.prepare()
            yield part.name


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--functions", action="store_true", help="list each compilation")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        os.environ["NUMBA_CACHE_DIR"] = folder
        config.CACHE_DIR = folder
        recorder = Recorder()
        event.register("numba:compile", recorder)
        print("processor time until ready")
        for stage in stages():
            print(f"  {time.process_time():6.2f} s  {stage}", flush=True)
    modules: dict[str, list[Compilation]] = defaultdict(list)
    for compilation in recorder.done:
        modules[compilation.module].append(compilation)
    print(f"{len(recorder.done)} compilations, {sum(compilation.own_s for compilation in recorder.done):.2f} s")
    for module, group in sorted(modules.items(), key=lambda item: -sum(compilation.own_s for compilation in item[1])):
        print(f"  {sum(compilation.own_s for compilation in group):6.2f} s  {len(group):4d}  {module}")
        if arguments.functions:
            for compilation in sorted(group, key=lambda compilation: -compilation.own_s):
                print(f"          {compilation.own_s:6.2f} s  {compilation.function} {compilation.signature}")


if __name__ == "__main__":
    main()
