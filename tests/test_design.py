"""The page of the public interface names every part of the interface."""

import ast
import contextlib
import inspect
from pathlib import Path

import jax.numpy as jnp
import pytest

import nhjax
from nhjax._results import result_codes


PAGE = (Path(__file__).parents[1] / "docs" / "design.md").read_text(encoding="utf-8")


def written_signatures():
    """The first signature of each public name on the page, parsed as Python."""
    found: dict[str, ast.arguments] = {}
    for code in PAGE.split("`")[1::2]:
        name, bracket, _ = code.partition("(")
        # Code with dots in place of arguments is not a signature.
        with contextlib.suppress(SyntaxError):
            if bracket and name in dir(nhjax):
                (definition,) = ast.parse(f"def {' '.join(code.split())}: pass").body
                assert isinstance(definition, ast.FunctionDef)
                found.setdefault(name, definition.args)
    return found


SIGNATURES = written_signatures()


# These have all of their arguments on the page; others are mentioned in a call.
COMPLETE = {"LagrangianSystem", "initial_state", "LobattoIIIAB", "integrate", "step"}
COMPLETE |= {"Gauss", "PartitionedRungeKutta", "SaveAt", "SimplifiedNewton", "Newton"}
COMPLETE |= {"RecursiveCheckpointAdjoint", "Event"}


@pytest.mark.parametrize("name", sorted({*SIGNATURES} | COMPLETE))
def test_signature_on_the_design_page_equals_the_code(name):
    written, parameters = SIGNATURES[name], inspect.signature(getattr(nhjax, name))
    positional = [*written.args, *written.kwonlyargs]
    names = {x.arg for x in positional}
    assert names <= {*parameters.parameters}
    assert name not in COMPLETE or names == {*parameters.parameters}
    defaults = [None] * (len(written.args) - len(written.defaults)) + written.defaults
    for argument, value in zip(positional, defaults + written.kw_defaults, strict=True):
        if value is not None:
            expected = parameters.parameters[argument.arg].default
            assert eval(ast.unparse(value), dict(vars(nhjax))) == expected, argument.arg


def test_results_and_statistics_are_on_the_design_page():
    oscillator = nhjax.systems.HarmonicOscillator()
    sol = nhjax.integrate(
        oscillator.system,
        nhjax.LobattoIIIAB(2),
        oscillator.initial_state(),
        dt=0.1,
        num_steps=2,
        invariants="energy",
    )
    at_zero = nhjax.Event(lambda t, y, args: y.q[0])
    other = nhjax.integrate(
        oscillator.system,
        nhjax.LobattoIIIAB(2),
        oscillator.initial_state(),
        dt=jnp.asarray(0.1),
        num_steps=2,
        event=at_zero,
    )
    for name in {*sol.stats, *other.stats, *result_codes()}:
        assert f"`{name}`" in PAGE, name
