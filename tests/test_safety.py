"""Test that the sources use no function that executes data, beyond ruff's rules S102, S301, S307, S602 and others."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SOURCES = sorted([*(ROOT / "drivers").rglob("*.py"), *(ROOT / "monitor").rglob("*.py")])
FORBIDDEN_MODULES = {"pickle", "marshal", "shelve", "dill", "cloudpickle", "code", "codeop", "xmlrpc"}


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_sources_use_no_pickle_eval_or_shell(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            assert not FORBIDDEN_MODULES & {name.name.partition(".")[0] for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert (node.module or "").partition(".")[0] not in FORBIDDEN_MODULES
        elif isinstance(node, ast.Call):
            for keyword in node.keywords:
                unsafe = keyword.arg in ("shell", "allow_pickle")
                assert not (unsafe and getattr(keyword.value, "value", True)), f"line {node.lineno}: {keyword.arg}"
            name = node.func.id if isinstance(node.func, ast.Name) else ""
            assert name not in ("eval", "exec", "compile", "__import__"), f"line {node.lineno}: {name}"
