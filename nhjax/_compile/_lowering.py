"""Which engine compiles a program: chosen by the environment, and told on request.

A single run on the CPU: by nhjax's own compiler, or as one kernel of XLA's.

nhjax's own compiler makes scalars of all arrays, which is best while these are small.
For loops over larger arrays XLA uses vectors, also in a single run.

XLA runs a program on the CPU as a sequence of kernels, and each costs some 50 ns to
start, which is as long as the arithmetic of tens of numbers takes. An iteration on the
stages of a step is some fifty such kernels. A called computation that is marked as
small is compiled to a single kernel instead, its loops included; on the gallery's
systems that is three to five times faster.

The mark is internal to the compiler, and its meaning may change. Without the mark, as
on other devices, the results are the same.
"""

import os
from collections.abc import Callable
from contextvars import ContextVar
from typing import Any, NamedTuple

import jax
import jax.extend
import jax.numpy as jnp
from jax.interpreters import mlir
from jaxlib.mlir import ir

from ..lanes import compile_single, is_available, Unsupported
from ._garbage_collection import rare_collections
from ._jaxprs import array_size, is_elementary, LARGEST_REDUCTION
from ._kernel import kernel, merged, split


# In the order in which they are tried.
ENGINES = ("lanes", "kernels", "xla")


class EngineUse(NamedTuple):
    """The engine that compiles one program, and why it is this one.

    - `engine`: `"lanes"` is nhjax's own compiler, which runs the members of an ensemble
        in the lanes of vectors; `"kernels"` is XLA with one kernel for each member;
        `"xla"` is XLA without that.
    - `reason`: why no engine before it was taken, or that it was chosen.
    - `members`: the number of members of an ensemble; `None` for a single run.
    """

    engine: str
    reason: str
    members: int | None


def chosen_engine() -> str:
    """Read `NHJAX_ENGINE` from the environment: the first engine that may be taken."""
    chosen = os.environ.get("NHJAX_ENGINE", ENGINES[0])
    if chosen not in ENGINES:
        raise ValueError(
            f"The environment variable NHJAX_ENGINE is {chosen!r}, which is none of "
            f"{', '.join(map(repr, ENGINES))}: set it to one of these, or unset it."
        )
    return chosen


# A list while programs are lowered for `engines`, else None.
_uses: ContextVar[list[EngineUse] | None] = ContextVar("uses", default=None)


def note(engine: str, reason: str, members: int | None) -> None:
    """Take down which engine a program is compiled by, if anyone has asked."""
    uses = _uses.get()
    if uses is not None:
        uses.append(EngineUse(engine, reason, members))


def engines(function: Callable[..., Any], *args: Any) -> tuple[EngineUse, ...]:
    """Tell which engines compile the programs of `function(*args)` on a CPU, and why.

    The function is compiled, but not run. On the CPU an ensemble, which is a run
    under `jax.vmap`, is compiled by nhjax itself if it can, so that its members run in
    the lanes of vectors. The environment variable `NHJAX_ENGINE` with one of the values
    `lanes` (the default), `kernels` and `xla` sets the first engine that is tried; what
    has been compiled before keeps its engine until `jax.clear_caches()`.

    **Arguments:**

    - `function`: a function of arrays that can be compiled by `jax.jit`.
    - `args`: its arguments, trees of arrays.

    **Returns:** an `EngineUse` for each program, in the order of compilation: the
    engine, the reason why it is this one, and the number of members.

    !!! example

        ```python
        run = jax.vmap(lambda y0: nhjax.step(system, method, 0.0, 0.1, y0))
        for use in nhjax.engines(run, ensemble):
            print(use.engine, use.members, use.reason)
        ```
    """
    token = _uses.set(uses := [])
    try:
        # A function of its own: nothing that is cached is taken for it.
        jax.jit(lambda *args: function(*args)).lower(*args)
    finally:
        _uses.reset(token)
    return tuple(uses)


# Whether a kernel is being lowered; kernels inside of it do not become kernels of their
# own.
_within = ContextVar("within", default=False)


def is_within_kernel() -> bool:
    """Tell whether what is being lowered is a part of a kernel."""
    return _within.get()


