"""The exceptions that nhjax raises, and the functions that enforce conditions."""

import contextlib
import dataclasses
import functools
import inspect
import logging
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, PyTree


T = TypeVar("T")


class ShapeError(ValueError):
    """Raised if an argument, or the value of a user's function, has a wrong shape."""


class DTypeError(TypeError):
    """Raised if an argument is not floating-point, or its parts differ in precision."""


class NonFiniteError(ValueError):
    """Raised if an argument, or the value of a user's function, is infinite or NaN."""


class ConstraintViolationError(ValueError):
    """Raised if an initial state violates constraints, or its q is not on the group."""


class IrregularLagrangianError(ValueError):
    """Raised if the mass matrix D2D2L is singular, so that v does not follow from p.

    The Legendre transform is then not invertible. For a Hamiltonian system the matrix
    is D2D2H.
    """


class DependentConstraintsError(ValueError):
    """Raised if the constraints are dependent, that is, D2Φ does not have full rank.

    Full rank is the paper's admissibility condition. With holonomic constraints Γ, the
    rows of D2Φ and of DΓ together must be independent.
    """


class IncompatibleConstraintsError(ValueError):
    """Raised if C = D2Φ M⁻¹ D2Φᵀ is singular, so that no multiplier is determined.

    An invertible C is the paper's compatibility condition.
    """


class NewtonError(RuntimeError):
    """Raised if `initial_state` or `steady_motion` could not solve its equations.

    In `initial_state`, Newton's method failed for the Legendre transform or for the
    projection onto the constraints. In `steady_motion`, it found no steady motion.
    """


class IntegrationError(RuntimeError):
    """Raised if `integrate` could not continue a trajectory to the end of the run.

    The message names the member of a batch, the step and the reason.
    """


@contextlib.contextmanager
def naming(called: str, function: Any, args: Any = ...) -> Iterator[None]:
    """Add a note to exceptions that are raised while a user's function is traced.

    The note names the function by `called`, with its file and line, and gives advice
    for known errors. `args` is the user's argument `args`, if the function receives it.
    """
    try:
        yield
    except Exception as error:
        note = f"This was raised by `{called}`{_place(function)}, called by nhjax."
        for kind, advice in _ADVICE:
            if isinstance(error, kind):
                note += f" It receives JAX arrays without values: {advice}"
                break
        error.add_note(note + _about_args(error, args))
        raise


_ADVICE = (
    (
        jax.errors.TracerBoolConversionError,
        "write `jnp.where(condition, a, b)` in place of `if`, and `jnp.maximum`, "
        "`jnp.minimum` in place of `max`, `min`.",
    ),
    (
        jax.errors.TracerIntegerConversionError,
        "to index a list or a NumPy array by them, convert it to a JAX array, "
        "`jnp.asarray(table)[i]`; the number of a `range` must be an int.",
    ),
    (
        jax.errors.NonConcreteBooleanIndexError,
        "write `jnp.where(condition, a, 0.0)` in place of `a[condition]`.",
    ),
    # The functions of `numpy` need an array, and raise the first of these errors for
    # traced values. The functions of `math` need a number, and raise the second one.
    (
        (jax.errors.TracerArrayConversionError, jax.errors.ConcretizationTypeError),
        "use functions of `jax.numpy` in place of `numpy` and `math`, and leave out "
        "`float` and `int`.",
    ),
)


def _about_args(error: Exception, args: Any) -> str:
    """Describe `args` if the error suggests that the function expects other `args`."""
    if args is None and "NoneType" in str(error):
        return " Here `args` is None: has `args=...` been left out of the call?"
    if isinstance(error, KeyError) and isinstance(args, dict):
        return f" Here `args` has the keys {', '.join(map(repr, args))}."
    if isinstance(error, TypeError | IndexError) and isinstance(args, tuple | list):
        return f" Here `args` is a {type(args).__name__} of {len(args)}."
    return ""


def _place(function: Any) -> str:
    """Return a function's name, file and line as text; "" if they are unknown."""
    function = inspect.unwrap(getattr(function, "__func__", function))
    while isinstance(function, functools.partial):
        function = function.func
    code = getattr(function, "__code__", None)
    if code is None:
        return ""
    return f" ({function.__qualname__}, {code.co_filename}:{code.co_firstlineno})"


def is_traced(*arrays: object) -> bool:
    """Return whether any of the arrays is traced (inside jit, vmap or grad)."""
    return any(isinstance(x, Tracer) for x in arrays)


