"""The page of the public interface names all that the interface has."""

import inspect
import re
from pathlib import Path

import jax.numpy as jnp
import pytest

import nhjax
from nhjax._results import result_codes


PAGE = (Path(__file__).parents[1] / "docs" / "design.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "name",
    [
        "LagrangianSystem",
        "initial_state",
        "LobattoIIIAB",
        "Gauss",
        "PartitionedRungeKutta",
        "integrate",
        "step",
        "SaveAt",
        "SimplifiedNewton",
        "Newton",
        "RecursiveCheckpointAdjoint",
        "Event",
    ],
)
def test_a_signature_on_the_page_has_all_arguments(name):
    written = re.findall(rf"`{name}\((.*?)\)`", PAGE, re.DOTALL)
    parameters = inspect.signature(getattr(nhjax, name)).parameters
    # The first one is the signature; others are examples.
    arguments = re.findall(r"\w+(?==|,|$)", re.sub(r"=[^,]*", "=", written[0]))
    assert sorted(arguments) == sorted(parameters)


def written_defaults():
    """The defaults of the first signature of each name, as the page writes them."""
    for name, arguments in re.findall(r"`(\w+)\(((?:[^`()]|\([^()]*\))*)\)`", PAGE):
        found = re.findall(r"(\w+)=((?:[^,()]|\([^()]*\))+)", arguments)
        for argument, value in found if hasattr(nhjax, name) else ():
            yield name, argument, value.strip()


def test_defaults_on_the_page_are_those_of_the_signatures():
    defaults = list(written_defaults())
    assert ("integrate", "throw", "True") in defaults
    assert ("Event", "max_events", "32") in defaults
    for name, argument, value in defaults:
        expected = inspect.signature(getattr(nhjax, name)).parameters[argument].default
        assert eval(value, dict(vars(nhjax))) == expected, (name, argument)


def test_results_and_statistics_are_on_the_page():
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
