"""Functions that are applied to each row of some arrays, as one operation of a program.

One operation keeps programs short. With a copy of a long function for each row, such
as each stage of a method, a program and the time to compile it would grow with the
number of rows.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.extend
import jax.numpy as jnp

from ..lanes import (
    batched_call,
    CompileOptions,
    cse_dce,
    num_results,
    split_by_operands,
)


T = TypeVar("T")

# Functions that compute fewer numbers than this for all rows together are not put in a
# loop, because a loop would save little compile time.
SHORTEST_IN_LOOP = 2000


def vmapped(function: Callable[..., T], *rows: Any, out_axis: int = 0) -> T:
    """Compute `jax.vmap(function)(*rows)`, with a long function as one operation.

    Within a program that nhjax's own compiler compiles, the operation is a loop over
    the rows, so that the time of compilation does not grow with the number of rows. The
    operations that do not depend on the rows are computed once, before the loop.

    **Arguments:**

    - `function`: a function of trees of arrays, with arrays as results.
    - `rows`: trees of arrays that have the same first axis.
    - `out_axis`: the axis of the results that lists the rows.
    """
    # With `jax.disable_jit`, the user wants to step through single operations.
    if jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
        return jax.vmap(function, out_axes=out_axis)(*rows)
    row = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), rows)
    program, results = jax.make_jaxpr(function, return_shape=True)(*row)
    program, structure = cse_dce(program), jax.tree.structure(results)
    if program.effects:
        return jax.vmap(function, out_axes=out_axis)(*rows)
    shared, program = split_by_operands(program)
    leaves = jax.tree.leaves(rows)
    number = leaves[0].shape[0]
    if number == 1 or number * num_results(program.jaxpr) < SHORTEST_IN_LOOP:
        in_axes = [*[None] * len(shared), *[0] * len(leaves)]
        run = jax.extend.core.jaxpr_as_fun(program)
        out = jax.vmap(run, in_axes, out_axis)(*shared, *leaves)
        return jax.tree.unflatten(structure, out)
    marks = (False,) * len(shared) + (True,) * len(leaves)
    given = {"program": program, "is_batched": marks, "options": CompileOptions()}
    out = batched_call.bind(*shared, *leaves, **given)
    return jax.tree.unflatten(structure, [jnp.moveaxis(x, 0, out_axis) for x in out])
