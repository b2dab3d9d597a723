"""`vmap` and `jit`, which compile the user's functions as whole programs.

The function is traced to a program, which becomes one operation (`_kernel`). Under
`jax.vmap` this operation becomes one operation for all members (`_batched_call`). Both
operations have rules for derivatives. `_program` lowers them to native code, or leaves
them to XLA.

Calls of Python, such as `jax.debug.print` or the error checks of other libraries,
cannot be part of such an operation. JAX computes these calls before or after the
operation (`_parts`).
"""

import inspect
from collections.abc import Callable, Hashable
from functools import partial, wraps
from typing import Any

import jax
import jax.core
import jax.extend
import numpy as np

from ._engines import record_engine
from ._jaxprs import variables
from ._kernel import (
    CompileOptions,
    merge_lists,
    part_of,
    partition_list,
    run_program,
)
from ._parts import evaluate, inlined, parts, python_calls, read, start


# The engine `kernels` is left out: its kernels compute one member after the other,
# which for large arrays takes longer than JAX's own `vmap`.
_OPTIONS = CompileOptions(engines=("lanes", "xla"))
# Constants with more numbers than this become operands, so that native code does not
# contain them.
_LARGEST_CONSTANT = 256
_ARRAYS = (jax.Array, np.ndarray, np.generic)
_NUMBERS = (bool, int, float, complex)


def vmap(
    fun: Callable[..., Any],
    in_axes: Any = 0,
    out_axes: Any = 0,
    axis_name: Hashable | None = None,
    axis_size: int | None = None,
    spmd_axis_name: Hashable | None = None,
) -> Callable[..., Any]:
    """Vectorise a function like `jax.vmap`, over SIMD lanes and threads where possible.

    On the CPU the function is compiled to native code that computes 2 to 8 members at
    once (up to 16 in float32). A loop in this code ends when the members that are
    computed at once have finished, and not when the whole batch has finished. Use this
    `vmap` for functions of small arrays, such as ODE solvers, filters and controllers.
    If the function cannot be compiled, `jax.vmap` computes the result, and
    `nhjax.engines` returns the reason.

    **Main arguments:**

    - `fun`: a function of arrays and trees of arrays.
    - `in_axes`: the axis of the members in each argument: an integer, `None` for an
        argument that all members share, or a tree of these values.
    - `out_axes`: the axis of the members in each result.

    **Other arguments:**

    - `axis_name`, `axis_size`, `spmd_axis_name`: as in `jax.vmap`. JAX computes
        collective operations over `axis_name`.

    **Returns:**

    A function with the arguments of `fun`. It can be transformed by `jax.jit`,
    `jax.vmap`, `jax.grad` and `jax.jvp`. Without `jax.jit`, it traces `fun` at each
    call. Objects in the arguments that are neither arrays nor numbers are passed to
    `fun` unchanged.

    !!! example

        >>> import jax, jax.numpy as jnp, nhjax
        >>> root = nhjax.lanes.vmap(lambda x, scale: scale * jnp.sqrt(x), (0, None))
        >>> print(jax.jit(root)(jnp.array([1.0, 4.0, 9.0]), 2.0))
        [2. 4. 6.]

    **Raises:** `TypeError` if `fun` is not a function or returns anything other than
    arrays and numbers; the errors of `jax.vmap` if the axes do not fit the arguments.
    """
    _check_callable(fun)

    @wraps(fun, updated=())
    def mapped(*args: Any, **kwargs: Any) -> Any:
        (args, kwargs), others = _partition((args, kwargs))

        @wraps(fun, updated=())
        def plain(*args: Any, **kwargs: Any) -> Any:
            args, kwargs = _combine((args, kwargs), others)
            return fun(*args, **kwargs)

        @wraps(fun, updated=())
        def member(*args: Any, **kwargs: Any) -> Any:
            return _compiled_whole(fun, *_combine((args, kwargs), others))

        axes = {"axis_name": axis_name, "axis_size": axis_size}
        axes["spmd_axis_name"] = spmd_axis_name
        if None not in jax.tree.leaves(out_axes, is_leaf=_is_none):
            return jax.vmap(member, in_axes, out_axes, **axes)(*args, **kwargs)
        # All members must share the results with `None` in `out_axes`; otherwise JAX
        # raises an error in `eval_shape`. The compiled operation returns all results
        # for each member, so that shared results are taken from the first member.
        theirs = partial(jax.vmap(plain, in_axes, out_axes, **axes), *args, **kwargs)
        jax.eval_shape(theirs)
        all_axes = jax.tree.map(_first_if_none, out_axes, is_leaf=_is_none)
        out = jax.vmap(member, in_axes, all_axes, **axes)(*args, **kwargs)
        if any(0 in x.shape for x in jax.tree.leaves(out)):
            # If there are no members, there is no first member.
            return theirs()
        return jax.tree.map(_shared, out_axes, out, is_leaf=_is_none)

    return mapped


