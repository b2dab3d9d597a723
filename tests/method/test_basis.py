"""The Lagrange basis of dense output, and methods as hashable values."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nhjax._method import AbstractMethod, Gauss, LobattoIIIAB, PartitionedRungeKutta
from support.tableaux import (
    RADAU_IIA,
    RK4,
    STAGES,
)


# --- the basis of dense output --------------------------------------------------------


@pytest.mark.parametrize("s", STAGES)
@pytest.mark.parametrize("kind", [LobattoIIIAB, Gauss])
def test_basis_integrated_to_the_nodes_equals_the_coefficients(s: int, kind: type):
    method = kind(s)
    # Rounding a node changes ℓ_j by up to ℓ_j' 2^-53, which exceeds 1e-15 at the outer
    # Gauss nodes, where ℓ_j is steep.
    slopes = jax.vmap(jax.jacfwd(method.basis))(jnp.asarray(method.c))
    bound = 1e-15 + 2.0**-53 * np.abs(slopes)
    assert (np.abs(method.basis(method.c) - np.eye(s)) <= bound).all()
    np.testing.assert_allclose(
        method.integrated_basis(method.c), method.a, rtol=0, atol=2e-16
    )


@pytest.mark.parametrize("s", STAGES)
@pytest.mark.parametrize("kind", [LobattoIIIAB, Gauss])
def test_integrated_basis_is_exact_at_both_ends(s: int, kind: type):
    method = kind(s)
    assert not np.asarray(method.integrated_basis(0)).any()
    assert method.integrated_basis(1).tolist() == method.b.tolist()


@pytest.mark.parametrize(
    "method", [LobattoIIIAB(2), LobattoIIIAB(5), Gauss(1), RADAU_IIA]
)
def test_integrated_basis_differentiated_equals_the_basis(method: AbstractMethod):
    theta = jnp.linspace(-0.25, 1.5, 8)
    slopes = jax.vmap(jax.jacfwd(method.integrated_basis))(theta)
    np.testing.assert_allclose(slopes, method.basis(theta), rtol=1e-12, atol=1e-13)


def test_basis_integrates_polynomials_beyond_the_step():
    method = LobattoIIIAB(6)
    values = 1 + method.c - 3 * method.c**5
    theta = jnp.array([-0.5, 0.3, 2.0])
    np.testing.assert_allclose(
        method.integrated_basis(theta) @ values,
        theta + theta**2 / 2 - theta**6 / 2,
        rtol=1e-12,
    )


def test_basis_of_one_stage_is_constant():
    assert Gauss(1).basis(0.3).tolist() == [1.0]
    assert Gauss(1).integrated_basis(0.25).tolist() == [0.25]


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
def test_basis_follows_the_dtype_and_shape_of_theta(
    dtype: type, shape: tuple[int, ...]
):
    method = LobattoIIIAB(4)
    theta = jnp.full(shape, 0.3, dtype)
    tolerance = 4 * float(jnp.finfo(dtype).eps)
    for function in (method.basis, method.integrated_basis):
        value = jax.jit(function)(theta)
        assert (value.dtype, value.shape) == (dtype, (*shape, 4))
        reference = np.broadcast_to(function(0.3), value.shape)
        np.testing.assert_allclose(value, reference, rtol=0, atol=tolerance)


def test_basis_of_an_integer_is_floating():
    assert LobattoIIIAB(3).basis(1).dtype == jnp.float64
    assert LobattoIIIAB(2).integrated_basis(jnp.array(1)).tolist() == [0.5, 0.5]


def test_basis_with_coinciding_nodes_raises():
    message = r"c = \[0\.0, 0\.5, 0\.5, 1\.0\] has equal entries c_2 and c_3"
    with pytest.raises(ValueError, match=message):
        RK4.basis(0.5)


# --- methods as values ----------------------------------------------------------------


def test_methods_compare_and_hash_by_value():
    lobatto = LobattoIIIAB(3)
    user = PartitionedRungeKutta(lobatto.a, lobatto.b)
    assert lobatto == LobattoIIIAB(stages=3, closure="symmetric")
    assert hash(lobatto) == hash(LobattoIIIAB(3))
    assert user == PartitionedRungeKutta(lobatto.a.tolist(), lobatto.b.tolist())
    assert hash(user) == hash(PartitionedRungeKutta(lobatto.a, lobatto.b))
    for other in (LobattoIIIAB(4), LobattoIIIAB(3, "consistent"), user, Gauss(3)):
        assert lobatto != other


@pytest.mark.parametrize("method", [LobattoIIIAB(3), Gauss(2), RK4])
def test_methods_as_pytrees_have_no_leaves(method: AbstractMethod):
    assert jax.tree.leaves(method) == []


def test_equal_methods_under_jit_share_one_compilation():
    traces = []

    def weights(method: AbstractMethod, x: jax.Array) -> jax.Array:
        traces.append(method)
        return x * jnp.asarray(method.b, x.dtype)

    jitted = jax.jit(weights, static_argnums=0)
    x = jnp.ones(3)
    np.testing.assert_array_equal(jitted(LobattoIIIAB(3), x), LobattoIIIAB(3).b)
    jitted(LobattoIIIAB(3), x)
    assert len(traces) == 1
    jitted(Gauss(3), x)
    assert len(traces) == 2
