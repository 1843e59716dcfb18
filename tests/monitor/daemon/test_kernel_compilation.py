"""Compilation of kernels: by child processes, by the process itself, and what is kept on disk."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from drivers.errors import ConfigError
from monitor.cli.warm_up import warm_up
from monitor.common import compiled
from monitor.daemon.kernels import kernel_compilation, kernel_groups
from monitor.daemon.kernels.kernel_compilation import CompilationProgress
from monitor.daemon.kernels.kernel_groups import KernelGroup, KernelPart
from tests.support.waiting import PATIENCE_S

ANSWERS_ALL = "import sys\nfor line in sys.stdin: print(line, end='', flush=True)"
ANSWERS_ONE = "import sys\nprint(sys.stdin.readline(), end='', flush=True)"
ANSWERS_NONE = "import sys\nsys.exit(1)"
COUNT_COMPILATIONS = """
import sys
from drivers.errors import ConfigError
from monitor.common import compiled
from monitor.daemon.kernels import kernel_compilation, kernel_groups
from monitor.cli.warm_up import warm_up
from numba.core import event
with event.install_recorder("numba:compile") as recorder:
    for group in kernel_groups.GROUPS:
        for part in group.parts:
            part.prepare()
print([str(each.data["dispatcher"]) for _, each in recorder.buffer if each.is_start])
"""


@pytest.fixture
def _empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_compilation, "kernel_cache_folder", lambda: tmp_path)


def group_of(calls: list[str], names: str) -> KernelGroup:
    return KernelGroup("test", tuple(KernelPart(name, lambda name=name: calls.append(name)) for name in names))


@pytest.mark.usefixtures("_empty_cache")
@pytest.mark.parametrize("processes", [0, 1, 2])
@pytest.mark.parametrize("child", [ANSWERS_ALL, ANSWERS_ONE, ANSWERS_NONE])
def test_every_part_is_ready_in_its_order_whatever_becomes_of_the_children(
    monkeypatch: pytest.MonkeyPatch, processes: int, child: str
) -> None:
    monkeypatch.setattr(kernel_compilation, "COMPILER", (sys.executable, "-c", child))
    calls: list[str] = []
    told: list[CompilationProgress] = []
    group = group_of(calls, "abcd")
    assert not kernel_compilation.is_warm(group)
    assert list(kernel_compilation.prepare_kernels(group, told.append, processes)) == list("abcd")
    assert calls == list("abcd")
    assert {name for progress in told for name in progress.running} == set("abcd")
    assert all(progress.of == 4 and 0 <= progress.done < 4 for progress in told)
    assert kernel_compilation.is_warm(group)
    told.clear()
    assert list(kernel_compilation.prepare_kernels(group, told.append, processes)) == list("abcd")
    assert told == []


@pytest.mark.usefixtures("_empty_cache")
@pytest.mark.parametrize("processes", [0, 1, 2])
def test_progress_that_cannot_be_written_ends_the_compilation_with_its_error(
    monkeypatch: pytest.MonkeyPatch, processes: int
) -> None:
    monkeypatch.setattr(kernel_compilation, "COMPILER", (sys.executable, "-c", ANSWERS_ALL))

    def tell(_progress: CompilationProgress) -> None:
        raise BrokenPipeError(32, "Broken pipe")

    calls: list[str] = []
    with pytest.raises(BrokenPipeError):
        list(kernel_compilation.prepare_kernels(group_of(calls, "abcd"), tell, processes))
    assert calls == []


@pytest.mark.usefixtures("_empty_cache")
def test_processors_are_counted_where_the_system_has_no_affinity(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_getaffinity")  # as on macOS
    monkeypatch.setattr(kernel_compilation, "COMPILER", (sys.executable, "-c", ANSWERS_ALL))
    calls: list[str] = []
    assert list(kernel_compilation.prepare_kernels(group_of(calls, "ab"), lambda _: None)) == ["a", "b"]


@pytest.mark.usefixtures("_empty_cache")
def test_a_program_that_cannot_be_started_leaves_the_compilation_to_this_process(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(kernel_compilation, "COMPILER", (str(tmp_path / "missing"),))
    calls: list[str] = []
    assert list(kernel_compilation.prepare_kernels(group_of(calls, "ab"), lambda _: None, 2)) == ["a", "b"]
    assert calls == ["a", "b"]


def test_without_a_folder_for_them_kernels_are_compiled_by_this_process_at_every_start(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(kernel_compilation, "kernel_cache_folder", lambda: None)
    monkeypatch.setattr(kernel_compilation, "COMPILER", (sys.executable, "-c", ANSWERS_ALL))
    calls: list[str] = []
    told: list[CompilationProgress] = []
    group = group_of(calls, "ab")
    for _ in range(2):
        assert list(kernel_compilation.prepare_kernels(group, told.append)) == ["a", "b"]
    assert calls == ["a", "b"] * 2
    assert [str(progress) for progress in told] == ["compiling 1 of 2: a", "compiling 2 of 2: b"] * 2


def test_the_child_ends_with_its_parent() -> None:
    child = subprocess.Popen(kernel_compilation.COMPILER, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    with child:
        assert child.stdin is not None
        assert child.stdout is not None
        print(kernel_groups.WINDOW, file=child.stdin, flush=True)
        assert child.stdout.readline() == f"{kernel_groups.WINDOW}\n"
        child.stdin.close()
        assert child.wait(PATIENCE_S) == 0


@pytest.mark.long
def test_the_warm_up_command_fills_an_empty_cache_and_nothing_is_compiled_after_it(tmp_path: Path) -> None:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}

    def run(*arguments: str) -> "subprocess.CompletedProcess[str]":
        return subprocess.run(arguments, env=environment, capture_output=True, text=True, check=True)

    command = kernel_compilation.COMPILER[:-1]
    first, second = run(*command), run(*command)
    assert first.stdout.startswith("compiled ")
    assert "compiling 2 of " in first.stderr
    assert second.stdout == f"nothing to compile; kernels are kept in {kept_in(first.stdout)}\n"
    assert second.stderr == ""
    assert run(sys.executable, "-c", COUNT_COMPILATIONS).stdout == "[]\n"


def kept_in(text: str) -> str:
    return text.rstrip("\n").partition(" are kept in ")[2]


def test_the_command_says_where_kernels_cannot_be_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "kernel_cache_folder", lambda: None)
    with pytest.raises(ConfigError, match="no cache folder can be written; set NUMBA_CACHE_DIR"):
        warm_up()
