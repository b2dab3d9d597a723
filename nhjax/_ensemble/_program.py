"""The job of an ensemble: its members, the programs that run them, and its manifest.

A job is split into chunks of members. One compiled program runs every chunk, spread
over the devices, and reports which members failed. If statistics are requested, a
second program reduces the values of a chunk. The manifest and the text of the program
identify a job. Processes compare both before they run a job together, and a store
contains both, so that it cannot be resumed by another job.
"""

import hashlib
import re
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, PyTree

from .._compile import tracked_jit
from .._errors import is_traced, naming, ShapeError
from .._integrate import Solution
from .._io import installed_version
from .._results import result_codes, RESULTS
from .._system import no_array
from ._processes import Processes
from ._reductions import AbstractReduction


# The number that stands for the failed step if its index is not known.
UNKNOWN_STEP = -1
# The name of the mesh axis along which members are spread over devices.
AXIS = "members"
FORMAT = 1


class Layout(NamedTuple):
    """The devices that run the chunks, and the order in which statistics are computed.

    If `is_fixed`, this order does not depend on the number of devices.
    """

    devices: tuple[Any, ...]
    is_fixed: bool


class ChunkResult(NamedTuple):
    """The result of a chunk: a code and a step for each member, and the content.

    Codes and steps are results of `first_failure`. The content is the values of all
    members, or only the arrays of these values that reductions use, or the states of
    reductions.
    """

    codes: Int[Array, " c"]
    steps: Int[Array, " c"]
    content: PyTree[Array]


