"""Derivatives of programs that are compiled as a whole, forward and transposed."""

from typing import Any

import jax
import jax.core
import jax.extend
import jax.numpy as jnp
from jax.interpreters import ad

from ._collection import rare_collections
from ._kernel import call, kernel, run_program
from ._marks import merged, split


@rare_collections()
def differentiated(operands, tangents, *, program, is_brief=False):
    """Compute values and tangents in two kernels, the second linear in the tangents.

    There are two kernels so that reverse mode can keep the results of the first and
    transpose the second.
    """
    del is_brief
    run = jax.extend.core.jaxpr_as_fun(program)
    is_moving = [not isinstance(tangent, ad.Zero) for tangent in tangents]
    rates, _ = split(is_moving, tangents)
    is_smooth = [jnp.issubdtype(x.dtype, jnp.inexact) for x in program.out_avals]
    treedef = None

    def linearised(*operands):
        nonlocal treedef
        moving, fixed = split(is_moving, operands)

        def values(*moving):
            return split(is_smooth, run(*merged(is_moving, moving, fixed)))

        smooth, push, rest = jax.linearize(values, *moving, has_aux=True)
        residuals, treedef = jax.tree.flatten(push)
        return [*merged(is_smooth, smooth, rest), *residuals]

    try:
        whole = jax.make_jaxpr(linearised)(*operands)
    except ValueError:
        # What JAX cannot linearise, such as a while loop, has forward mode at least.
        all_rates = [ad.instantiate_zeros(tangent) for tangent in tangents]
        return jax.jvp(run, operands, all_rates)
    size = len(program.out_avals)
    # Residuals that depend on no operand are computed again and not kept: in a loop
    # they would be kept once for each round.
    fixed, is_varying = _fixed_part(whole)
    is_kept = [True] * size + is_varying[size:]
    kept, fixed_results = split(is_kept, whole.jaxpr.outvars)
    results = run_program(_part(whole, outvars=kept), list(operands))
    out, residuals = results[:size], results[size:]

    def push(*given):
        residuals, rates = given[: -sum(is_moving)], given[-sum(is_moving) :]
        constants = jax.extend.core.jaxpr_as_fun(
            _part(whole, invars=[], eqns=fixed, outvars=fixed_results)
        )()
        everything = merged(is_kept[size:], residuals, constants)
        return list(jax.tree.unflatten(treedef, everything)(*rates))

    changes = call(push, [*residuals, *rates])
    zeros = [ad.Zero(aval.to_tangent_aval()) for aval in program.out_avals]
    return out, merged(is_smooth, changes, split(is_smooth, zeros)[1])


def _fixed_part(program) -> tuple[list[Any], list[bool]]:
    """Find the operations that depend on no operand, and the results that do on one."""
    traced = [isinstance(const, jax.core.Tracer) for const in program.consts]
    varying = {*program.jaxpr.invars, *split(traced, program.jaxpr.constvars)[0]}

    def varies(x) -> bool:
        return not isinstance(x, jax.extend.core.Literal) and x in varying

    fixed = []
    for equation in program.eqns:
        if equation.effects or any(map(varies, equation.invars)):
            varying.update(equation.outvars)
        else:
            fixed.append(equation)
    return fixed, list(map(varies, program.jaxpr.outvars))


def _part(program, **fields: list[Any]):
    """Make a program of a part of another one's operations, operands or results."""
    jaxpr = program.jaxpr
    names = jaxpr.debug_info.with_unknown_names()
    return program.replace(jaxpr=jaxpr.replace(debug_info=names, **fields))


ad.primitive_jvps[kernel] = differentiated


@rare_collections()
def transposed(cotangents, *operands, program, is_brief=False):
    del is_brief
    run = jax.extend.core.jaxpr_as_fun(program)
    is_linear = [ad.is_undefined_primal(x) for x in operands]
    linear, known = split(is_linear, operands)
    is_asked = [not isinstance(cotangent, ad.Zero) for cotangent in cotangents]
    asked, _ = split(is_asked, cotangents)

    def pull(*given):
        known, asked = given[: -sum(is_asked)], given[-sum(is_asked) :]

        def push(*rates):
            return split(is_asked, run(*merged(is_linear, rates, known)))[0]

        transpose = jax.linear_transpose(push, *(x.aval for x in linear))
        return list(transpose(list(asked)))

    pulled = call(pull, [*known, *asked])
    return merged(is_linear, pulled, [None] * len(known))


ad.primitive_transposes[kernel] = transposed
