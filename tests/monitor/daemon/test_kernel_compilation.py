"""Tests of the compilation of kernels by child processes and by the process itself, and of the cache on disk."""

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

ECHO_ALL_LINES = "import sys\nfor line in sys.stdin: print(line, end='', flush=True)"
ECHO_ONE_LINE = "import sys\nprint(sys.stdin.readline(), end='', flush=True)"
EXIT_WITH_ERROR = "import sys\nsys.exit(1)"


@pytest.fixture
def _empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_compilation, "kernel_cache_folder", lambda: tmp_path)


def make_group(calls: list[str], names: str) -> KernelGroup:
    return KernelGroup("test", tuple(KernelPart(name, lambda name=name: calls.append(name)) for name in names))


@pytest.mark.usefixtures("_empty_cache")
@pytest.mark.parametrize("processes", [0, 1, 2])
@pytest.mark.parametrize("child", [ECHO_ALL_LINES, ECHO_ONE_LINE, EXIT_WITH_ERROR])
def test_all_parts_are_ready_in_order_even_if_children_fail(
    monkeypatch: pytest.MonkeyPatch, processes: int, child: str
) -> None:
    monkeypatch.setattr(kernel_compilation, "COMPILER", (sys.executable, "-c", child))
    calls: list[str] = []
    progress_reports: list[CompilationProgress] = []
    group = make_group(calls, "abcd")
    assert not kernel_compilation.is_warm(group)
    assert list(kernel_compilation.prepare_kernels(group, progress_reports.append, processes)) == list("abcd")
    assert calls == list("abcd")
    assert {name for progress in progress_reports for name in progress.running} == set("abcd")
    assert all(progress.of == 4 and 0 <= progress.done < 4 for progress in progress_reports)
    assert kernel_compilation.is_warm(group)
    progress_reports.clear()
    assert list(kernel_compilation.prepare_kernels(group, progress_reports.append, processes)) == list("abcd")
    assert progress_reports == []


@pytest.mark.usefixtures("_empty_cache")
@pytest.mark.parametrize("processes", [0, 1, 2])
def test_failed_progress_output_ends_the_compilation_with_its_error(
    monkeypatch: pytest.MonkeyPatch, processes: int
) -> None:
    monkeypatch.setattr(kernel_compilation, "COMPILER", (sys.executable, "-c", ECHO_ALL_LINES))

    def raise_broken_pipe(_progress: CompilationProgress) -> None:
        raise BrokenPipeError(32, "Broken pipe")

    calls: list[str] = []
    with pytest.raises(BrokenPipeError):
        list(kernel_compilation.prepare_kernels(make_group(calls, "abcd"), raise_broken_pipe, processes))
    assert calls == []


@pytest.mark.usefixtures("_empty_cache")
def test_compilation_works_without_processor_affinity(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_getaffinity")  # macOS has no affinity
    monkeypatch.setattr(kernel_compilation, "COMPILER", (sys.executable, "-c", ECHO_ALL_LINES))
    calls: list[str] = []
    assert list(kernel_compilation.prepare_kernels(make_group(calls, "ab"), lambda _: None)) == ["a", "b"]


@pytest.mark.usefixtures("_empty_cache")
def test_compiler_that_cannot_be_started_is_replaced_by_this_process(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(kernel_compilation, "COMPILER", (str(tmp_path / "missing"),))
    calls: list[str] = []
    assert list(kernel_compilation.prepare_kernels(make_group(calls, "ab"), lambda _: None, 2)) == ["a", "b"]
    assert calls == ["a", "b"]


def test_without_a_cache_folder_kernels_are_compiled_at_every_start(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(kernel_compilation, "kernel_cache_folder", lambda: None)
    monkeypatch.setattr(kernel_compilation, "COMPILER", (sys.executable, "-c", ECHO_ALL_LINES))
    calls: list[str] = []
    progress_reports: list[CompilationProgress] = []
    group = make_group(calls, "ab")
    for _ in range(2):
        assert list(kernel_compilation.prepare_kernels(group, progress_reports.append)) == ["a", "b"]
    assert calls == ["a", "b"] * 2
    assert [str(progress) for progress in progress_reports] == ["compiling 1 of 2: a", "compiling 2 of 2: b"] * 2


def test_compiling_child_ends_with_its_parent() -> None:
    child = subprocess.Popen(kernel_compilation.COMPILER, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    with child:
        assert child.stdin is not None
        assert child.stdout is not None
        print(kernel_groups.WINDOW, file=child.stdin, flush=True)
        assert child.stdout.readline() == f"{kernel_groups.WINDOW}\n"
        child.stdin.close()
        assert child.wait(PATIENCE_S) == 0


def test_warm_up_command_compiles_what_is_not_cached(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(compiled, "kernel_cache_folder", lambda: tmp_path)
    monkeypatch.setattr(kernel_compilation, "kernel_cache_folder", lambda: tmp_path)
    monkeypatch.setattr(kernel_compilation, "COMPILER", (sys.executable, "-c", ECHO_ALL_LINES))
    calls: list[str] = []
    monkeypatch.setattr(kernel_groups, "GROUPS", (make_group(calls, "ab"),))
    warm_up()
    printed = capsys.readouterr()
    assert printed.out.startswith("compiled 2 parts in ")
    assert printed.out.endswith(f"; kernels are kept in {tmp_path}\n")
    assert "compiling 2 of 2: " in printed.err
    warm_up()
    assert capsys.readouterr() == (f"nothing to compile; kernels are kept in {tmp_path}\n", "")
    assert calls == ["a", "b"]


def test_warm_up_command_reports_a_missing_cache_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "kernel_cache_folder", lambda: None)
    with pytest.raises(ConfigError, match="no cache folder can be written; set NUMBA_CACHE_DIR"):
        warm_up()
