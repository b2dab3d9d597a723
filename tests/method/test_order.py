"""The orders of methods, from the conditions of trees and from runs."""

from fractions import Fraction

import numpy as np
import pytest

import nhjax
from benchmarks import _tableaux
from nhjax._method._order_conditions import (
    _Branch,
    _products,
    order,
    partitioned_order,
)
from support.long import long


def exact(rows):
    return np.array([[Fraction(x) for x in row] for row in rows], dtype=object)


def conjugate(a, b):
    s = len(b)
    return np.array(
        [[b[j] * (1 - a[j, i] / b[i]) for j in range(s)] for i in range(s)],
        dtype=object,
    )


def order_of(a, b, max_order=8):
    return partitioned_order((a, conjugate(a, b)), b, 0, max_order)


def test_order_trees_with_two_colours_have_the_known_counts():
    # Exact for every tree: all conditions of the flow itself, as φ = γ⁻¹ |τ| would be.
    branches, counts = [], []
    for size in range(1, 9):
        trees = list(_products(branches, size - 1, len(branches), np.ones(1)))
        counts.append(len(trees))
        branches += [
            _Branch(size, gamma * size, values)
            for gamma, values in trees
            for _ in range(2)
        ]
    assert counts == [1, 2, 7, 26, 107, 458, 2058, 9498]


def test_order_in_exact_rationals_of_runge_kutta_with_its_conjugate_is_four():
    a = exact([[0, 0, 0, 0], ["1/2", 0, 0, 0], [0, "1/2", 0, 0], [0, 0, 1, 0]])
    (b,) = exact([["1/6", "1/3", "1/3", "1/6"]])
    assert order_of(a, b) == 4


def test_order_in_exact_rationals_of_lobatto_pair_with_three_stages_is_four():
    a = exact([[0, 0, 0], ["5/24", "1/3", "-1/24"], ["1/6", "2/3", "1/6"]])
    (b,) = exact([["1/6", "2/3", "1/6"]])
    assert order_of(a, b) == 4


def test_order_in_exact_rationals_of_equidistant_nodes_is_two():
    # Nodes 0, 1/3, 2/3, 1: the quadrature and the collocation have order 4.
    a = exact(
        [
            [0, 0, 0, 0],
            ["1/8", "19/72", "-5/72", "1/72"],
            ["1/9", "4/9", "1/9", 0],
            ["1/8", "3/8", "3/8", "1/8"],
        ]
    )
    (b,) = exact([["1/8", "3/8", "3/8", "1/8"]])
    assert order_of(a, b) == 2
    assert _tableaux.collocation((0, 1 / 3, 2 / 3, 1)).order == 2


@pytest.mark.parametrize(
    "method", [*map(nhjax.LobattoIIIAB, range(2, 9)), *map(nhjax.Gauss, range(1, 7))]
)
def test_order_of_built_in_method_agrees_with_its_tableau(method):
    assert method.order == order(method._tableau())


FREE = {name: _tableaux.collocation(c) for name, c in _tableaux.OPEN.items()}
FREE |= {name: _tableaux.collocation(c) for name, c in _tableaux.CLOSED.items()}
FREE |= {"RK4": _tableaux.RK4}


@pytest.mark.parametrize("name", FREE)
def test_order_without_constraints_agrees_with_runs(name):
    method = FREE[name]
    counts = (40, 80) if method.order < 4 else (20, 40)
    found = _tableaux.observed(*_tableaux.pendulum(), method, counts, 2.0)
    assert abs(found.q - method.order) < 0.25
    assert abs(found.p - method.order) < 0.25


@pytest.mark.parametrize("name", _tableaux.CLOSED)
def test_order_with_constraints_agrees_with_runs(name):
    method = _tableaux.collocation(_tableaux.CLOSED[name])
    counts = (40, 80) if method.constrained_order < 4 else (24, 48)
    found = _tableaux.observed(*_tableaux.rolling(), method, counts, 1.0)
    assert abs(found.q - method.constrained_order) < 0.3
    assert abs(found.p - method.constrained_order) < 0.3
    assert found.multiplier > method.multiplier_order - 0.3


@pytest.mark.long
def test_order_with_constraints_without_collocation_agrees_with_runs():
    # The proof in docs/closures.md is about collocation.
    b = [1 / 6, 2 / 3, 1 / 6]
    a = [[0, 0, 0], [0.2, 0.4, -0.1], b]
    method = nhjax.PartitionedRungeKutta(a, b, closure="consistent")
    assert (method.orders.C, method.constrained_order) == (1, 2)
    found = _tableaux.observed(*_tableaux.rolling(), method, (40, 80), 1.0)
    np.testing.assert_allclose(found, 2, atol=0.1)


def test_order_where_multiplier_errors_add_up_on_asymmetric_nodes_is_one_lower():
    nodes = (0, 0.1, 0.6, 6 / 7, 1)
    method = _tableaux.collocation(nodes, "propagated")
    np.testing.assert_allclose(method.stability_at_infinity, 1, rtol=1e-12)
    assert (method.orders.D, method.constrained_order, method.multiplier_order) == (
        0,
        1,
        0,
    )
    found = _tableaux.observed(*_tableaux.rolling(), method, (80, 160), 2.0)
    np.testing.assert_allclose(found.q, 1, atol=0.1)
    assert found.p < 1.8
    other = _tableaux.collocation(nodes, "consistent")
    assert other.constrained_order == 2


# The other tableaux have |R_A(∞)| > 1 and raise an error.
PROPAGATED = [
    "0, 1/3, 2/3, 1",
    "0, .25, .5, .75, 1",
    long("Chebyshev, s = 5"),
    "0, .35, .7, 1",
    long("0, .1, .4, .6, .9, 1"),
]


@pytest.mark.parametrize("name", PROPAGATED)
def test_order_of_propagated_multiplier_agrees_with_runs(name):
    method = _tableaux.collocation(_tableaux.CLOSED[name], "propagated")
    found = _tableaux.observed(*_tableaux.rolling(), method, (80, 160), 1.0)
    assert abs(found.multiplier - method.multiplier_order) < 0.1