class Job:
    """A function, its members, their split into chunks, and where they run."""

    def __init__(
        self,
        run: Callable[[Any], Any],
        members: "Members",
        chunk_size: int,
        layout: Layout,
        structure: Any,
        processes: Processes,
    ):
        self.run, self.members, self.chunk_size = run, members, chunk_size
        self.layout, self.structure, self.processes = layout, structure, processes

    @property
    def num_chunks(self) -> int:
        """Return the number of chunks; the last one may not be full."""
        return -(-self.members.count // self.chunk_size)

    def first_member(self, chunk: int) -> int:
        """Return the index of the first member of a chunk."""
        return chunk * self.chunk_size

    def num_members(self, chunk: int) -> int:
        """Return the number of members of a chunk, without padding."""
        return min(self.chunk_size, self.members.count - self.first_member(chunk))

    def share(self, index: int) -> range:
        """Return the chunks of a process; each process has consecutive chunks."""
        count = self.processes.count
        ends = [self.num_chunks * i // count for i in (index, index + 1)]
        return range(*ends)

    def values(self, chunk: int) -> ChunkResult:
        """Start a chunk that returns the values of its members; do not wait for it."""
        inputs = self._on_devices(self._inputs(chunk))
        return _values_of_chunk(self.run, self.members.make, inputs, self.layout, None)

    def states(
        self, chunk: int, reductions: Any, is_used: tuple[bool, ...]
    ) -> ChunkResult:
        """Start a chunk that returns states of reductions; do not wait for it.

        `is_used` marks the arrays that the reductions use; see `used_arrays`.

        The reductions are a separate program, which takes long to compile and depends
        only on the shapes of the values. Runs with different methods can therefore
        share this program.
        """
        is_member = np.arange(self.chunk_size) < self.num_members(chunk)
        inputs, is_member = self._on_devices((self._inputs(chunk), is_member))
        shapes = without_results(self.structure)
        made = _values_of_chunk(
            self.run, self.members.make, inputs, self.layout, is_used
        )
        given = shapes, is_used, made.content, made.codes, is_member, self.layout
        return made._replace(content=_reduced(reductions, *given))

    def _inputs(self, chunk: int) -> Any:
        return self.members.inputs(self.first_member(chunk), self.chunk_size)

    def _on_devices(self, rows: Any) -> Any:
        devices = self.layout.devices
        if len(devices) == 1:
            sharding = jax.sharding.SingleDeviceSharding(devices[0])
        else:
            sharding = jax.sharding.NamedSharding(_mesh(self.layout), jax.P(AXIS))
        return jax.device_put(rows, sharding)


class Members:
    """The members of an ensemble, given by arrays or by a function of their index.

    - `count`: the number of members.
    - `make`: a traceable function that converts one row of `inputs` to a member.
    """

    count: int
    make: Callable[[Any], Any]

    def __init__(self, members: Any, num_members: int | None):
        if callable(members):
            if num_members is None:
                raise ValueError(
                    "`num_members` is needed if `members` is a function of the index "
                    "of a member."
                )
            self._leaves = None
            self.make, self.count = members, _check_num_members(num_members)
            return
        leaves, treedef = jax.tree.flatten(members)
        if is_traced(*leaves):
            raise RuntimeError(
                "`nhjax.ensemble` runs its chunks from the host: call it outside of "
                "jit, vmap and grad."
            )
        self.count = _leading_size(members)
        if num_members is not None and num_members != self.count:
            raise ValueError(
                f"`num_members` is {num_members}, but the arrays of `members` have "
                f"{self.count} rows: leave it out."
            )
        keys = [jax.random.key_impl(x) if _is_key(x) else None for x in leaves]
        # NumPy arrays are not copied, so that memory-mapped files are not read here.
        self._leaves = [
            np.asarray(jax.random.key_data(x) if impl else _canonical(x))
            for x, impl in zip(leaves, keys, strict=True)
        ]
        self.make = _MemberFromArrays(treedef, tuple(keys))

    def inputs(self, start: int, size: int) -> Any:
        """Return `size` rows from `start` on, padded by the row of the last member."""
        indices = np.minimum(np.arange(start, start + size), self.count - 1)
        if self._leaves is None:
            return indices.astype(jnp.result_type(int))
        if start + size <= self.count:
            return [_canonical(x[start : start + size]) for x in self._leaves]
        return [_canonical(x[indices]) for x in self._leaves]

    def digest(self) -> str:
        """Compute a digest of the arrays of members.

        If a function gives the members, the program text identifies this function.
        """
        if self._leaves is None:
            return "a function"
        made = hashlib.sha256()
        for x in self._leaves:
            made.update(f"{x.dtype.str}{x.shape}".encode())
            # Blocks are read one after the other, because a copy of a whole
            # memory-mapped array may not fit into memory.
            for start in range(0, len(x), 65536):
                made.update(np.ascontiguousarray(x[start : start + 65536]).tobytes())
        return made.hexdigest()


class _MemberFromArrays(eqx.Module):
    """Create a member from its leaves; its random keys are stored as integers."""

    treedef: Any = eqx.field(static=True)
    keys: tuple[Any, ...] = eqx.field(static=True)

    def __call__(self, leaves: list[Any]) -> Any:
        """Create the member."""
        made = [
            x if impl is None else jax.random.wrap_key_data(x, impl=impl)
            for x, impl in zip(leaves, self.keys, strict=True)
        ]
        return jax.tree.unflatten(self.treedef, made)


def _canonical(x: Any) -> Any:
    """Convert an array as JAX does: float64 to float32, unless float64 is enabled."""
    if isinstance(x, jax.Array):
        return x
    return np.asarray(x, jax.dtypes.canonicalize_dtype(np.asarray(x).dtype))


def _is_key(x: Any) -> bool:
    return isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def _check_num_members(number: Any) -> int:
    if isinstance(number, bool) or not isinstance(number, int | np.integer):
        raise TypeError(f"`num_members` must be an int, got {number!r}.")
    if number < 1:
        raise ValueError(f"`num_members` must be at least 1, got {number}.")
    return int(number)


def _leading_size(members: Any) -> int:
    sizes: dict[int, str] = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(members):
        name = f"`members{jax.tree_util.keystr(path)}`"
        if not eqx.is_array_like(leaf):
            raise TypeError(
                f"{name} is {leaf!r}, but `members` must hold arrays with a row for "
                "each member; `run` can close over everything else."
            )
        if np.ndim(leaf) == 0:
            raise ShapeError(
                f"{name} is a single number, but the leading axis of each array in "
                "`members` must be the members; `run` can close over shared values."
            )
        sizes.setdefault(np.shape(leaf)[0], name)
    if len(sizes) > 1:
        listed = ", ".join(f"{name} has {size}" for size, name in sizes.items())
        raise ShapeError(
            f"The arrays of `members` differ in the number of members: {listed}."
        )
    if not sizes or 0 in sizes:
        raise ShapeError("`members` has no members: it needs arrays with rows.")
    return next(iter(sizes))


def value_structure(run: Any, make: Any, inputs: Any) -> Any:
    """Compute the shapes and dtypes of the arrays that `run` returns for one member.

    **Raises:** `TypeError` if `run` returns anything except arrays of numbers.
    """
    one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), inputs)

    def value(one):
        member = make(one)
        with naming("run(member)", run):
            return run(member)

    structure = eqx.filter_eval_shape(value, one)
    leaves = jax.tree_util.tree_leaves_with_path(structure)
    if not leaves:
        raise TypeError(
            f"`run` must return arrays for each member, got {no_array(structure)}"
        )
    for path, leaf in leaves:
        name = f"`run(member){jax.tree_util.keystr(path)}`"
        if not isinstance(leaf, jax.ShapeDtypeStruct):
            raise TypeError(
                f"{name} is {leaf!r}, but `run` must return arrays for each member, "
                "alone or in tuples, dictionaries and other trees."
            )
        if jnp.issubdtype(leaf.dtype, jax.dtypes.extended):
            raise TypeError(
                f"{name} has dtype {leaf.dtype}: return `jax.random.key_data` of a "
                "random key."
            )
    return structure


