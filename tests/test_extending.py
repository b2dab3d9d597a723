"""The page about writing one's own parts: its blocks run as printed, and are right."""

import re
from typing import Any

import pytest

import nhjax
from support.pages import blocks, page


def _sections():
    """The opening blocks, which all sections need, and the blocks of each section."""
    opening, *sections = re.split(r"^## (.+)$", page("extending"), flags=re.MULTILINE)
    titles, texts = sections[::2], sections[1::2]
    return blocks(opening), dict(zip(titles, map(blocks, texts), strict=True))


OPENING, SECTIONS = _sections()


def _run(title):
    namespace: dict[str, Any] = {"__name__": f"extending.{title}"}
    for block in (*OPENING, *SECTIONS[title]):
        exec(compile(block, f"extending.md: {title}", "exec"), namespace)
    return namespace


# The page itself asserts the comparison with nhjax's own parts.
@pytest.mark.parametrize("title", ["A group", "A retraction", "A method"])
def test_own_group_retraction_or_method_on_the_page_runs(title):
    _run(title)


def test_own_stage_solver_runs_and_reports_its_failures():
    names = _run("A stage solver")
    particle = names["particle"]
    sol = nhjax.integrate(
        particle.system,
        nhjax.LobattoIIIAB(3),
        particle.initial_state(),
        dt=0.05,
        num_steps=50,
        stage_solver=names["Chord"](max_iterations=2),
        throw=False,
    )
    assert bool(sol.result == nhjax.RESULTS.nonlinear_max_iterations)


def test_own_adjoint_on_the_page_runs():
    _run("An adjoint")


def test_own_progress_meter_receives_progress():
    heard = _run("A progress meter")["heard"]
    assert sorted(heard)[-1] == (1000, 1000)
    assert 50 < len(heard) < 200


def test_extending_page_sections_with_code_are_all_tested():
    with_code = {title for title, blocks in SECTIONS.items() if blocks}
    assert with_code == {
        "A group",
        "A retraction",
        "A method",
        "A stage solver",
        "An adjoint",
        "A progress meter",
    }
