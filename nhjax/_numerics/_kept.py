"""The user's functions, each traced and differentiated once.

A run needs the Lagrangian of a system and its derivatives at more than ten places. JAX
would trace and differentiate the Lagrangian again at each place, which would take most
of the time of a first call. Here a function becomes one operation, `kept_call`, whose
program is traced once. The programs of its derivatives are stored together with this
program, and later runs reuse all of them.
"""

from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.extend
import jax.numpy as jnp
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, PyTree

from .._compile import captured_by, SHORTEST_IN_LOOP
from ..lanes import (
    batched_call,
    captures_tracers,
    CompileOptions,
    cse_dce,
    KEPT_CALL,
    never_high,
    num_results,
    run_program,
)
from ._contraction import with_small_products


# The programs of at most this many functions are stored. If there are more, the
# programs of the least recently used function are removed.
_MOST_FUNCTIONS = 32


class KeptFunction(eqx.Module):
    """A traced function, called as one operation; its leaves are arrays that it reads.

    Call an instance with trees that have the structure of the example with which the
    function was traced. Leaves that are not arrays always have the values that they
    have in the example. The operation can be differentiated with respect to all arrays
    that the function reads.
    """

    # The type is not `jax.Array`, because JAX has other types for some constants.
    operands: list[Any]
    program: "_Program" = eqx.field(static=True)
    structure: Any = eqx.field(static=True)

    def __call__(self, *args: Any) -> PyTree[Array]:
        """Compute the function for these arguments."""
        given = jax.tree.leaves(eqx.filter(args, eqx.is_array))
        kinds = self.program.closed.in_avals[len(self.operands) :]
        # The arguments are converted to the dtypes for which the program was traced.
        given = [
            x if x.dtype == y.dtype else jnp.asarray(x, y.dtype)
            for x, y in zip(given, kinds, strict=True)
        ]
        # With `jax.disable_jit`, the user wants to step through single operations.
        inlined = jax.config.jax_disable_jit  # pyright: ignore[reportAttributeAccessIssue]
        compute = self.program.run if inlined else self.program.bind
        return jax.tree.unflatten(self.structure, compute(*self.operands, *given))


_known: OrderedDict[Hashable, KeptFunction] = OrderedDict()


def kept_function(
    function: Callable[..., PyTree[Array]], *example: Any
) -> KeptFunction | None:
    """Trace a function for arguments with the structure and the types of an example.

    Types are shapes and dtypes. If the same function is traced again for arguments of
    the same types, and the values that it reads have not changed, its programs are
    reused. The result is None if the function must not become one operation: if it has
    effects, such as printing, or if its arguments or constants are sharded over
    devices.

    **Arguments:**

    - `function`: a function, or a tree that can be called. Its arrays become operands
        of the operation.
    - `example`: arguments of the function: trees of arrays and other objects.
    """
    arrays, others = eqx.partition((function, example), eqx.is_array)
    leaves, structure = jax.tree.flatten(arrays)
    if not all(map(_is_plain, leaves)):
        return None
    kinds = tuple(map(_kind, leaves))
    captured = captured_by(function, example)
    key = structure, kinds, tuple(captured.atoms), _settings()
    found = _known.pop(key, None)
    own = leaves[: len(jax.tree.leaves(arrays[0]))]
    if found is None:
        results = None

        def flat(*leaves):
            nonlocal results
            arrays = jax.tree.unflatten(structure, leaves)
            function, example = eqx.combine(arrays, others)
            found, results = jax.tree.flatten(function(*example))
            return [jnp.asarray(x) for x in found]

        closed = cse_dce(jax.make_jaxpr(flat)(*kinds))
        consts = list(closed.consts)
        if closed.effects or not all(map(_is_plain, consts)):
            return None

        def with_operands(*leaves):
            given, rest = leaves[: len(consts)], leaves[len(consts) :]
            run = jax.extend.core.ClosedJaxpr(closed.jaxpr, list(given))
            return jax.extend.core.jaxpr_as_fun(run)(*rest)

        program = _traced(with_operands, [*map(_kind, consts), *kinds])
        if captures_tracers(closed) or not captured.is_repeatable:
            return KeptFunction([*consts, *own], program, results)
        found = KeptFunction(consts, program, results)
    _known[key] = found
    if len(_known) > _MOST_FUNCTIONS:
        _known.popitem(last=False)
    return KeptFunction([*found.operands, *own], found.program, found.structure)


def _is_plain(x: Any) -> bool:
    """Return whether an array is not sharded over devices."""
    kind = jax.typeof(x)
    return kind == jax.core.ShapedArray(kind.shape, kind.dtype, kind.weak_type)


def _kind(x: Any) -> jax.ShapeDtypeStruct:
    """Return the shape and dtype of an array, a tracer or a number."""
    kind = jax.typeof(x)
    return jax.ShapeDtypeStruct(kind.shape, kind.dtype, weak_type=kind.weak_type)


@jax.jit
def _unchanged(x: Array) -> Array:
    return x


def _settings() -> Hashable:
    """Return a value that depends on the settings of JAX that change programs.

    JAX traces a function again if such a setting has changed.
    """
    return _unchanged.trace(jax.ShapeDtypeStruct((), jnp.int32)).jaxpr


