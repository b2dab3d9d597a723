"""The engines that can compile a program on the CPU, and the reasons against them.

XLA runs a program on the CPU as a sequence of kernels. Starting a kernel takes about 50
ns, as long as arithmetic with tens of numbers. One iteration of a stage solver consists
of about fifty such kernels. If a called computation is marked as small, XLA compiles it
to a single kernel, including its loops. On the gallery's systems this is three to five
times faster than a sequence of kernels. The mark is internal to XLA, and its meaning
may change. Only the CPU uses the mark; without it, the results are the same.
"""

import os
from collections.abc import Callable
from contextvars import ContextVar
from typing import Any, NamedTuple, TypeVar

import jax
import jax.extend
import jax.numpy as jnp
from jax.interpreters import mlir
from jaxlib.mlir import ir

from ._jaxprs import fits_one_kernel, LARGEST_REDUCTION
from ._kernel import ENGINES, merge_lists, partition_list
from ._native import is_available


T = TypeVar("T")


class EngineUse(NamedTuple):
    """The engine that compiles one program, and the reason.

    - `engine`: `"lanes"` is nhjax's own compiler, which vectorises over the members of
        an ensemble (SIMD); `"kernels"` is XLA with one kernel for each member; `"xla"`
        is XLA with its usual sequence of kernels.
    - `reason`: why this engine was used, and why the engines that are tried before it
        were not used.
    - `members`: the number of members of an ensemble; `None` for a single run, and for
        a function that JAX computes alone, because effects or calls of Python leave no
        part to compile.
    """

    engine: str
    reason: str
    members: int | None


def chosen_engine() -> str | None:
    """Read `NHJAX_ENGINE` from the environment: the engine that the user chose."""
    chosen = os.environ.get("NHJAX_ENGINE")
    if chosen is not None and chosen not in ENGINES:
        raise ValueError(
            f"The environment variable NHJAX_ENGINE is {chosen!r}, which is none of "
            f"{', '.join(map(repr, ENGINES))}: set it to one of these, or unset it."
        )
    return chosen


# A list while `engines` lowers programs, otherwise `None`.
_uses: ContextVar[list[EngineUse] | None] = ContextVar("uses", default=None)


def record_engine(engine: str, reason: str, members: int | None) -> None:
    """Record which engine compiles a program, if `engines` asked for it."""
    uses = _uses.get()
    if uses is not None:
        uses.append(EngineUse(engine, reason, members))


def engines(function: Callable[..., Any], *args: Any) -> tuple[EngineUse, ...]:
    """Return which engines compile the programs of `function(*args)` on a CPU, and why.

    The programs are the runs of nhjax in the function, and the functions given to
    `nhjax.lanes.vmap` and `nhjax.lanes.jit`. The function is lowered, but not run. On
    the CPU, nhjax compiles an ensemble (a run under `jax.vmap`) itself if possible, and
    vectorises over its members (SIMD). The environment variable `NHJAX_ENGINE` chooses
    the engine: `lanes`, `kernels` or `xla`. If its value is `lanes`, a program that
    `lanes` cannot compile raises a `RuntimeError` with the reason. If the variable
    changes, programs that are already compiled are not compiled again until
    `jax.clear_caches()`.

    **Arguments:**

    - `function`: a function of arrays that can be compiled by `jax.jit`.
    - `args`: the arguments of the function, trees of arrays.

    **Returns:** an `EngineUse` for each program, in the order of compilation: the
    engine, the reason, and the number of members.

    !!! example

        ```python
        run = jax.vmap(lambda y0: nhjax.step(system, method, 0.0, 0.1, y0))
        for use in nhjax.engines(run, ensemble):
            print(use.engine, use.members, use.reason)
        ```
    """
    token = _uses.set(uses := [])
    try:
        # The lambda is a new function, so that JAX does not return a cached result.
        jax.jit(lambda *args: function(*args)).lower(*args)
    finally:
        _uses.reset(token)
    return tuple(uses)


# Whether a kernel is being lowered. A kernel inside another kernel is lowered as a part
# of the outer kernel.
_within = ContextVar("within", default=False)


def is_within_kernel() -> bool:
    """Return whether a part of a kernel is being lowered."""
    return _within.get()


# Whether the surrounding program is left to XLA. If so, its operations `batched_call`
# are left to XLA too.
_is_part = ContextVar("is_part", default=False)


def is_part_of_a_program() -> bool:
    """Return whether the current operation is part of a program that is left to XLA."""
    return _is_part.get()


def as_parts_of_a_program(lower: Callable[..., T]) -> Callable[..., T]:
    """Return `lower`, wrapped so that `is_part_of_a_program` is true while it runs."""

    def lower_all(*args: Any, **params: Any) -> T:
        token = _is_part.set(True)
        try:
            return lower(*args, **params)
        finally:
            _is_part.reset(token)

    return lower_all


def is_exported(ctx: Any) -> bool:
    """Return whether a program is lowered to be run by other processes."""
    return bool(ctx.module_context.lowering_parameters.for_export)


def reason_against_lanes() -> str | None:
    """Return why nhjax's own compiler is not tried, or `None` if it is tried."""
    if chosen_engine() not in ("lanes", None):
        return "chosen"
    if not is_available():
        return "llvmlite is not installed, or does not work here"
    return None


def reason_against_kernel(program: Any) -> str | None:
    """Return why XLA does not compile a single kernel, or `None` if it does."""
    if chosen_engine() == "xla":
        return "chosen"
    # The dtype of random keys has no attribute `kind`, so its kind is None here.
    kinds = {getattr(aval.dtype, "kind", None) for aval in program.in_avals}
    if not kinds <= set("fiub"):
        return "an operand is neither a real number nor an integer nor a boolean"
    if not fits_one_kernel(program.jaxpr):
        return "an operation is large, or calls a library"
    return None


def by_one_kernel(ctx, *operands, program, options):
    """Lower a program to one kernel of XLA."""
    del options
    run = jax.extend.core.jaxpr_as_fun(program)

    def call(*operands):
        # XLA would remove operands without elements, so the kernel does not receive
        # them.
        is_full = [x.size > 0 for x in operands]
        full, empty = partition_list(is_full, operands)

        def kernel(*full):
            return run(*merge_lists(is_full, _tied(full), map(jnp.zeros_like, empty)))

        # XLA would also remove constant operands. The barrier hides that they are
        # constant.
        return jax.jit(kernel)(*jax.lax.optimization_barrier(full))

    token = _within.set(True)
    try:
        lower = as_parts_of_a_program(mlir.lower_fun(call, multiple_results=True))
        results = lower(ctx, *operands)
    finally:
        _within.reset(token)
    attributes = {"xla_cpu_small_call": "true", "inlineable": "false"}
    results[0].owner.attributes["mhlo.frontend_attributes"] = ir.DictAttr.get(
        {key: ir.StringAttr.get(value) for key, value in attributes.items()}
    )
    return results


def _tied(operands: tuple[Any, ...]) -> list[Any]:
    """Return the same operands, in a form that XLA cannot recognise as unused.

    XLA aborts if a parameter of a marked call is unused, even if it becomes unused only
    by XLA's own simplifications. For this reason every small operand is made to depend
    on all operands, in a way that never changes its value.
    """
    firsts = [x.reshape(-1)[0] for x in operands]
    signs = [(x != jnp.zeros_like(x)).astype(jnp.int32) for x in firsts]
    never = jnp.sum(jnp.stack(signs)) < 0
    return [
        jnp.where(never, jnp.zeros_like(x), x) if x.size <= LARGEST_REDUCTION else x
        for x in operands
    ]
