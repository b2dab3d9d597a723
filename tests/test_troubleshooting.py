"""The page of messages: those that it quotes exist, and no way to fail is missing."""

import ast
import inspect
import re
from pathlib import Path

import pytest

import nhjax
from nhjax._results import result_codes
from support.pages import page, run_page


ROOT = Path(__file__).parents[1]
PAGE = page("troubleshooting")


def _section(title):
    return PAGE.split(f"\n## {title}\n")[1].split("\n## ")[0]


# Sections whose headings are not messages of nhjax.
OTHERS = (
    *("A run that ended early", "Errors of JAX and Python"),
    *("Wrong results without an error", "Slow calls and memory"),
)


def _quoted():
    """The constant parts of the messages in headings."""
    for section in PAGE.split("\n## ")[1:]:
        if section.split("\n")[0] not in OTHERS:
            for heading in re.findall(r"^### (.*)$", section, re.MULTILINE):
                for quote in heading.split("`")[1::2]:
                    yield from (part for part in quote.split("…") if len(part) > 2)


def _written():
    """The strings in the package, which contain the constant parts of messages."""
    return "\n".join(
        node.value
        for path in sorted((ROOT / "nhjax").rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    )


@pytest.mark.parametrize("name", sorted(result_codes()))
def test_result_of_every_kind_is_on_the_troubleshooting_page(name):
    assert f"\n### `{name}`\n" in _section("A run that ended early")


def test_exception_of_every_kind_is_on_the_troubleshooting_page():
    for name in dir(nhjax):
        value = getattr(nhjax, name)
        if inspect.isclass(value) and issubclass(value, Exception):
            assert f"`{name}`" in PAGE, name


def test_messages_quoted_on_the_page_exist_in_the_package():
    known = _written() + " ".join(dir(nhjax))
    parts = list(_quoted())
    assert len(parts) > 50
    assert [part for part in parts if part not in known and part != "TypeError"] == []


def test_troubleshooting_page_code_runs():
    (failure,) = run_page("troubleshooting")["sol"].failures()
    assert failure[0] == 1