def is_exported(ctx: Any) -> bool:
    """Tell whether a program is lowered to be run by other processes."""
    return bool(ctx.module_context.lowering_parameters.for_export)


def reason_against_lanes() -> str | None:
    """Say why nhjax's own compiler is not asked for; `None` if it is."""
    if chosen_engine() != "lanes":
        return "chosen"
    if is_within_kernel():
        return "it is a part of a kernel"
    if not is_available():
        return "llvmlite is not installed, or does not work here"
    return None


def reason_against_kernel(program: Any) -> str | None:
    """Say why XLA is not asked for one kernel, or cannot make it; `None` if it can."""
    if chosen_engine() == "xla":
        return "chosen"
    # The dtype of random keys has no attribute `kind`, which gives None here.
    kinds = {getattr(aval.dtype, "kind", None) for aval in program.in_avals}
    if not kinds <= set("fiub"):
        return "an operand is neither a real number nor an integer nor a boolean"
    if not is_elementary(program.jaxpr):
        return "an operation is large, or calls a library"
    return None


# Of the gallery's systems with 2 to 8 stages, and larger ones, those whose arrays have
# fewer numbers than this run faster by nhjax's own compiler, and the others by XLA's.
_SMALL_ARRAYS = 40


@rare_collections()
def _lowered(ctx, *operands, program, is_brief):
    if is_exported(ctx):
        # Machine code of this process would mean nothing to another.
        note("xla", "the program is exported", None)
        return _by_xla(ctx, *operands, program=program, is_brief=is_brief)
    if is_within_kernel():
        return _by_xla(ctx, *operands, program=program, is_brief=is_brief)
    reason = reason_against_lanes()
    if reason is None and array_size(program.jaxpr) > _SMALL_ARRAYS:
        reason = "its arrays are so large that XLA uses vectors for them"
    if reason is None:
        try:
            name = compile_single(program, is_brief)
        except Unsupported as error:
            reason = str(error)
        else:
            note("lanes", "the first choice", None)
            return jax.ffi.ffi_lowering(name)(ctx, *operands)
    against = reason_against_kernel(program)
    if against is not None:
        note("xla", against, None)
        return _by_xla(ctx, *operands, program=program, is_brief=is_brief)
    note("kernels", reason, None)
    return _marked(ctx, *operands, program=program)


def _marked(ctx, *operands, program):
    run = jax.extend.core.jaxpr_as_fun(program)

    def call(*operands):
        # The compiler would remove operands without elements: they are left out here.
        is_full = [x.size > 0 for x in operands]
        full, empty = split(is_full, operands)

        def kernel(*full):
            return run(*merged(is_full, _tied(full), map(jnp.zeros_like, empty)))

        # The barrier hides which operands are constants: those would be removed too.
        return jax.jit(kernel)(*jax.lax.optimization_barrier(full))

    token = _within.set(True)
    try:
        results = mlir.lower_fun(call, multiple_results=True)(ctx, *operands)
    finally:
        _within.reset(token)
    attributes = {"xla_cpu_small_call": "true", "inlineable": "false"}
    results[0].owner.attributes["mhlo.frontend_attributes"] = ir.DictAttr.get(
        {key: ir.StringAttr.get(value) for key, value in attributes.items()}
    )
    return results


def _tied(operands: tuple[Any, ...]) -> list[Any]:
    """Return the same operands, made so that the compiler cannot find one unused.

    The compiler aborts if a parameter of a marked call is not used, even if this turns
    out only after all simplifications. For this reason every small operand is made to
    depend on all others in a way that never changes its value.
    """
    firsts = [x.reshape(-1)[0] for x in operands]
    signs = [(x != jnp.zeros_like(x)).astype(jnp.int32) for x in firsts]
    never = jnp.sum(jnp.stack(signs)) < 0
    return [
        jnp.where(never, jnp.zeros_like(x), x) if x.size <= LARGEST_REDUCTION else x
        for x in operands
    ]


def _plain(*operands, program, is_brief):
    del is_brief
    return jax.extend.core.jaxpr_as_fun(program)(*operands)


_by_xla = mlir.lower_fun(_plain, multiple_results=True)
mlir.register_lowering(kernel, _by_xla, cacheable=False)
mlir.register_lowering(kernel, _lowered, platform="cpu", cacheable=False)
