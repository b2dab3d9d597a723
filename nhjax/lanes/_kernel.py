"""The operation for a program that is compiled as a whole, and its derivatives.

`run_program` binds a program as one operation, `cpu_kernel`. The forward derivative of
this operation is a pair of such operations: one computes the values, and the other is
linear in the tangents. Reverse mode transposes the linear operation. `_program` decides
how a program is compiled, depending on the device and on the operations of the program.
"""

from collections.abc import Iterable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.core
import jax.extend
import jax.numpy as jnp
from jax.interpreters import ad

from ._garbage_collection import rare_collections
from ._jaxprs import cse_dce, variables


# The engines, in the order in which they are tried.
ENGINES = ("lanes", "kernels", "xla")


class CompileOptions(NamedTuple):
    """How a program is compiled.

    - `is_brief`: whether the program runs once and for a short time. Such a program
        is compiled in less time, to slower code.
    - `engines`: the engines that may compile the program and its derivatives, in the
        order in which they are tried.
    - `xla_below`: if XLA compiles the surrounding program, it also compiles programs
        with fewer operations than this, because a call of native code would take longer
        than these few operations.
    - `note`: text that `nhjax.engines` adds to the reason for the choice of the engine.
    """

    is_brief: bool = False
    engines: tuple[str, ...] = ENGINES
    xla_below: int = 0
    note: str = ""


def run_program(program: Any, leaves: list[Any], options: CompileOptions) -> list[Any]:
    """Compute a program as one operation if possible, otherwise operation by operation.

    **Arguments:**

    - `program`: a closed jaxpr.
    - `leaves`: the operands of the program.
    - `options`: how the program is compiled.
    """
    program = cse_dce(program)
    # A primitive must receive all traced values as operands, and must have no effects,
    # such as printing.
    if program.effects or captures_tracers(program):
        return jax.extend.core.jaxpr_as_fun(program)(*leaves)
    return kernel.bind(*leaves, program=program, options=options)


def captures_tracers(program: Any) -> bool:
    """Return whether a closed jaxpr has constants that another trace computes."""
    return any(isinstance(const, jax.core.Tracer) for const in program.consts)


def never_high(*_: Any, **__: Any) -> bool:
    """Tell JAX not to expand the operations of a program before lowering it.

    Since JAX 0.12, some operations ("high" primitives) are expanded to simpler
    operations. A primitive whose program contains high primitives would need a rule
    that expands them (`to_lojax`). Here they are expanded when the program is lowered.
    """
    return False


kernel = jax.extend.core.Primitive("cpu_kernel")
kernel.multiple_results = True
kernel.is_high = never_high


@kernel.def_impl
def _run(*operands, program, options):
    if jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
        # The kernel was traced before JIT was disabled. `jax.jit` would now call this
        # rule again, without end.
        return jax.extend.core.jaxpr_as_fun(program)(*operands)
    run = partial(kernel.bind, program=program, options=options)
    return jax.jit(run)(*operands)


@kernel.def_abstract_eval
def _shapes(*operands, program, options):
    del operands, options
    return program.out_avals


@rare_collections()
def kernel_jvp(operands, tangents, *, program, options):
    """Compute values and tangents in two kernels, the second linear in the tangents.

    There are two kernels so that reverse mode can store the results of the first kernel
    and transpose the second kernel.
    """
    options = options._replace(is_brief=False)
    run = jax.extend.core.jaxpr_as_fun(program)
    is_moving = [not isinstance(tangent, ad.Zero) for tangent in tangents]
    rates, _ = partition_list(is_moving, tangents)
    is_smooth = [jnp.issubdtype(x.dtype, jnp.inexact) for x in program.out_avals]
    treedef = None

    def linearised(*operands):
        nonlocal treedef
        moving, fixed = partition_list(is_moving, operands)

        def values(*moving):
            return partition_list(
                is_smooth, run(*merge_lists(is_moving, moving, fixed))
            )

        smooth, push, rest = jax.linearize(values, *moving, has_aux=True)
        residuals, treedef = jax.tree.flatten(push)
        return [*merge_lists(is_smooth, smooth, rest), *residuals]

    try:
        whole = jax.make_jaxpr(linearised)(*operands)
    except ValueError:
        # JAX cannot linearise some programs, such as while loops. They have forward
        # mode only.
        all_rates = [ad.instantiate_zeros(tangent) for tangent in tangents]
        return jax.jvp(run, operands, all_rates)
    size = len(program.out_avals)
    # Residuals that depend on no operand are recomputed and not stored: in a loop, they
    # would be stored again in each iteration.
    fixed, is_varying = _fixed_part(whole)
    is_kept = [True] * size + is_varying[size:]
    kept, fixed_results = partition_list(is_kept, whole.jaxpr.outvars)
    results = run_program(part_of(whole, outvars=kept), list(operands), options)
    out, residuals = results[:size], results[size:]

    def push(*given):
        residuals, rates = given[: -sum(is_moving)], given[-sum(is_moving) :]
        constants = jax.extend.core.jaxpr_as_fun(
            part_of(whole, invars=[], eqns=fixed, outvars=fixed_results)
        )()
        everything = merge_lists(is_kept[size:], residuals, constants)
        return list(jax.tree.unflatten(treedef, everything)(*rates))

    given = [*residuals, *rates]
    changes = run_program(jax.make_jaxpr(push)(*given), given, options)
    zeros = [ad.Zero(aval.to_tangent_aval()) for aval in program.out_avals]
    return out, merge_lists(is_smooth, changes, partition_list(is_smooth, zeros)[1])


