"""The factorisation of the linearised stage equations of one step."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._numerics import (
    block_tridiagonal_inverse,
    couplings,
    inverse,
    matvec,
    small_einsum,
    SparseMatrix,
    WeightedTranspose,
)
from .._system import Linearisation
from ._equations import (
    constraint_jacobian,
    constraint_values,
    invariant_correction,
    sparse_constraint_jacobian,
    StageEquations,
    StageUnknowns,
)
from ._first_order import (
    first_order_terms,
    FirstOrderTerms,
    full_momentum_inverse,
    momenta_of_forces,
)
from ._jacobian_choice import JacobianName, takes_first_order_terms
from ._leading_structure import LeadingStructure, Responses


def leading_structure(
    stages: StageEquations,
    x: StageUnknowns,
    lin: Linearisation,
    jacobian: JacobianName,
) -> LeadingStructure:
    """Factorise the leading structure, with N and K at the start and B_i at x.

    By `jacobian` it has the terms of order h beside the leading part.
    """
    terms = None
    if takes_first_order_terms(stages, lin, jacobian):
        terms = first_order_terms(stages, x, lin)
    structure = _without_impulses(stages, x, lin, terms)
    if stages.invariants is None:
        return structure
    return replace(structure, impulses=invariant_correction(stages, x))


def _without_impulses(
    stages: StageEquations,
    x: StageUnknowns,
    lin: Linearisation,
    terms: FirstOrderTerms | None,
) -> LeadingStructure:
    if not stages.constrained:
        n, nothing = stages.p.shape[0], jnp.zeros((0, 0), stages.p.dtype)
        reaction = jnp.zeros((stages.method.stages, n, 0), stages.p.dtype)
        given = lin.momentum_inverse, reaction, reaction, nothing, lin
        return LeadingStructure(*given, first_order=terms)
    if isinstance(lin.jacobian, SparseMatrix):
        return _sparse(stages, x, lin, lin.jacobian)
    at_nodes = constraint_jacobian(stages, x)
    jacobian = jnp.concatenate([lin.dense[0][None], at_nodes])
    reaction = jnp.swapaxes(matvec(lin.metric_inverse, jacobian), 1, 2)
    if terms is not None:
        return _first_order(stages, x, lin, terms, jacobian, reaction)
    rows, redundancy = jacobian[1:], stages.redundancy
    if redundancy is not None:
        rows = small_einsum("ab,ibn->ian", redundancy.projector, rows)
    blocks = small_einsum("ian,jnb->ijab", rows, reaction)
    schur, compliance = _schur(stages, blocks), blocks[-1, -1]
    if redundancy is not None:
        compliance = compliance + redundancy.rest
        schur = schur + redundancy.schur_rest(
            stages.method.stages, stages.num_nonholonomic
        )
    end = eqx.tree_at(
        lambda z: (z.jacobian, z.reaction, z.compliance_inverse),
        lin,
        (rows[-1], reaction[-1], inverse(compliance)),
    )
    return LeadingStructure(
        momentum_inverse=lin.momentum_inverse,
        reaction=reaction,
        velocity_reaction=(
            jnp.swapaxes(jacobian, 1, 2) if stages.hamiltonian else reaction
        ),
        schur_inverse=inverse(schur),
        end=end,
    )


def _first_order(
    stages: StageEquations,
    x: StageUnknowns,
    lin: Linearisation,
    terms: FirstOrderTerms,
    jacobian: Float[Array, "s l n"],
    reaction: Float[Array, "s n l"],
) -> LeadingStructure:
    """Make the leading structure with the terms of order h."""
    momenta = momenta_of_forces(stages, x, _reactions(stages, jacobian))
    on_stages, on_nodes = (
        jnp.swapaxes(matvec(lin.momentum_inverse, jnp.swapaxes(p, 1, 2)), 1, 2)
        for p in momenta
    )
    velocity = terms.of_stages(stages, on_stages)
    at_nodes = terms.of_nodes(on_nodes) + terms.by_force(stages, velocity)
    at_nodes = at_nodes + terms.by_position(stages, velocity)

    def constraints(velocity, at_nodes):
        moved = replace(x, velocity=velocity, node_fibre_coordinate=at_nodes)
        return jnp.concatenate(
            [value.reshape(-1) for value in constraint_values(stages, moved)]
        )

    _, push = jax.linearize(constraints, x.velocity, x.node_fibre_coordinate)
    schur = jax.vmap(push, in_axes=2, out_axes=1)(velocity, at_nodes)
    return LeadingStructure(
        momentum_inverse=lin.momentum_inverse,
        reaction=reaction,
        velocity_reaction=reaction,
        schur_inverse=inverse(schur),
        end=_with_inertia_at_end(lin, terms, jacobian[-1]),
        first_order=terms,
        responses=Responses(velocity, at_nodes),
    )


def _reactions(
    stages: StageEquations, jacobian: Float[Array, "s l n"]
) -> Float[Array, "s n c"]:
    """Compute the reactions Bᵀ at the stages to each unknown of the closure, each Λ."""
    m, one = stages.num_nonholonomic, jnp.eye(len(jacobian), dtype=jacobian.dtype)
    weights = stages.closure_weights("E")
    parts = [
        small_einsum("jmn,jr->jnrm", jacobian[:, :m], weights),
        small_einsum("jkn,ji->jnik", jacobian[:, m:], one),
    ]
    columns = [x.reshape(*x.shape[:2], x.shape[2] * x.shape[3]) for x in parts]
    return jnp.concatenate(columns, axis=2)


def _with_inertia_at_end(
    lin: Linearisation, terms: FirstOrderTerms, jacobian: Float[Array, "l n"]
) -> Linearisation:
    """Replace mass matrix and constraints of a linearisation by those at the end.

    Otherwise u̇ and λ_c at the end would converge no faster than without these terms.
    """
    inverse_at_start = full_momentum_inverse(lin)
    turned = small_einsum("kl,ln->kn", terms.node_inertia[-1], inverse_at_start)
    at_end = inverse_at_start - turned
    reaction = small_einsum("kn,ln->kl", at_end, jacobian)
    compliance_inverse = inverse(small_einsum("kn,nl->kl", jacobian, reaction))
    return eqx.tree_at(
        lambda z: (z.metric_inverse, z.jacobian, z.reaction, z.compliance_inverse),
        lin,
        (at_end, jacobian, reaction, compliance_inverse),
    )


def _sparse(
    stages: StageEquations, x: StageUnknowns, lin: Linearisation, start: SparseMatrix
) -> LeadingStructure:
    """Make the leading structure for constraints that share few coordinates."""
    pattern = start.pattern
    nodes = sparse_constraint_jacobian(stages, x, pattern)
    rows = SparseMatrix(jnp.concatenate([start.values[None], nodes.values]), pattern)
    products = couplings(rows[1:], rows, lin.metric_inverse)
    a, a_hat, b = (stages.coefficients(name) for name in ("a", "a_hat", "b"))
    if stages.num_nonholonomic:
        weights = a[1:, :, None] * stages.closure_weights("E")[None]
        schur = small_einsum("ijk,ijcbl->ikcbl", weights, products)
    else:
        weights = small_einsum("ik,kj->ij", a[1:], a_hat)
        on_positions = weights[:, :, None, None, None] * products
        tangency = b[:, None, None, None] * products[-1]
        schur = jnp.concatenate([on_positions, tangency[None]])
    reaction = WeightedTranspose(lin.metric_inverse, rows)
    end = eqx.tree_at(
        lambda z: (z.jacobian, z.reaction, z.compliance_inverse),
        lin,
        (
            rows[-1],
            reaction[-1],
            block_tridiagonal_inverse(products[-1:, -1:], pattern),
        ),
    )
    velocity_reaction = reaction
    if stages.hamiltonian:
        ones = jnp.ones_like(lin.metric_inverse)
        velocity_reaction = WeightedTranspose(ones, rows)
    return LeadingStructure(
        momentum_inverse=lin.momentum_inverse,
        reaction=reaction,
        velocity_reaction=velocity_reaction,
        schur_inverse=block_tridiagonal_inverse(schur, pattern),
        end=end,
    )


def _schur(
    stages: StageEquations, blocks: Float[Array, "r s l l"]
) -> Float[Array, "c c"]:
    """Assemble the derivative of the constraints by h δy and h δΛ.

    `blocks` are the products B_i K⁻¹ B_jᵀ for i >= 2 and all j.
    """
    m, k, s = stages.num_nonholonomic, stages.num_holonomic, stages.method.stages
    a, a_hat, b = (stages.coefficients(name) for name in ("a", "a_hat", "b"))
    rows = []
    if m:
        nodes = small_einsum("ij,ijab->iajb", a[1:], blocks[:, :, :m])
        rows.append(nodes.reshape((s - 1) * m, s, m + k))
    if k:
        positions = small_einsum(
            "ij,ijab->iajb", small_einsum("ik,kj->ij", a[1:], a_hat), blocks[:, :, m:]
        )
        rows.append(positions.reshape((s - 1) * k, s, m + k))
        rows.append(small_einsum("j,jab->ajb", b, blocks[-1, :, m:]))
    change = jnp.concatenate(rows)
    columns = []
    if m:
        closure = small_einsum(
            "cjb,jl->clb", change[:, :, :m], stages.closure_weights("E")
        )
        columns.append(closure.reshape(change.shape[0], -1))
    if k:
        columns.append(change[:, :, m:].reshape(change.shape[0], -1))
    return jnp.concatenate(columns, axis=1)
