"""Functions of a robot that are traced and differentiated once.

A program of nhjax needs the Lagrangian of a system and its derivatives at more than ten
places, and JAX traces and differentiates a function again at each of them. The
functions of a robot are long, so that this would take most of the time of a first call.
Here a function becomes one operation, `kept_call`, whose program is traced once. The
programs of its derivatives are kept with it.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.extend
import jax.numpy as jnp
import numpy as np
from jax.interpreters import ad, batching, mlir
from jaxtyping import PyTree

from .._compile import SHORTEST_IN_LOOP
from .._numerics import with_small_products
from .._system import static_function
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


class Kept(eqx.Module):
    """The same function of some trees of arrays, as one operation of a program.

    `function` is a function or a callable tree, whose arrays are operands too.
    """

    function: Callable[..., PyTree[Any]] = eqx.field(converter=static_function)
    _programs: Any = eqx.field(
        static=True, init=False, default_factory=lambda: _Programs()
    )

    def call(self, *args: Any) -> PyTree[Any]:
        """Compute the function."""
        # With `jax.disable_jit`, the user wants to step through single operations.
        if jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
            return self.function(*args)
        arrays, others = eqx.partition((self.function, args), _is_number)
        leaves, structure = jax.tree.flatten(arrays)
        leaves = [jnp.asarray(x) for x in leaves]
        kinds = tuple((x.shape, x.dtype) for x in leaves)
        rest, rest_structure = jax.tree.flatten(others)
        key = structure, kinds, tuple(rest), rest_structure
        found = self._programs.get(key)
        if found is None:
            results = None

            def flat(*leaves):
                nonlocal results
                arrays = jax.tree.unflatten(structure, leaves)
                function, args = eqx.combine(arrays, others)
                found, results = jax.tree.flatten(function(*args))
                return found

            program = _traced(flat, kinds)
            if captures_tracers(program.jaxpr):
                return self.function(*args)
            found = program, results
            self._programs[key] = found
        program, results = found
        return jax.tree.unflatten(results, program.bind(*leaves))


class KeptSlips(Kept):
    """Nonholonomic constraints as one operation."""

    def __call__(self, t: Any, q: PyTree[Any], v: Any, args: Any) -> PyTree[Any]:
        """Compute the constraints."""
        return self.call(t, q, v, args)


class KeptPositions(Kept):
    """Holonomic constraints as one operation."""

    def __call__(self, t: Any, q: PyTree[Any], args: Any) -> PyTree[Any]:
        """Compute the constraints."""
        return self.call(t, q, args)


class _Programs(dict[Any, Any]):
    """A cache that is compared by identity, so that it can be a part of a structure."""

    __hash__ = object.__hash__  # pyright: ignore[reportAssignmentType]
    __eq__ = object.__eq__


def _is_number(x: Any) -> bool:
    return isinstance(x, jax.Array | np.ndarray | np.generic | float | int)


class _Program:
    """A program with the programs of its derivatives, each traced on its first use."""

    def __init__(self, jaxpr: Any):
        self.jaxpr = jaxpr
        self._derived: dict[Any, _Program] = {}

    @property
    def run(self) -> Callable[..., list[Any]]:
        """The program as a function."""
        return jax.extend.core.jaxpr_as_fun(self.jaxpr)

    def bind(self, *operands: Any) -> list[Any]:
        """Compute the program as one operation."""
        return kept_call.bind(*operands, jaxpr=self.jaxpr, kept=self)

    def derived(self, key: Any, function: Any, operands: Sequence[Any]) -> "_Program":
        """Return the program of a function of this one, which `key` identifies."""
        kinds = tuple((x.shape, x.dtype) for x in operands)
        if (key, kinds) not in self._derived:
            self._derived[key, kinds] = _traced(function, kinds)
        return self._derived[key, kinds]


def _traced(function: Callable[..., list[Any]], kinds: Sequence[Any]) -> _Program:
    example = [jax.ShapeDtypeStruct(*kind) for kind in kinds]
    program = jax.make_jaxpr(function)(*example)
    names = {equation.primitive.name for equation in program.jaxpr.eqns}
    if not names.isdisjoint(("dot_general", "jit")):
        program = jax.make_jaxpr(with_small_products(program))(*example)
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


def _in_kernel(*operands: Any, jaxpr: Any, kept: _Program) -> list[Any]:
    return run_program(jaxpr, list(operands), CompileOptions(is_brief=True))


# XLA takes milliseconds to compile each operation, and these programs are long.
mlir.register_lowering(kept_call, mlir.lower_fun(_inlined, multiple_results=True))
mlir.register_lowering(
    kept_call, mlir.lower_fun(_in_kernel, multiple_results=True), platform="cpu"
)


def _jvp(primals, tangents, *, jaxpr: Any, kept: _Program):
    """Compute the values and their tangents by two operations, the second linear."""
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
        # A long program is a loop over the members.
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
