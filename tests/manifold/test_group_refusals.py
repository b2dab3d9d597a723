"""Errors for invalid groups, retractions and elements."""

import jax.numpy as jnp
import numpy as np
import pytest

from nhjax._errors import ShapeError
from nhjax._manifold import (
    AbstractRetraction,
    Cayley,
    Exponential,
    ProductGroup,
    SE2,
    SE3,
    SO2,
    SO3,
)
from support.group_samples import (
    GROUPS,
    MIXED,
)


# Errors


@pytest.mark.parametrize("group", [SO2, SO3, SE2, SE3])
@pytest.mark.parametrize("retraction", [Cayley, "cayley", None, np.ones(3)])
def test_group_with_invalid_retraction_raises(group, retraction):
    with pytest.raises(TypeError, match=r"`retraction` must be one of Cayley\(\)"):
        group(retraction=retraction)


def test_group_with_a_class_as_retraction_raises_saying_so():
    with pytest.raises(TypeError, match="It is a class; call it"):
        SO3(retraction=Exponential)  # pyright: ignore[reportArgumentType]


def test_group_with_unknown_retraction_raises_with_advice():
    class Mine(AbstractRetraction):
        angle = rate = plane_rotation = half_rotation = None  # pyright: ignore
        rotation_vector = None  # pyright: ignore
        dtau_coefficients = dtau_inv_coefficients = in_chart = None  # pyright: ignore

    with pytest.raises(ValueError, match=r"`retraction` is .*subclass `AbstractLie"):
        SO3(retraction=Mine())


@pytest.mark.parametrize(
    ("group", "q", "message"),
    [
        (SO2(), jnp.zeros(()), r"`q` has shape \(\), but the manifold SO2 needs"),
        (SO3(), jnp.zeros(3), r"manifold SO3 needs shape \(4,\)"),
        (SE2(), jnp.zeros((2, 3)), r"use `jax.vmap`"),
        (SE3(), jnp.zeros(6), r"manifold SE3 needs shape \(7,\)"),
        (SO3(), (jnp.zeros(4),), r"`q` is \(f64\[4\],\), but the manifold SO3 needs"),
        (MIXED, jnp.zeros(9), r"`q` must be a tuple of 3 elements.* got f64\[9\]"),
        (MIXED, (jnp.zeros(4),), r"tuple of 3 elements.* got \(f64\[4\],\)"),
        (
            MIXED,
            (jnp.zeros(4), jnp.zeros(2), (jnp.zeros(3), jnp.zeros(2))),
            r"`q\[2\]\[1\]` has shape \(2,\), but the manifold SO2 needs",
        ),
    ],
)  # fmt: skip
def test_group_check_of_a_wrong_element_raises_naming_it(group, q, message):
    with pytest.raises(ShapeError, match=message):
        group.check(q)


def test_group_check_of_a_valid_element_returns_it():
    for group in GROUPS:
        q = group.identity()
        assert group.check(q) is q


@pytest.mark.parametrize(
    ("factors", "error", "message"),
    [
        ((), ValueError, "at least one factor"),
        ((SO3(), 2), TypeError, "factor 1 must be a Lie group"),
        ((SO3,), TypeError, "factor 0 must be a Lie group"),
    ],
)
def test_product_group_with_invalid_factors_raises(factors, error, message):
    with pytest.raises(error, match=message):
        ProductGroup(*factors)
