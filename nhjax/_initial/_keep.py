"""The components of an initial state that a projection keeps, and their names."""

import operator
import reprlib
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._errors import is_traced
from .._system import AbstractMechanicalSystem


T = TypeVar("T", bound=PyTree[Array])
# The components that a user chooses: an index or a name, or several of them.
Chosen: TypeAlias = int | str | Iterable[int | str] | None


class Kept(NamedTuple):
    """The components of q, v or p that a projection leaves as they were given.

    - `letter`: the argument whose components they are: "q", "v" or "p".
    - `indices`: their places among all numbers of that argument.
    - `labels`: what messages call them, such as "v[2]".
    """

    letter: str
    indices: tuple[int, ...] = ()
    labels: tuple[str, ...] = ()

    @property
    def argument(self) -> str:
        """Return the name of the argument of `initial_state` that chose them."""
        return f"keep_{self.letter}"

    def restored(self, tree: T, given: T) -> T:
        """Return a tree whose kept numbers are the ones of `given`, bit for bit."""
        if not self.indices:
            return tree
        is_kept = np.zeros(sum(x.size for x in jax.tree.leaves(tree)), bool)
        is_kept[list(self.indices)] = True
        leaves, structure = jax.tree.flatten(tree)
        ends = np.cumsum([x.size for x in leaves])[:-1]
        masks = [
            mask.reshape(x.shape)
            for mask, x in zip(np.split(is_kept, ends), leaves, strict=True)
        ]
        return jax.tree.map(
            jnp.where, jax.tree.unflatten(structure, masks), given, tree
        )


def kept_numbers(tree: PyTree[Array], kept: Kept) -> Float[Array, " k"]:
    """Return the kept numbers of a tree as one vector."""
    numbers = jnp.concatenate([x.reshape(-1) for x in jax.tree.leaves(tree)])
    return numbers[jnp.asarray(kept.indices, int)]


def checked_keep(
    system: AbstractMechanicalSystem,
    q: PyTree[Array],
    letter: str,
    chosen: dict[str, Any],
    project: bool,
) -> tuple[Kept, Kept]:
    """Return the kept numbers of q and the kept components of the given v or p.

    **Arguments:**

    - `letter`: "v" or "p", whichever was given.
    - `chosen`: the arguments `keep_q`, `keep_v` and `keep_p` by the letters q, v and p.
    """
    other = "p" if letter == "v" else "v"
    if chosen[other] is not None:
        raise ValueError(
            f"`keep_{other}` chooses components of `{other}`, but `{letter}` is given: "
            f"use `keep_{letter}`, or give `{other}` in place of `{letter}`."
        )
    dimension = system.manifold_of(q).dim
    of_q = _kept(system, "q", chosen["q"], _labels(q), dimension)
    labels = [f"{letter}[{i}]" for i in range(dimension)]
    of_u = _kept(system, letter, chosen[letter], labels, dimension)
    for kept in (of_q, of_u):
        if kept.indices and not project:
            raise ValueError(
                f"`{kept.argument}` chooses what a projection keeps, but `project` is "
                f"False, by which all of `{kept.letter}` is kept: pass `project=True`, "
                f"or leave `{kept.argument}` out."
            )
    return of_q, of_u


def _labels(q: PyTree[Array]) -> list[str]:
    """Write the places of all numbers of q, such as "q[1][0]" in a tuple."""
    found = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(q):
        where = "q" + jax.tree_util.keystr(path)
        found += [
            f"{where}[{', '.join(map(str, index))}]" for index in np.ndindex(leaf.shape)
        ]
    return found


def _kept(
    system: AbstractMechanicalSystem,
    letter: str,
    given: Any,
    labels: list[str],
    dimension: int,
) -> Kept:
    if given is None:
        return Kept(letter)
    name = f"keep_{letter}"
    entries = _entries(name, given)
    indices = [_index(system, name, x, len(labels), dimension) for x in entries]
    for i in indices:
        if indices.count(i) > 1:
            raise ValueError(f"`{name}` = {given!r} has {labels[i]} more than once.")
    names = system.coordinates
    if names is not None and len(names) == len(labels):
        labels = [f"{label} ({x})" for label, x in zip(labels, names, strict=True)]
    indices = tuple(sorted(indices))
    return Kept(letter, indices, tuple(labels[i] for i in indices))


def _entries(name: str, given: Any) -> list[Any]:
    """List what an argument chooses, which is one index or name or several."""
    if is_traced(*jax.tree.leaves(given)):
        raise TypeError(
            f"`{name}` is a traced array, but must be known when tracing: which "
            "components are kept decides the program. Pass a tuple of ints, and keep "
            "it out of the arguments of `jax.jit` and `jax.vmap`."
        )
    is_one = isinstance(given, str) or getattr(given, "ndim", None) == 0
    if is_one or not isinstance(given, Iterable):
        return [given]
    if isinstance(given, Mapping):
        raise TypeError(_wrong_kind(name, given))
    return list(given)


def _wrong_kind(name: str, x: Any) -> str:
    return (
        f"`{name}` must be indices or names of components, got {reprlib.repr(x)} of "
        f"type {type(x).__name__}."
    )


def _index(
    system: AbstractMechanicalSystem, name: str, x: Any, size: int, dimension: int
) -> int:
    """Return the index that an index or a name stands for, or raise."""
    letter = name[-1]
    if isinstance(x, str):
        return _index_of_name(system, name, x, size, dimension)
    if isinstance(x, bool) or getattr(x, "dtype", None) == np.bool_:
        raise TypeError(
            f"`{name}` must be indices or names of components, and not bools; of a "
            "mask, `numpy.flatnonzero(mask)` has the indices."
        )
    try:
        index = operator.index(x)
    except TypeError:
        raise TypeError(_wrong_kind(name, x)) from None
    if not -size <= index < size:
        raise ValueError(
            f"`{name}` has the index {index}, but `{letter}` has {size} numbers: 0 to "
            f"{size - 1}."
        )
    return index % size


def _index_of_name(
    system: AbstractMechanicalSystem, name: str, x: str, size: int, dimension: int
) -> int:
    names, letter = system.coordinates, name[-1]
    if names is None:
        raise ValueError(
            f"`{name}` has the name {x!r}, but the system has no names: give indices, "
            f"or give the system names, `{type(system).__name__}(..., "
            "coordinates=(...))`."
        )
    if len(names) != dimension:
        raise ValueError(
            f"`{name}` has the name {x!r}, but `coordinates` of the system has "
            f"{len(names)} names for {dimension} coordinates: {', '.join(names)}."
        )
    if size != dimension:
        raise ValueError(
            f"`{name}` has the name {x!r}, but the {size} numbers of `{letter}` are "
            f"not the {dimension} coordinates that have names: give indices of "
            f"`{letter}`."
        )
    if x not in names:
        raise ValueError(
            f"`{name}` has the name {x!r}, but the coordinates are {', '.join(names)}."
        )
    return names.index(x)