def jit(fun: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function like `jax.jit`, to native code without XLA where possible.

    XLA runs a program on the CPU as a sequence of kernels, and starting a kernel takes
    as long as arithmetic with tens of numbers. Functions with loops that compute with
    small arrays are therefore several times faster as native code than under `jax.jit`.
    If the function cannot be compiled to native code, or has larger arrays, XLA
    compiles it, and `nhjax.engines` returns the reason.

    **Arguments:**

    - `fun`: a function of arrays and trees of arrays. As with `jax.jit`, it is traced
        once for each combination of shapes and dtypes of its arguments.

    **Returns:**

    A function with the arguments of `fun`. It can be transformed by `jax.jit`,
    `jax.vmap`, `jax.grad` and `jax.jvp`. Objects in the arguments that are neither
    arrays nor numbers are constants: the function is compiled again if they change.

    !!! example

        >>> import jax, jax.numpy as jnp, nhjax
        >>> halve = lambda x: jax.lax.while_loop(lambda x: x > 1, lambda x: x / 2, x)
        >>> print(nhjax.lanes.jit(halve)(20.0))
        0.625

    **Raises:** `TypeError` if `fun` is not a function, returns anything other than
    arrays and numbers, or has an argument that is neither an array nor hashable.
    """
    _check_callable(fun)

    @partial(jax.jit, static_argnums=0)
    def compiled(static: Any, dynamic: Any) -> Any:
        treedef, leaves = static
        arguments = _combine(dynamic, jax.tree.unflatten(treedef, leaves))
        return _compiled_whole(fun, *arguments)

    @wraps(fun, updated=())
    def call(*args: Any, **kwargs: Any) -> Any:
        dynamic, others = _partition((args, kwargs))
        _check_hashable(fun, others)
        leaves, treedef = jax.tree.flatten(others)
        return compiled((treedef, tuple(leaves)), dynamic)

    return call


def _is_none(x: Any) -> bool:
    return x is None


def _first_if_none(axis: int | None) -> int:
    return 0 if axis is None else axis


def _shared(axis: int | None, out: Any) -> Any:
    """Return the first member's result if `axis` is `None`, otherwise all of `out`."""
    return jax.tree.map(lambda x: x[0], out) if axis is None else out


# Arguments


def _check_callable(fun: Any) -> None:
    if not callable(fun):
        raise TypeError(
            f"The argument `fun` is {fun!r}, which is not a function: pass a function "
            "of arrays."
        )


def _partition(tree: Any) -> tuple[Any, Any]:
    """Split a tree into a tree of arrays and numbers and a tree of other objects.

    Each of the two trees has None in the places of the other tree's objects.
    """
    leaves, treedef = jax.tree.flatten(tree)
    marks = [isinstance(x, (*_ARRAYS, *_NUMBERS)) for x in leaves]
    pairs = list(zip(marks, leaves, strict=True))
    return (
        jax.tree.unflatten(treedef, [x if mark else None for mark, x in pairs]),
        jax.tree.unflatten(treedef, [None if mark else x for mark, x in pairs]),
    )


def _combine(one: Any, other: Any) -> Any:
    """Return the tree that `_partition` has split."""
    return jax.tree.map(
        lambda a, b: b if a is None else a, one, other, is_leaf=_is_none
    )


def _check_hashable(fun: Callable[..., Any], tree: Any) -> None:
    for path, value in jax.tree.leaves_with_path(tree):
        try:
            hash(value)
        except TypeError:
            raise TypeError(
                f"The argument `{_name(fun, path)}` contains {value!r}, which is "
                "neither an array nor hashable: pass an array, a tuple or another "
                "object with a hash."
            ) from None


def _name(fun: Callable[..., Any], path: tuple[Any, ...]) -> str:
    """Return the name of an argument in the signature of a function.

    `path` is the path to the argument in the pair (args, kwargs).
    """
    is_keyword, place = path[0].idx, path[1]
    if is_keyword:
        name = place.key
    else:
        try:
            names = list(inspect.signature(fun).parameters)
        except (TypeError, ValueError):
            names = []
        name = names[place.idx] if place.idx < len(names) else str(place.idx)
    return name + jax.tree_util.keystr(path[2:])


# Programs


def _compiled_whole(
    fun: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]
) -> Any:
    """Compute `fun(*args, **kwargs)` as one operation where possible."""
    # With `jax.disable_jit`, the user wants to step through single operations.
    if jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
        return fun(*args, **kwargs)
    leaves, treedef = jax.tree.flatten((args, kwargs))
    # Numbers of Python are not traced: `fun` receives them unchanged.
    is_array = [isinstance(x, _ARRAYS) for x in leaves]
    arrays, others = partition_list(is_array, leaves)
    structure = None

    def flat(*arrays: Any) -> list[Any]:
        nonlocal structure
        whole = merge_lists(is_array, arrays, others)
        args, kwargs = jax.tree.unflatten(treedef, whole)
        out = fun(*args, **kwargs)
        for path, x in jax.tree.leaves_with_path(out):
            if not isinstance(x, (*_ARRAYS, *_NUMBERS)):
                raise TypeError(
                    f"The function returned {x!r} as its result"
                    f"{jax.tree_util.keystr(path)}: return arrays and numbers only."
                )
        out, structure = jax.tree.flatten(out)
        return out

    out = _run(jax.make_jaxpr(flat)(*arrays), arrays)
    assert structure is not None
    return jax.tree.unflatten(structure, out)


