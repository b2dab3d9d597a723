"""The members of an ensemble, as arrays or as a function of their index."""

import hashlib
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._errors import is_traced, ShapeError


class _FromArrays(eqx.Module):
    """Make a member from its leaves, and random keys from the integers in them."""

    treedef: Any = eqx.field(static=True)
    keys: tuple[Any, ...] = eqx.field(static=True)

    def __call__(self, leaves: list[Any]) -> Any:
        """Make the member from its leaves."""
        made = [
            x if impl is None else jax.random.wrap_key_data(x, impl=impl)
            for x, impl in zip(leaves, self.keys, strict=True)
        ]
        return jax.tree.unflatten(self.treedef, made)


class Members:
    """The members of an ensemble, given by their number and a function that makes one.

    - `count`: how many there are.
    - `make`: a function of one member's input that makes the member, for JAX to trace.
    """

    count: int
    make: Callable[[Any], Any]

    def __init__(self, members: Any, num_members: int | None):
        if callable(members):
            if num_members is None:
                raise ValueError(
                    "`num_members` is needed where `members` is a function of the "
                    "index of a member."
                )
            self._leaves = None
            self.make, self.count = members, _count(num_members)
            return
        leaves, treedef = jax.tree.flatten(members)
        if is_traced(*leaves):
            raise RuntimeError(
                "`nhjax.ensemble` runs chunk after chunk on the host: call it outside "
                "of jit, vmap and grad."
            )
        self.count = _leading_size(members)
        if num_members is not None and num_members != self.count:
            raise ValueError(
                f"`num_members` is {num_members}, but the arrays of `members` have "
                f"{self.count} rows: leave it out."
            )
        keys = [jax.random.key_impl(x) if _is_key(x) else None for x in leaves]
        # A view where they are arrays of NumPy, such as those mapped from a file.
        self._leaves = [
            np.asarray(jax.random.key_data(x) if impl else _canonical(x))
            for x, impl in zip(leaves, keys, strict=True)
        ]
        self.make = _FromArrays(treedef, tuple(keys))

    def inputs(self, start: int, size: int) -> Any:
        """Return the inputs of `size` members; after the end the last is repeated."""
        indices = np.minimum(np.arange(start, start + size), self.count - 1)
        if self._leaves is None:
            return indices.astype(jnp.result_type(int))
        if start + size <= self.count:
            return [_canonical(x[start : start + size]) for x in self._leaves]
        return [_canonical(x[indices]) for x in self._leaves]

    def digest(self) -> str:
        """Compute a digest of the arrays; a function is a part of the program."""
        if self._leaves is None:
            return "a function"
        made = hashlib.sha256()
        for x in self._leaves:
            made.update(f"{x.dtype.str}{x.shape}".encode())
            # Not all at once: the copy would be as large as what is mapped.
            for start in range(0, len(x), 65536):
                made.update(np.ascontiguousarray(x[start : start + 65536]).tobytes())
        return made.hexdigest()


def _canonical(x: Any) -> Any:
    """Convert as JAX would: float64 to float32, unless it is set to float64."""
    if isinstance(x, jax.Array):
        return x
    return np.asarray(x, jax.dtypes.canonicalize_dtype(np.asarray(x).dtype))


def _is_key(x: Any) -> bool:
    return isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def _count(number: Any) -> int:
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
                f"{name} is {leaf!r}, but `members` holds arrays, each with a row for "
                "each member; `run` can close over everything else."
            )
        if np.ndim(leaf) == 0:
            raise ShapeError(
                f"{name} is a single number, but each array of `members` has the "
                "members as leading axis; `run` can close over what they share."
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
