"""Test that the sources use no function that executes data, beyond ruff's rules S102, S301, S307, S602 and others."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SOURCES = sorted([*(ROOT / "drivers").rglob("*.py"), *(ROOT / "monitor").rglob("*.py")])
FORBIDDEN_MODULES = {"pickle", "marshal", "shelve", "dill", "cloudpickle", "code", "codeop", "xmlrpc"}


def find_unsafe_code(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the line number and the name of each forbidden import, call and argument."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        names = []
        if isinstance(node, ast.Import):
            names = [name.name for name in node.names if name.name.partition(".")[0] in FORBIDDEN_MODULES]
        elif isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] in FORBIDDEN_MODULES:
            names = [node.module or ""]
        elif isinstance(node, ast.Call):
            names = [
                f"{keyword.arg}="
                for keyword in node.keywords
                if keyword.arg in ("shell", "allow_pickle") and getattr(keyword.value, "value", True)
            ]
            if isinstance(node.func, ast.Name) and node.func.id in ("eval", "exec", "compile", "__import__"):
                names.append(node.func.id)
        yield from ((node.lineno, name) for name in names)  # type: ignore[attr-defined]


def test_sources_use_no_pickle_eval_or_shell() -> None:
    found = [f"{path.relative_to(ROOT)}:{line}: {name}" for path in SOURCES for line, name in find_unsafe_code(path)]
    assert found == []


@pytest.mark.parametrize(
    "code",
    ["import pickle", "from marshal import loads", "run(x, shell=True)", "load(x, allow_pickle=y)", "eval(x)"],
)
def test_unsafe_code_is_found(code: str, tmp_path: Path) -> None:
    (tmp_path / "unsafe.py").write_text(code)
    assert list(find_unsafe_code(tmp_path / "unsafe.py"))