def check_choice(name: str, value: Any, choices: tuple[str, ...]) -> None:
    """Raise a `ValueError` unless `value`, called `name`, is one of `choices`."""
    if not isinstance(value, str) or value not in choices:
        listed = ", ".join(map(repr, choices))
        raise ValueError(f"{name} must be one of {listed}, got {value!r}")


class Check(NamedTuple):
    """A condition, and the exception to raise if it fails.

    `error(*values)` creates the exception from NumPy arrays, also in a compiled
    program. Define `error` at the top level of a module: if each check created a new
    function, an eager `vmap` would compile again at each call.
    """

    ok: Bool[Array, ""] | np.bool_ | bool
    error: Callable[..., Exception]
    values: tuple[Any, ...] = ()


def require(tree: T, *checks: Check) -> T:
    """Return `tree` if all checks hold; otherwise raise for the first failed check.

    With concrete values the exception is raised immediately. With traced values it is
    raised when the compiled program runs, as a runtime error of JAX with the same
    message. Under `vmap` the message begins with the index of the first failed member.
    The returned tree must be used afterwards: `jax.jit` drops checks whose result is
    not used.
    """
    later = undecided(*checks)
    if not later:
        return tree
    failed = ~jnp.stack([jnp.asarray(check.ok) for check in later])
    details = [(check.error, check.values) for check in later]
    return raise_where(tree, jnp.any(failed), _first_error, (failed, details))


def hold(*checks: Check) -> Bool[Array, ""] | None:
    """Return whether all checks hold, as a traced value; None if all are known to hold.

    If a check of concrete values fails, its exception is raised.
    """
    later = undecided(*checks)
    if not later:
        return None
    return jnp.all(jnp.stack([jnp.asarray(check.ok) for check in later]))


def undecided(*checks: Check) -> list[Check]:
    """Return the checks of traced values; raise for the first failed concrete check."""
    later = []
    for check in checks:
        if is_traced(check.ok, *jax.tree.leaves(check.values)):
            later.append(check)
        elif not check.ok:
            raise check.error(*on_host(check.values))
    return [check for check in later if is_traced(check.ok) or not check.ok]


def on_host(values: T) -> T:
    """Convert arrays to NumPy arrays, so that comparing them compiles no program.

    A tree with traced arrays is returned unchanged.
    """
    if is_traced(*jax.tree.leaves(values)):
        return values
    return jax.tree.map(lambda x: np.asarray(x) if eqx.is_array(x) else x, values)


def _first_error(bad: np.ndarray, values: tuple[np.ndarray, list]) -> Exception:
    """Create the exception of the first failed check in the first failed member."""
    member = next(index for index in np.ndindex(bad.shape) if bad[index])
    failed, details = jax.tree.map(
        lambda x: x[member] if isinstance(x, np.ndarray) else x, values
    )
    error, values = details[int(np.argmax(failed))]
    exception = error(*values)
    if member:
        exception.args = (f"member {member_name(member)}: {exception}",)
    return exception


def member_name(index: tuple[int, ...]) -> int | tuple[int, ...] | None:
    """Format an index into a batch as users would write it; None without a batch."""
    return index if len(index) > 1 else (index[0] if index else None)


def raise_where(
    tree: T,
    bad: Bool[Array, ""] | np.bool_,
    error: Callable[[np.ndarray, Any], Exception],
    values: PyTree[Any],
) -> T:
    """Return `tree`; where `bad` holds, raise when the compiled program runs.

    The exception is `error(bad, values)`, called with NumPy arrays on the host. Under
    `vmap` all these arrays have the batch as leading axes, because the call-back that
    creates the exception receives all members of a batch.
    """
    # The same array often belongs to several checks, and is passed only once.
    leaves, treedef = jax.tree.flatten(values)
    arrays = list({id(x): x for x in leaves if eqx.is_array(x)}.values())
    place = {id(x): _Place(i) for i, x in enumerate(arrays)}
    described = treedef.unflatten([place.get(id(leaf), leaf) for leaf in leaves])
    return _raise_where(tree, jnp.asarray(bad), error, arrays, described)


@dataclasses.dataclass(frozen=True)
class _Place:
    """The place of an array in the list of arrays that are passed to the host."""

    index: int


