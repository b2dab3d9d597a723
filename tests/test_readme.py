"""README keeps its word: its code runs as printed and its commands are the CI's."""

import re
from pathlib import Path

import pytest

from oracles.pages import blocks


ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.usefixtures("closed_figures")
def test_python_blocks_run_as_printed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace = {}
    for block in blocks(README, "python"):
        exec(compile(block, "README.md", "exec"), namespace)
    assert namespace["sol"].ys.q.shape == (1001, 3)
    assert namespace["sol"].stats["max_constraint_violation"] < 1e-13
    assert namespace["energies"].shape == (100,)
    assert namespace["slope"] > 0
    assert (tmp_path / "energy.png").stat().st_size > 0


def test_commands_are_those_of_the_continuous_integration():
    commands = [line for block in blocks(README, "bash") for line in block.splitlines()]
    assert commands[-1].startswith("pytest")
    run = (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()
    for command in commands:
        assert command in run
    assert run[-1] == commands[-1]


def test_linked_files_exist():
    for target in re.findall(r"\]\(([^)#:]+)\)|`(notebooks/[^`]+)`", README):
        assert (ROOT / (target[0] or target[1])).is_file()