def _run(program: Any, leaves: list[Any]) -> list[Any]:
    """Compute a program as one operation, except for the parts that call Python."""
    called = set().union(*map(python_calls, program.jaxpr.eqns))
    if not called:
        return _run_whole(program, leaves)
    names = ", ".join(sorted(called))
    program = jax.make_jaxpr(partial(inlined, program))(*leaves)
    before, inside, after = parts(program.jaxpr.eqns)
    values = start(program, leaves)
    evaluate(before, values)
    # The results of the part `before` that the compiled part needs, but does not
    # compute itself.
    known = [x for equation in before for x in equation.outvars]
    needed = {x for equation in inside for x in variables(equation.invars)}
    made = {x for equation in inside for x in equation.outvars}
    given = [x for x in known if x in needed - made]
    # The results of the compiled part that the part `after` or the caller needs.
    made -= {x for equation in after for x in equation.outvars}
    used = variables(program.jaxpr.outvars)
    used += [x for equation in after for x in variables(equation.invars)]
    passed = [x for x in dict.fromkeys(used) if x in made]
    invars = [*program.jaxpr.invars, *given]
    fields = {"invars": invars, "eqns": inside, "outvars": passed}
    if passed:
        note = f"; JAX computes a part that has effects or calls Python ({names})"
        operands = [values[x] for x in invars]
        part = part_of(program, effects=set(), **fields)
        values.update(zip(passed, _run_whole(part, operands, note), strict=True))
    else:
        record_engine("xla", f"all of it has effects or calls Python ({names})", None)
    evaluate(after, values)
    return [read(x, values) for x in program.jaxpr.outvars]


def _run_whole(program: Any, leaves: list[Any], note: str = "") -> list[Any]:
    """Compute a program as one operation; traced and large constants are operands."""
    jaxpr, consts = program.jaxpr, program.consts
    is_operand = [
        isinstance(x, jax.core.Tracer) or np.size(x) > _LARGEST_CONSTANT for x in consts
    ]
    operands, constants = partition_list(is_operand, consts)
    first, constvars = partition_list(is_operand, jaxpr.constvars)
    invars = [*first, *jaxpr.invars]
    whole = part_of(program, constants, invars=invars, constvars=constvars)
    return run_program(whole, [*operands, *leaves], _OPTIONS._replace(note=note))