class _Program:
    """A program with the programs of its derivatives, each traced on its first use."""

    def __init__(self, closed: Any):
        # The attribute is not named `jaxpr`, because searches for the inner programs of
        # an operation would then find the program twice.
        self.closed = closed
        self._derived: dict[Any, _Program] = {}

    @property
    def run(self) -> Callable[..., list[Any]]:
        """The program as a function."""
        return jax.extend.core.jaxpr_as_fun(self.closed)

    def bind(self, *operands: Any) -> list[Any]:
        """Compute the program as one operation."""
        return kept_call.bind(*operands, jaxpr=self.closed, kept=self)

    def derived(self, key: Any, function: Any, operands: Sequence[Any]) -> "_Program":
        """Return the program of a function derived from this program.

        It is traced at the first call. `key` identifies the function.
        """
        kinds = tuple(map(_kind, operands))
        if (key, kinds) not in self._derived:
            self._derived[key, kinds] = _traced(function, kinds)
        return self._derived[key, kinds]


def _traced(function: Callable[..., list[Any]], kinds: Sequence[Any]) -> _Program:
    program = jax.make_jaxpr(function)(*kinds)
    names = {equation.primitive.name for equation in program.jaxpr.eqns}
    if not names.isdisjoint(("dot_general", "jit")):
        program = jax.make_jaxpr(with_small_products(program))(*kinds)
    return _Program(cse_dce(program))


kept_call = jax.extend.core.Primitive(KEPT_CALL)
kept_call.multiple_results = True
kept_call.is_high = never_high


@kept_call.def_impl
def _run(*operands: Any, jaxpr: Any, kept: _Program) -> list[Any]:
    return jax.jit(kept.run)(*operands)


@kept_call.def_abstract_eval
def _shapes(*operands: Any, jaxpr: Any, kept: _Program) -> list[Any]:
    return jaxpr.out_avals


def _inlined(*operands: Any, jaxpr: Any, kept: _Program) -> list[Any]:
    return kept.run(*operands)


# In a program that XLA compiles, functions with fewer operations than this are compiled
# by XLA too: calling native code takes longer than evaluating the function of a
# textbook system. The number was measured on the gallery's systems that XLA compiles,
# mainly for methods with 6 to 8 stages.
_XLA_BELOW = 300


def _in_kernel(*operands: Any, jaxpr: Any, kept: _Program) -> list[Any]:
    # The engine `kernels` is left out: XLA aborts if it compiles a kernel whose results
    # are all constants.
    engines = "lanes", "xla"
    options = CompileOptions(is_brief=True, engines=engines, xla_below=_XLA_BELOW)
    return run_program(jaxpr, list(operands), options)


# JAX must not cache a lowered program, because a program is lowered differently inside
# and outside of a kernel. On the CPU, `run_program` compiles long programs without XLA,
# because XLA takes milliseconds to compile each operation.
for _lower, _platform in ((_inlined, None), (_in_kernel, "cpu")):
    mlir.register_lowering(
        kept_call,
        mlir.lower_fun(_lower, multiple_results=True),
        platform=_platform,
        cacheable=False,
    )


def _jvp(primals, tangents, *, jaxpr: Any, kept: _Program):
    """Compute values by one operation and their tangents by another, linear one."""
    out = kept.bind(*primals)
    moving = tuple(not isinstance(x, ad.Zero) for x in tangents)
    rates = [x for x in tangents if not isinstance(x, ad.Zero)]

    def push(*operands):
        primals, rates = operands[: len(moving)], iter(operands[len(moving) :])
        chosen = [x for x, moves in zip(primals, moving, strict=True) if moves]

        def function(*chosen):
            given = iter(chosen)
            pairs = zip(primals, moving, strict=True)
            return kept.run(*(next(given) if moves else x for x, moves in pairs))

        return jax.jvp(function, chosen, list(rates))[1]

    given = [*primals, *rates]
    return out, kept.derived(("push", moving), push, given).bind(*given)


def _transpose(cotangents, *operands, jaxpr: Any, kept: _Program):
    """Compute the transposed linear function as one operation."""
    linear = tuple(ad.is_undefined_primal(x) for x in operands)
    asked = tuple(not isinstance(x, ad.Zero) for x in cotangents)
    avals = [x.aval for x in operands if ad.is_undefined_primal(x)]

    def pull(*given):
        known, asked_for = (
            iter(given[: linear.count(False)]),
            given[linear.count(False) :],
        )
        fixed = [None if x else next(known) for x in linear]

        def push(*rates):
            moved = iter(rates)
            pairs = zip(fixed, linear, strict=True)
            out = kept.run(*(next(moved) if moves else x for x, moves in pairs))
            return [x for x, wanted in zip(out, asked, strict=True) if wanted]

        return list(jax.linear_transpose(push, *avals)(list(asked_for)))

    given = [x for x in operands if not ad.is_undefined_primal(x)]
    given += [x for x in cotangents if not isinstance(x, ad.Zero)]
    pulled = iter(kept.derived(("pull", linear, asked), pull, given).bind(*given))
    return [next(pulled) if x else None for x in linear]


def _batched(operands, axes, *, jaxpr: Any, kept: _Program):
    sizes = [x.shape[a] for x, a in zip(operands, axes, strict=True) if a is not None]
    if sizes[0] * num_results(jaxpr.jaxpr) >= SHORTEST_IN_LOOP:
        # A long program for many members becomes a loop over the members.
        marks = tuple(axis is not None for axis in axes)
        moved = [
            x if axis is None else jnp.moveaxis(x, axis, 0)
            for x, axis in zip(operands, axes, strict=True)
        ]
        options = CompileOptions(is_brief=True)
        given = {"program": jaxpr, "is_batched": marks, "options": options}
        out = batched_call.bind(*moved, **given)
        return out, [0] * len(out)

    def function(*operands):
        return jax.vmap(kept.run, tuple(axes))(*operands)

    key = "vmap", tuple(axes)
    out = kept.derived(key, function, operands).bind(*operands)
    return out, [0] * len(out)


ad.primitive_jvps[kept_call] = _jvp
ad.primitive_transposes[kept_call] = _transpose
batching.primitive_batchers[kept_call] = _batched