@tracked_jit("run", "make")
def _values_of_chunk(
    run: Any, make: Any, inputs: Any, layout: Layout, is_used: tuple[bool, ...] | None
) -> ChunkResult:
    """Run the members of a chunk.

    The content is the tree of values or, if `is_used` is given, a list of the arrays
    that the reductions use.
    """
    value, codes, steps = _run_members(run, make, inputs, layout)
    if is_used is not None:
        arrays = jax.tree.leaves(without_results(value))
        value = [x for x, used in zip(arrays, is_used, strict=True) if used]
    return ChunkResult(codes, steps, value)


@tracked_jit("reductions")
def used_arrays(reductions: Any, shapes: Any) -> tuple[bool, ...]:
    """Return which arrays of a value the reductions use.

    The other arrays need not be stored, and XLA can omit their computation.
    """
    values = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct((1, *x.shape), x.dtype), shapes
    )
    counts = jax.ShapeDtypeStruct((1,), bool)
    program = jax.make_jaxpr(partial(_updated, reductions, shapes))(
        values, counts
    ).jaxpr
    operands = {x for e in program.eqns for x in map(id, e.invars)}
    operands.update(map(id, program.outvars))
    return tuple(id(x) in operands for x in program.invars[:-1])


def _updated(
    reductions: Any, shapes: Any, values: Any, counts: Bool[Array, " c"]
) -> Any:
    """Return the states of the reductions for the members of one chunk alone."""
    return each_reduction(
        lambda each: each.update(each.init(shapes), values, counts), reductions
    )


@tracked_jit("reductions")
def _reduced(
    reductions: Any,
    shapes: Any,
    is_used: tuple[bool, ...],
    arrays: list[Array],
    codes: Int[Array, " c"],
    is_member: Bool[Array, " c"],
    layout: Layout,
) -> Any:
    """Return the states of the reductions for the members of a chunk.

    `arrays` has the arrays of the values that the reductions use.
    """
    counts = is_member & is_success(codes)
    described, treedef = jax.tree.flatten(shapes)
    given = iter(arrays)
    values = treedef.unflatten(
        next(given) if used else jnp.zeros((len(codes), *x.shape), x.dtype)
        for x, used in zip(described, is_used, strict=True)
    )
    reduce = partial(_updated, reductions, shapes)
    if len(layout.devices) == 1:
        return reduce(values, counts)
    if layout.is_fixed:
        # Every device reduces all members, so that the order is the same as on one
        # device.
        everywhere = _on_each_device(layout, reduce, jax.P(), jax.P())
        return everywhere(values, counts)

    def reduce_share(values, counts):
        return jax.tree.map(lambda x: x[None], reduce(values, counts))

    each_share = _on_each_device(layout, reduce_share, jax.P(AXIS), jax.P(AXIS))
    stacked = each_share(values, counts)
    state, *others = [
        jax.tree.map(lambda x, i=i: x[i], stacked) for i in range(len(layout.devices))
    ]
    for other in others:
        state = each_reduction(_merge, reductions, state, other)
    return state


@tracked_jit("reductions")
def merged_states(reductions: Any, one: Any, other: Any) -> Any:
    """Merge the states of reductions of two sets of members.

    The merge is a separate program, so that the rounding is the same whether a state
    comes from this process, another process or a file.
    """
    return each_reduction(_merge, reductions, one, other)


def _merge(each: AbstractReduction, one: Any, other: Any) -> Any:
    return each.merge(one, other)


def _run_members(run: Any, make: Any, inputs: Any, layout: Layout) -> Any:
    def member(one):
        value = run(make(one))
        return value, *first_failure(value)

    every = jax.vmap(member)
    if len(layout.devices) > 1:
        # JAX's check of values that vary between devices (`check_vma`) is off, because
        # it does not know the primitives that nhjax adds. Members are independent, so
        # that the result is right without this check.
        every = _on_each_device(layout, every, jax.P(AXIS), jax.P(AXIS))
    return every(inputs)


def _mesh(layout: Layout) -> jax.sharding.Mesh:
    return jax.sharding.Mesh(np.array(layout.devices), (AXIS,))


def _on_each_device(layout: Layout, function: Any, inside: Any, outside: Any) -> Any:
    return jax.shard_map(
        function,
        mesh=_mesh(layout),
        in_specs=inside,
        out_specs=outside,
        check_vma=False,
    )


def each_reduction(function: Callable[..., Any], reductions: Any, *trees: Any) -> Any:
    """Map a function over a tree of reductions and the matching parts of `trees`."""
    return jax.tree.map(function, reductions, *trees, is_leaf=is_reduction)


