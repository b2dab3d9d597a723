"""The README is right: its code runs as printed, and its commands are the CI's."""

import re

import pytest

from support.pages import blocks, ROOT


README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.usefixtures("closed_figures")
def test_readme_python_blocks_run_as_printed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace = {}
    for block in blocks(README, "python"):
        exec(compile(block, "README.md", "exec"), namespace)
    sol = namespace["sol"]
    assert sol.stats["max_constraint_violation"] < 1e-13
    # The sleigh moves back, and turns around.
    assert sol.ys.q[-1, 0] < -0.3
    assert abs(sol.ys.q[-1, 2]) > 2.0
    assert (tmp_path / "blade.png").stat().st_size > 0


def test_readme_commands_are_run_by_continuous_integration():
    commands = [line for block in blocks(README, "bash") for line in block.splitlines()]
    assert commands[-1].startswith("pytest")
    run = (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()
    for command in commands:
        assert command in run
    assert run[-1] == commands[-1]


def test_readme_linked_files_exist():
    for target in re.findall(r"\]\(([^)#:]+)\)|`(notebooks/[^`]+)`", README):
        assert (ROOT / (target[0] or target[1])).is_file()
