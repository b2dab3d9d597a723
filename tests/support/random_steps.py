"""Steps of random programs over the primitives that lanes support, and data.

A program is a list of steps. Each makes an array from earlier ones; the steps of loops
and branches have lists of steps of their own. To avoid results that depend on the order
of summation or on the library, only small whole numbers are added.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st
from jax import lax


FLOATS = ("float32", "float64")
INTEGERS = ("int32", "int64", "uint32", "int8")
DTYPES = (*FLOATS, *INTEGERS, "bool")
SHAPES = ((), (3,), (2, 3), (0,))


class Kind(NamedTuple):
    """The dtype and shape of an array."""

    dtype: str
    shape: tuple[int, ...]


class Step(NamedTuple):
    """A function of earlier arrays, given by their positions."""

    name: str
    function: Callable[..., Any]
    sources: tuple[int, ...]
    kinds: tuple[Kind, ...]


def evaluate(steps: list[Step], values: list[Any]) -> list[Any]:
    """Compute all arrays of a program."""
    values = list(values)
    for step in steps:
        out = step.function(*[values[i] for i in step.sources])
        values.extend(out if len(step.kinds) > 1 or isinstance(out, tuple) else [out])
    return values


def numbers(kind: Kind, members: int, seed: int) -> np.ndarray:
    """Draw data, including all special values of a dtype."""
    rng = np.random.default_rng(seed)
    shape = (members, *kind.shape)
    if kind.dtype == "bool":
        return rng.random(shape) < 0.5
    if kind.dtype in FLOATS:
        limits = np.finfo(kind.dtype)
        special = [0.0, -0.0, 1, -1, 0.5, 3, np.inf, -np.inf, np.nan, limits.max]
        special += [limits.smallest_normal, -limits.smallest_normal, 1e10, 2.5]
        ordinary = rng.normal(size=shape) * 4
    else:
        limits = np.iinfo(kind.dtype)
        special = [limits.min, limits.max, 0, 1, limits.max - 1, limits.min + 1, 2]
        special += [-1] if limits.min < 0 else []
        ordinary = rng.integers(0, 9, size=shape)
    chosen = rng.choice(np.array(special, kind.dtype), size=shape)
    return np.where(rng.random(shape) < 0.5, chosen, ordinary.astype(kind.dtype))


_BINARY = {
    **dict.fromkeys(("add", "sub", "mul", "div", "max", "min"), (*FLOATS, *INTEGERS)),
    "rem": (*FLOATS, *INTEGERS),
    **dict.fromkeys(("bitwise_and", "bitwise_or", "bitwise_xor"), (*INTEGERS, "bool")),
    **dict.fromkeys(
        ("shift_left", "shift_right_logical", "shift_right_arithmetic"), INTEGERS
    ),
}
_SIGNED = (*FLOATS, "int32", "int64", "int8")
_UNARY = {
    "neg": _SIGNED,
    "abs": _SIGNED,
    "sign": (*FLOATS, *INTEGERS),
    "bitwise_not": (*INTEGERS, "bool"),
    "floor": FLOATS,
    "ceil": FLOATS,
    "round": FLOATS,
    "square": (*FLOATS, *INTEGERS),
    "sqrt": FLOATS,
    "population_count": INTEGERS,
    "clz": INTEGERS,
}
_COMPARISONS = ("eq", "ne", "lt", "le", "gt", "ge")


def whole(x: Any) -> Any:
    """Map numbers to a few whole numbers, whose sums and products are exact."""
    if x.dtype == bool:
        return x
    low, high = (
        jnp.asarray(n, x.dtype) for n in ((0 if x.dtype.kind == "u" else -2), 2)
    )
    x = lax.clamp(low, x, high)
    return lax.round(x) if x.dtype.kind == "f" else x


class Steps:
    """Appends steps, which hypothesis chooses, to a program."""

    def __init__(self, draw: Callable, kinds: list[Kind], depth: int):
        self.draw, self.depth = draw, depth
        self.kinds, self.steps = list(kinds), []

    def add(self, name: str, function: Callable, sources: Any, *kinds: Kind) -> None:
        """Append a step."""
        self.steps.append(Step(name, function, tuple(sources), kinds))
        self.kinds.extend(kinds)

    def choose(self, options: Any) -> Any:
        """Choose one of some options."""
        return self.draw(st.sampled_from(list(options)))

    def find(self, test: Callable[[Kind], bool]) -> int | None:
        """Choose an array of a kind; shrinking prefers the last ones."""
        found = [i for i, kind in enumerate(self.kinds) if test(kind)]
        return self.choose(found) if found else None

    def binary(self) -> None:
        name = self.choose(_BINARY)
        first = self.find(lambda kind: kind.dtype in _BINARY[name])
        if first is not None:
            kind = self.kinds[first]
            second = self.find(lambda other: other == kind)
            self.add(name, getattr(lax, name), (first, second), kind)

    def stretched(self) -> None:
        """Append an operation on arrays that have axes of length one."""
        # To divide by a broadcast array, XLA multiplies by the reciprocal: in float32
        # its results differ by up to 1 ulp from IEEE 754, which lanes follow.
        name = self.choose([name for name in _BINARY if name != "div"])
        dtypes = _BINARY[name]
        first = self.find(lambda k: k.shape == (2, 3) and k.dtype in dtypes)
        if first is None:
            return
        kind = self.kinds[first]
        second = self.find(lambda other: other == kind)
        axis, is_both = self.choose((0, 1)), self.draw(st.booleans())

        def stretch(x, y):
            x = lax.slice_in_dim(x, 0, 1, axis=1 - axis) if is_both else x
            return getattr(lax, name)(lax.slice_in_dim(y, 1, 2, axis=axis), x)

        self.add(f"stretched {name}", stretch, (first, second), kind)

    def unary(self) -> None:
        name = self.choose([*_UNARY, "integer_pow", "is_finite"])
        dtypes = _UNARY.get(name, FLOATS)
        source = self.find(lambda kind: kind.dtype in dtypes)
        if source is None:
            return
        kind = self.kinds[source]
        if name == "integer_pow":
            power = self.choose((-2, -1, 2, 3, 4, 5))
            self.add(name, lambda x: lax.integer_pow(x, power), (source,), kind)
        elif name == "round":
            method = self.choose(lax.RoundingMethod)
            self.add(name, lambda x: lax.round(x, method), (source,), kind)
        elif name == "is_finite":
            self.add(name, lax.is_finite, (source,), kind._replace(dtype="bool"))
        else:
            self.add(name, getattr(lax, name), (source,), kind)

    def comparison(self) -> None:
        name = self.choose(_COMPARISONS)
        first = self.find(lambda kind: True)
        kind = self.kinds[first]  # pyright: ignore[reportArgumentType, reportCallIssue]
        second = self.find(lambda other: other == kind)
        out = kind._replace(dtype="bool")
        self.add(name, getattr(lax, name), (first, second), out)

    def select(self) -> None:
        first = self.find(lambda kind: True)
        kind = self.kinds[first]  # pyright: ignore[reportArgumentType, reportCallIssue]
        second = self.find(lambda other: other == kind)
        which = self.find(lambda k: k.dtype == "bool" and k.shape in ((), kind.shape))
        if which is not None:
            self.add("select", lax.select_n, (which, first, second), kind)

    def clamp(self) -> None:
        source = self.find(lambda kind: kind.dtype != "bool")
        if source is not None:
            kind = self.kinds[source]
            low = self.find(lambda other: other == kind)
            high = self.find(lambda other: other == kind)

            def clamp(*values):
                # With scalars, `jax.vmap` fails if only the limits are batched.
                out = lax.clamp(*[jnp.reshape(x, (-1,)) for x in values])
                return jnp.reshape(out, kind.shape)

            self.add("clamp", clamp, (low, source, high), kind)

    def convert(self) -> None:
        source = self.find(lambda kind: True)
        kind = self.kinds[source]  # pyright: ignore[reportArgumentType, reportCallIssue]
        # Not from integers to floats: XLA treats subnormal numbers as zero when it
        # computes, but keeps them when it copies.
        pairs = {"float32": "int32", "float64": "int64"}
        if kind.dtype in pairs and self.draw(st.booleans()):
            dtype = pairs[kind.dtype]
            bits = lambda x: lax.bitcast_convert_type(x, dtype)  # noqa: E731
            self.add("bitcast", bits, (source,), kind._replace(dtype=dtype))
            return
        dtype = self.choose(DTYPES)
        change = lambda x: lax.convert_element_type(x, dtype)  # noqa: E731
        self.add("convert", change, (source,), kind._replace(dtype=dtype))

    def reduce(self) -> None:
        source = self.find(lambda kind: len(kind.shape) > 0)
        if source is None:
            return
        kind = self.kinds[source]
        axis = self.choose(range(len(kind.shape)))
        shape = kind.shape[:axis] + kind.shape[axis + 1 :]
        if kind.dtype == "bool":
            name = self.choose(("reduce_and", "reduce_or"))
            reduce = lambda x: getattr(lax, name)(x, axes=(axis,))  # noqa: E731
            self.add(name, reduce, (source,), Kind("bool", shape))
            return
        name = self.choose(
            (
                "reduce_max",
                "reduce_min",
                "reduce_sum",
                "reduce_prod",
                "argmax",
                "argmin",
                "cumsum",
                "cummax",
            )
        )
        if name.startswith("arg"):
            if kind.shape[axis]:
                find = lambda x: getattr(lax, name)(x, axis, jnp.int32)  # noqa: E731
                self.add(name, find, (source,), Kind("int32", shape))
        elif name.startswith("cum"):
            few = whole if name == "cumsum" else (lambda x: x)
            run = lambda x: getattr(lax, name)(few(x), axis=axis) + _zero(x)  # noqa: E731
            self.add(name, run, (source,), kind)
        elif name in ("reduce_sum", "reduce_prod"):
            total = lambda x: (  # noqa: E731
                getattr(lax, name)(whole(x), axes=(axis,)) + _zero(x)
            )
            self.add(name, total, (source,), Kind(kind.dtype, shape))
        else:
            reduce = lambda x: getattr(lax, name)(x, axes=(axis,))  # noqa: E731
            self.add(name, reduce, (source,), Kind(kind.dtype, shape))

    def shape(self) -> None:
        source = self.find(lambda kind: kind.shape in ((3,), (2, 3)))
        if source is None:
            return
        kind = self.kinds[source]
        if kind.shape == (3,):
            options = {
                "rev": (lambda x: lax.rev(x, (0,)), (3,)),
                "spread": (lambda x: lax.broadcast_in_dim(x, (2, 3), (1,)), (2, 3)),
                "slice": (lambda x: lax.slice(x, (2,), (3,)).reshape(()), ()),
                "nothing": (lambda x: lax.slice(x, (1,), (1,)), (0,)),
            }
        else:
            options = {
                "transposed": (lambda x: x.T.reshape(2, 3), (2, 3)),
                "rev": (lambda x: lax.rev(x, (0, 1)), (2, 3)),
                "slice": (lambda x: lax.slice(x, (1, 0), (2, 3)).reshape(3), (3,)),
                "strided": (lambda x: x.reshape(6)[::2], (3,)),
            }
        name = self.choose(options)
        function, shape = options[name]
        self.add(name, function, (source,), Kind(kind.dtype, shape))

    def join(self) -> None:
        first = self.find(lambda kind: kind.shape in ((3,), (0,)))
        if first is None:
            return
        kind = self.kinds[first]
        second = self.find(lambda k: k.dtype == kind.dtype and k.shape in ((3,), (0,)))
        total = kind.shape[0] + self.kinds[second].shape[0]  # pyright: ignore
        shape = {0: (0,), 3: (3,), 6: (2, 3)}[total]
        both = lambda a, b: lax.concatenate([a, b], 0).reshape(shape)  # noqa: E731
        self.add("concatenate", both, (first, second), Kind(kind.dtype, shape))

    def pad(self) -> None:
        source = self.find(lambda kind: kind.shape in ((3,), (0,)))
        if source is None:
            return
        kind = self.kinds[source]
        value = self.find(lambda k: k == Kind(kind.dtype, ()))
        if value is None:
            return
        length, options = kind.shape[0], []
        for low in range(-4, 5):
            for step in (0, 1):
                size = length + max(length - 1, 0) * step
                options.append((low, 3 - size - low, step))
        config = self.choose(options)
        pad = lambda x, v: lax.pad(x, v, [config])  # noqa: E731
        self.add("pad", pad, (source, value), Kind(kind.dtype, (3,)))

    def _index(self) -> int | None:
        return self.find(lambda kind: kind.shape == () and kind.dtype in INTEGERS[:3])

    def indexed(self) -> None:
        source, index = self.find(lambda k: k.shape == (2, 3)), self._index()
        if source is not None and index is not None:
            kind, size = self.kinds[source], self.choose(((1, 3), (2, 3)))
            column = self.draw(st.booleans())

            def part(x, i):
                zero = jnp.zeros_like(i)
                if column:
                    return lax.dynamic_slice(x, (zero, i), (2, 1)).reshape(2)[0]
                return lax.dynamic_slice(x, (i, zero), size).reshape(
                    size[size[0] == 1 :]
                )

            shape = () if column else size[size[0] == 1 :]
            self.add("dynamic_slice", part, (source, index), Kind(kind.dtype, shape))

    def updated(self) -> None:
        source, index = self.find(lambda k: k.shape == (2, 3)), self._index()
        if source is None or index is None:
            return
        kind = self.kinds[source]
        row = self.find(lambda k: k == Kind(kind.dtype, (3,)))
        if row is not None:

            def update(x, u, i):
                return lax.dynamic_update_slice(x, u[None], (i, jnp.zeros_like(i)))

            self.add("dynamic_update_slice", update, (source, row, index), kind)

    def taken(self) -> None:
        source, index = self.find(lambda k: k.shape == (3,)), self._index()
        if source is not None and index is not None:
            mode = self.choose(("clip", "fill"))
            take = lambda x, i: x.at[i].get(mode=mode)  # noqa: E731
            kind = Kind(self.kinds[source].dtype, ())
            self.add("gather", take, (source, index), kind)

    def scattered(self) -> None:
        source, index = self.find(lambda k: k.shape == (3,)), self._index()
        if source is None or index is None:
            return
        kind = self.kinds[source]
        value = self.find(lambda k: k == Kind(kind.dtype, ()))
        if value is None:
            return
        names = ("set",) if kind.dtype == "bool" else ("set", "add", "multiply", "max")
        name, mode = self.choose(names), self.choose(("clip", "drop"))
        put = lambda x, v, i: getattr(x.at[i], name)(v, mode=mode)  # noqa: E731
        self.add(f"scatter {name}", put, (source, value, index), kind)

    def product(self) -> None:
        matrix = self.find(lambda k: k.shape == (2, 3) and k.dtype != "bool")
        if matrix is None:
            return
        dtype = self.kinds[matrix].dtype
        vector = self.find(lambda k: k == Kind(dtype, (3,)))
        if vector is None:
            return
        product = lambda a, b: whole(a) @ whole(b) + _zero(a)  # noqa: E731
        once = lambda a, b: jnp.concatenate([product(a, b), whole(b)[:1]])  # noqa: E731
        self.add("dot_general", once, (matrix, vector), Kind(dtype, (3,)))


def _zero(x: Any) -> Any:
    """Make a zero, whose sum with -0.0 is +0.0."""
    return jnp.zeros((), x.dtype)