def is_reduction(x: Any) -> bool:
    """Return whether `x` is a reduction, which is itself a tree."""
    return isinstance(x, AbstractReduction)


def is_success(codes: Any) -> Any:
    """Return which codes of `RESULTS` are not failures."""
    known = result_codes()
    return (codes == known["successful"]) | (codes == known["event_occurred"])


def first_failure(value: Any) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """Return the code of the first failure in a value, and its step.

    This function searches every `nhjax.Solution` and `nhjax.RESULTS` in the value.
    Without a failure, the code is the code of `RESULTS.successful`. The step is -1 if
    it is not known.
    """
    codes, steps = [], []
    nodes = jax.tree.leaves(
        value, is_leaf=lambda x: isinstance(x, Solution) or _is_result(x)
    )
    for node in nodes:
        if isinstance(node, Solution):
            codes.append(node.result._value)
            steps.append(node.stats["failed_step"])
        elif _is_result(node):
            codes.append(node._value)
            steps.append(jnp.full(jnp.shape(node._value), UNKNOWN_STEP))
    codes.append(jnp.asarray(result_codes()["successful"]))
    steps.append(jnp.asarray(UNKNOWN_STEP))
    flat = [
        jnp.concatenate([jnp.ravel(x).astype(jnp.int32) for x in parts])
        for parts in (codes, steps)
    ]
    # If there is no failure, this search finds the success that is appended above.
    index = jnp.arange(len(flat[0]))
    first = jnp.argmax(~is_success(flat[0]) | (index == len(flat[0]) - 1))
    # XLA compiles a sum in less time than a lookup.
    code, step = [jnp.sum(x, where=index == first, dtype=x.dtype) for x in flat]
    return code, step


def results_as_codes(value: Any) -> Any:
    """Replace `RESULTS` by their codes; return a `Solution` unchanged."""
    if isinstance(value, Solution):
        return value
    return jax.tree.map(
        lambda x: x._value if _is_result(x) else x, value, is_leaf=_is_result
    )


def without_results(value: Any) -> Any:
    """Replace `RESULTS`, which have no statistics, by None."""
    return jax.tree.map(
        lambda x: None if _is_result(x) else x, value, is_leaf=_is_result
    )


def _is_result(x: Any) -> bool:
    return isinstance(x, type(RESULTS.successful)) and x._enumeration is RESULTS


def manifest(job: Job, **others: Any) -> dict[str, Any]:
    """Describe the parameters of a job as JSON.

    `others` are further parameters, which describe the values or the reductions.
    """
    return {
        "format": FORMAT,
        "nhjax": installed_version(),
        "jax": jax.__version__,
        "num_members": job.members.count,
        "chunk_size": job.chunk_size,
        "members": job.members.digest(),
    } | others


def without_addresses(text: str) -> str:
    """Remove memory addresses of functions from a text."""
    return re.sub(r"0x[0-9a-f]+", "0x", text)


def call_description(
    made: dict[str, Any], text: str, out: bool = False, **others: Any
) -> dict[str, Any]:
    """Describe the data that must agree in all processes of a common job.

    The data are the manifest `made`, a digest of the program's `text`, whether the job
    writes to a store (`out`), and `others`.
    """
    run = hashlib.sha256(text.encode()).hexdigest()
    return {"out": out, "reduce": None} | made | {"run": run} | others


def program_text(job: Job, reductions: Any = ()) -> str:
    """Return the text of the jaxprs of one member and of the reductions.

    The text ends with digests of the arrays in the jaxprs. Addresses of functions,
    which differ between processes, are removed.
    """

    def run(one):
        return job.run(job.members.make(one))

    def reduce(value):
        chunk = jax.tree.map(lambda x: x[None], without_results(value))
        shapes = without_results(job.structure)
        return _updated(reductions, shapes, chunk, jnp.ones(1, bool))

    one = jax.tree.map(lambda x: x[0], job.members.inputs(0, 1))
    parts = [jax.make_jaxpr(run)(one), jax.make_jaxpr(reduce)(job.structure)]
    lines = []
    for closed in parts:
        lines += without_addresses(str(closed)).splitlines()
        lines += [f"array {x}" for x in _constants(closed)]
    return "\n".join(line.rstrip() for line in lines) + "\n"


def _constants(closed: Any) -> list[str]:
    found = [
        f"{np.shape(x)} {hashlib.sha256(np.asarray(x).tobytes()).hexdigest()}"
        for x in closed.consts
        if not jnp.issubdtype(x.dtype, jax.dtypes.extended)
    ]
    for equation in closed.jaxpr.eqns:
        leaves = jax.tree.leaves(
            list(equation.params.values()), is_leaf=lambda x: hasattr(x, "consts")
        )
        for part in leaves:
            if hasattr(part, "consts") and hasattr(part, "jaxpr"):
                found += _constants(part)
    return found