def _fixed_part(program) -> tuple[list[Any], list[bool]]:
    """Return the operations that depend on no operand of the program.

    The second result marks the results of the program that depend on an operand.
    """
    traced = [isinstance(const, jax.core.Tracer) for const in program.consts]
    constants = partition_list(traced, program.jaxpr.constvars)[0]
    fixed, _, varying = _split([*program.jaxpr.invars, *constants], program.eqns)
    results = program.jaxpr.outvars
    return fixed, [not varying.isdisjoint(variables([x])) for x in results]


def split_by_operands(program) -> tuple[list[Any], Any]:
    """Compute the operations that depend on no operand; return a program for the rest.

    Returns the computed values that the program for the rest uses, and this program,
    whose first operands are these values.
    """
    jaxpr = program.jaxpr
    fixed, others, varying = _split(jaxpr.invars, jaxpr.eqns)
    used = [v for equation in others for v in variables(equation.invars)]
    used += variables(jaxpr.outvars)
    names = list(dict.fromkeys(v for v in used if v not in varying))
    values = jax.extend.core.jaxpr_as_fun(
        part_of(program, invars=[], eqns=fixed, outvars=names)
    )()
    invars = [*names, *jaxpr.invars]
    return values, part_of(program, [], constvars=[], invars=invars, eqns=others)


def _split(
    operands: list[Any], equations: list[Any]
) -> tuple[list[Any], list[Any], set[Any]]:
    """Split operations into operations that depend on no operand, and all others.

    Operations with effects count as dependent. The third result is the set of the
    operands and of all variables that depend on them.
    """
    varying, fixed, others = set(operands), [], []
    for equation in equations:
        if equation.effects or not varying.isdisjoint(variables(equation.invars)):
            varying.update(equation.outvars)
            others.append(equation)
        else:
            fixed.append(equation)
    return fixed, others, varying


def part_of(program, consts: list[Any] | None = None, **fields: Any):
    """Return a program with some of its fields replaced.

    `fields` are new values for fields of the jaxpr, such as `eqns`, `invars`,
    `constvars` or `outvars`.
    """
    names = program.jaxpr.debug_info.with_unknown_names()
    jaxpr = program.jaxpr.replace(debug_info=names, **fields)
    return jax.extend.core.ClosedJaxpr(
        jaxpr, program.consts if consts is None else consts
    )


ad.primitive_jvps[kernel] = kernel_jvp


@rare_collections()
def kernel_transpose(cotangents, *operands, program, options):
    run = jax.extend.core.jaxpr_as_fun(program)
    is_linear = [ad.is_undefined_primal(x) for x in operands]
    linear, known = partition_list(is_linear, operands)
    is_asked = [not isinstance(cotangent, ad.Zero) for cotangent in cotangents]
    asked, _ = partition_list(is_asked, cotangents)

    def pull(*given):
        known, asked = given[: -sum(is_asked)], given[-sum(is_asked) :]

        def push(*rates):
            return partition_list(is_asked, run(*merge_lists(is_linear, rates, known)))[
                0
            ]

        transpose = jax.linear_transpose(push, *(x.aval for x in linear))
        return list(transpose(list(asked)))

    given = [*known, *asked]
    pulled = run_program(jax.make_jaxpr(pull)(*given), given, options)
    return merge_lists(is_linear, pulled, [None] * len(known))


ad.primitive_transposes[kernel] = kernel_transpose


def partition_list(
    marks: Iterable[bool], xs: Iterable[Any]
) -> tuple[list[Any], list[Any]]:
    """Split a list into the entries whose mark is true, and the other entries."""
    pairs = list(zip(marks, xs, strict=True))
    return [x for mark, x in pairs if mark], [x for mark, x in pairs if not mark]


def merge_lists(
    marks: Iterable[bool], marked: Iterable[Any], others: Iterable[Any]
) -> list[Any]:
    """Merge the two lists that `partition_list` returns, in the original order."""
    marked, others = iter(marked), iter(others)
    return [next(marked) if mark else next(others) for mark in marks]
