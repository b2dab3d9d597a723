"""The page that follows one call names files and functions that exist."""

import ast
import re
from pathlib import Path

import pytest


ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "one_call.md").read_text(encoding="utf-8")
STOPS = re.findall(r"^\| `(nhjax/[\w/]+\.py)` \| `([\w.]+)` \|", PAGE, re.MULTILINE)


def _definitions(text):
    """The functions and classes of a module, and methods as `Class.method`."""
    found = set()
    for node in ast.parse(text).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        if isinstance(node, ast.ClassDef):
            inner = (x.name for x in node.body if isinstance(x, ast.FunctionDef))
            found |= {f"{node.name}.{name}" for name in inner}
    return found


@pytest.mark.parametrize(("file", "function"), sorted(set(STOPS)))
def test_followed_call_function_exists(file, function):
    assert function in _definitions((ROOT / file).read_text(encoding="utf-8"))


def test_followed_call_table_rows_are_all_read():
    rows = [line for line in PAGE.splitlines() if line.startswith("| `")]
    assert len(STOPS) == len(rows) > 40


def test_followed_call_files_all_exist():
    files = set(re.findall(r"`((?:nhjax|tests|docs)/[\w/]+\.py)`", PAGE))
    assert files
    assert [file for file in files if not (ROOT / file).is_file()] == []


def test_followed_call_definitions_are_read_from_source():
    text = "class A:\n    def f(self): ...\n\ndef g(): ...\n"
    assert _definitions(text) == {"A", "A.f", "g"}
