"""What the value of a member says of how its run ended."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from .._integrate import Solution
from .._results import result_codes, RESULTS


NO_STEP = -1
NO_FAILURES = ("successful", "event_occurred")


def is_result(x: Any) -> bool:
    """Tell whether `x` is a member of `nhjax.RESULTS`, or an array of them."""
    return isinstance(x, type(RESULTS.successful)) and x._enumeration is RESULTS


def is_good(codes: Any) -> Any:
    """Tell which codes of `RESULTS` are no failures."""
    good = [codes == result_codes()[name] for name in NO_FAILURES]
    return good[0] | good[1]


def verdict(value: Any) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """Return the code of the first failure in a value, and the step at which it was.

    Looked at are the `nhjax.Solution`s and `nhjax.RESULTS` anywhere in the value. The
    step is -1 where none is known.
    """
    codes, steps = [], []
    nodes = jax.tree.leaves(
        value, is_leaf=lambda x: isinstance(x, Solution) or is_result(x)
    )
    for node in nodes:
        if isinstance(node, Solution):
            codes.append(node.result._value)
            steps.append(node.stats["failed_step"])
        elif is_result(node):
            codes.append(node._value)
            steps.append(jnp.full(jnp.shape(node._value), NO_STEP))
    good = result_codes()["successful"]
    codes.append(jnp.asarray(good))
    steps.append(jnp.asarray(NO_STEP))
    flat = [
        jnp.concatenate([jnp.ravel(x).astype(jnp.int32) for x in parts])
        for parts in (codes, steps)
    ]
    # The first that fails; without one, the success that stands at the end.
    bad = ~is_good(flat[0]).at[-1].set(False)
    first = jnp.argmax(bad)
    return flat[0][first], flat[1][first]


def codes_of_results(value: Any) -> Any:
    """Replace `RESULTS` by their codes, but not those of a solution itself."""
    if isinstance(value, Solution):
        return value
    return jax.tree.map(
        lambda x: x._value if is_result(x) else x, value, is_leaf=is_result
    )


def without_results(value: Any) -> Any:
    """Leave out the `RESULTS`, of which there are no statistics."""
    return jax.tree.map(lambda x: None if is_result(x) else x, value, is_leaf=is_result)