# This function is compiled as a whole, since an eager `vmap` would compile the
# call-back again at each call.
@eqx.filter_jit
def _raise_where(
    tree: T,
    bad: Bool[Array, ""],
    error: Callable[[np.ndarray, Any], Exception],
    arrays: list[Array],
    described: PyTree[Any],
) -> T:
    """Return `tree`, or raise an exception; see `raise_where`.

    `described` is `values` of `raise_where`, with a `_Place` instead of each array.
    """
    # The call-back outlives the trace: it may use shapes and dtypes of traced arrays,
    # but not the arrays.
    kinds = [(x.shape, x.dtype) for x in arrays]
    packed, slices = _packed(arrays)

    def on_host(bad, *packed):
        batch = np.shape(bad)
        found = [
            np.asarray(packed[group])[..., part].view(dtype).reshape(batch + shape)
            for (group, part), (shape, dtype) in zip(slices, kinds, strict=True)
        ]
        values = jax.tree.map(
            lambda x: found[x.index] if isinstance(x, _Place) else x, described
        )
        exception = error(np.asarray(bad), values)
        raise exception.with_traceback(_short_traceback())

    passed = _one_result_of_batch(on_host)(bad, *map(_bits, packed))
    # Every part of the tree must depend on the check, so that `jax.jit` keeps the
    # check.
    dynamic, static = eqx.partition(tree, eqx.is_array)
    dynamic = jax.tree.map(lambda x: jnp.where(passed, x, jnp.zeros_like(x)), dynamic)
    return eqx.combine(dynamic, static)


def _packed(arrays: list[Array]) -> tuple[list[Array], list[tuple[int, slice]]]:
    """Join the arrays of each dtype to a vector; return also where each array is.

    If arrays were not joined, XLA would compile a kernel to convert each one to bits.
    """
    groups: dict[Any, list[Array]] = {}
    slices = []
    for x in arrays:
        group = groups.setdefault(x.dtype, [])
        start = sum(y.size for y in group)
        group.append(x.reshape(-1))
        slices.append((list(groups).index(x.dtype), slice(start, start + x.size)))
    return [jnp.concatenate(group) for group in groups.values()], slices


def _bits(x: Array) -> Array:
    """Return the bits of real numbers as integers, which have no derivatives.

    JAX cannot differentiate a call-back. A custom rule with zero derivatives would not
    be enough: in a loop that is differentiated twice, JAX replaces the function by its
    body, and the rule is lost.
    """
    if not jnp.issubdtype(x.dtype, jnp.floating):
        return x
    return jax.lax.bitcast_convert_type(x, f"uint{8 * x.dtype.itemsize}")


def _one_result_of_batch(on_host: Callable[..., Any]) -> Callable[..., Bool[Array, ""]]:
    """Create a function of (bad, *arrays) that returns True, or raises if `bad`.

    The exception is raised by `on_host(bad, *arrays)`, called on the host. A batch has
    one common result: if each member had its own result, `vmap` would call the host
    even if all members are good.
    """

    @custom_vmap
    def passes(bad, *arrays):
        return jax.lax.cond(
            jnp.any(bad),
            lambda: jax.pure_callback(
                on_host, jax.ShapeDtypeStruct((), bool), bad, *arrays
            ),
            lambda: jnp.asarray(True),
        )

    @passes.def_vmap
    def _(axis_size, in_batched, *arrays):
        full = [
            x if batched else jnp.broadcast_to(x, (axis_size, *x.shape))
            for x, batched in zip(arrays, in_batched, strict=True)
        ]
        return _one_result_of_batch(on_host)(*full), False

    return passes


def _within_a_compiled_program() -> Iterator[None]:
    """Yield once, in the frame where compiled programs seem to raise exceptions."""
    yield


# XLA prints the Python frames from the deepest entry of a traceback outwards to the
# main program, including about twenty frames of JAX. The frame of a suspended generator
# has no outer frames, so that only this frame is printed.
_NOWHERE: Any = _within_a_compiled_program()
next(_NOWHERE)


def _short_traceback() -> TracebackType:
    """Create a traceback with one entry, the suspended generator above."""
    frame = _NOWHERE.gi_frame
    return TracebackType(None, frame, frame.f_lasti, frame.f_lineno)


class _Once(logging.Filter):
    """A filter that drops the log entries of JAX for exceptions of `raise_where`.

    JAX logs such exceptions before it raises them, so that the user would read the
    message twice.
    """

    def filter(self, record: logging.LogRecord) -> bool:
        exception = record.exc_info[1] if record.exc_info else None
        entry = exception.__traceback__ if exception else None
        while entry and entry.tb_next:
            entry = entry.tb_next
        return entry is None or entry.tb_frame is not _NOWHERE.gi_frame


logging.getLogger("jax._src.callback").addFilter(_Once())
