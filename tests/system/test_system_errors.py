"""Mistakes in the functions of a system name the function and its arguments."""

import functools

import equinox as eqx
import jax
import pytest

import nhjax
from support.mistakes import (
    kinetic,
    start,
    system_with,
)


# LagrangianSystem, methods, solvers ---------------------------------------------------


@pytest.mark.parametrize("name", ["nonholonomic", "force"])
def test_function_of_system_that_is_a_number_is_refused(name):
    with pytest.raises(TypeError, match=rf"`{name}`.*\(t, q, v, args\), got 3"):
        system_with(**{name: 3})


class Methods(eqx.Module):
    """A function of a system may be a method, or the module itself."""

    def short(self, t, q, v):
        return 0.5 * v @ v

    def __call__(self, t, q, v, args, more):
        return 0.5 * v @ v


@pytest.mark.parametrize(
    ("name", "function", "message"),
    [
        (
            "nonholonomic",
            lambda t, q, args: q,
            r"\(t, q, v, args\), but `<lambda>\(t, q, args\)`",
        ),
        ("force", lambda v: v, r"\(t, q, v, args\), but `<lambda>\(v\)` does not"),
        ("force", jax.jit(lambda t, q, v: v), r".*but `<lambda>\(t, q, v\)` does not"),
        ("lagrangian", Methods().short, r".*but `short\(t, q, v\)` does not"),
        ("lagrangian", Methods(), r".*but `Methods\(t, q, v, args, more\)` does not"),
        (
            "force",
            lambda t, q, v, args, *, gain: v,
            r".*but `<lambda>\(t, q, v, args, \*, gain\)` does not",
        ),
    ],
)
def test_function_of_system_with_wrong_signature_is_refused(name, function, message):
    with pytest.raises(
        TypeError, match=rf"LagrangianSystem: `{name}` must take {message}"
    ):
        system_with(**{name: function})


def test_hamiltonian_with_wrong_signature_is_refused():
    message = (
        r"HamiltonianSystem: `hamiltonian` must take \(t, q, p, args\), but .*p\)`"
    )
    with pytest.raises(TypeError, match=message):
        nhjax.HamiltonianSystem(lambda t, q, p: 0.5 * p @ p)  # pyright: ignore


def test_function_of_system_with_unknown_signature_is_accepted():
    def without_args(function):
        @functools.wraps(function)
        def called(t, q, v, args):
            return function(t, q, v)

        return called

    for lagrangian in (
        without_args(lambda t, q, v: 0.5 * v @ v),
        functools.partial(lambda mass, t, q, v, args: mass * v @ v, 2.0),
        lambda *anything: kinetic(*anything),
        max,
    ):
        system_with(lagrangian=lagrangian)


def test_error_inside_function_of_system_keeps_its_message():
    def lagrangian(t, q, v, args):
        return kinetic(t, q, v)  # pyright: ignore[reportCallIssue]

    with pytest.raises(TypeError, match=r"^kinetic\(\) missing 1 required positional"):
        start(system_with(lagrangian=lagrangian))


@pytest.mark.parametrize(
    ("name", "function"),
    [
        ("lagrangian", lambda t, x, v, p: 0.5 * v @ v),
        ("lagrangian", lambda time, v, w, args: 0.5 * w @ w),
        ("holonomic", lambda t, x, parameters: x @ x),
        ("force", lambda t, q, v, q0: -v),
        ("nonholonomic", lambda *args: args[2][0]),
    ],
)
def test_function_of_system_with_other_argument_names_is_accepted(name, function):
    assert getattr(system_with(**{name: function}), name).function is function


def test_partial_function_with_arguments_in_wrong_order_is_refused():
    with pytest.raises(TypeError, match=r"in this order, but .*\(q, v, t, args\)`"):
        system_with(
            lagrangian=functools.partial(lambda m, q, v, t, args: m * v @ v, 2.0)
        )
