"""Random small programs over the primitives that lanes support."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from hypothesis import strategies as st
from jax import lax

from support.random_steps import (
    DTYPES,
    evaluate,
    INTEGERS,
    Kind,
    SHAPES,
    Step,
    Steps,
)


class Programs(Steps):
    """Makes a program, step by step, with loops and branches."""

    def grow(self, count: int) -> list[Step]:
        """Append a number of steps."""
        makers = [
            self.binary,
            self.stretched,
            self.unary,
            self.comparison,
            self.select,
            self.clamp,
            self.convert,
            self.reduce,
            self.shape,
            self.join,
            self.pad,
            self.indexed,
            self.updated,
            self.taken,
            self.scattered,
            self.product,
        ]
        if self.depth > 0:
            makers += [self.loop, self.scan, self.branch] * 2
        for _ in range(count):
            self.choose(makers)()
        return self.steps

    # Loops and branches, whose bodies use all earlier arrays

    def inner(self, own: list[Kind], outs: list[Kind]) -> Callable[..., list[Any]]:
        """Make a function of earlier and own arrays, with results of given kinds."""
        inside = Programs(self.draw, [*self.kinds, *own], self.depth - 1)
        steps = inside.grow(self.draw(st.integers(1, 4)))
        places = []
        for position, kind in enumerate(outs):
            found = [i for i, k in enumerate(inside.kinds) if k == kind]
            # The last array is the most interesting, so it is the first choice.
            default = [len(self.kinds) + position]
            places.append(inside.choose([*reversed(found), *default]))

        def function(outer, own):
            values = evaluate(steps, [*outer, *own])
            return [values[place] for place in places]

        function.steps = steps  # pyright: ignore[reportFunctionMemberAccess]
        return function

    def _carry(self) -> list[int]:
        count = self.draw(st.integers(1, 2))
        return [self.find(lambda kind: True) for _ in range(count)]  # pyright: ignore

    def loop(self) -> None:
        limit = self._index()
        if limit is None:
            return
        sources = self._carry()
        kinds = [self.kinds[i] for i in sources]
        counter = Kind("int32", ())
        body = self.inner([*kinds, counter], kinds)
        size = len(self.kinds)

        def loop(*values):
            outer, carry = values[:size], values[size:-1]
            most = lax.rem(
                lax.convert_element_type(values[-1], jnp.int32), jnp.int32(5)
            )

            def step(state):
                return [*body(outer, state), state[-1] + jnp.int32(1)]

            start = [*carry, jnp.zeros((), jnp.int32)]
            return tuple(lax.while_loop(lambda s: s[-1] < most, step, start))

        everything = [*range(size), *sources, limit]
        self.add("while", loop, everything, *kinds, counter)

    def scan(self) -> None:
        sources = self._carry()
        kinds = [self.kinds[i] for i in sources]
        rows = self.find(lambda k: k.shape in ((3,), (2, 3)))
        if rows is None:
            return
        row = Kind(self.kinds[rows].dtype, self.kinds[rows].shape[1:])
        repeats = self.choose((1, 5))
        body = self.inner([*kinds, row], [*kinds, row])
        size, is_reversed = len(self.kinds), self.draw(st.booleans())

        def scan(*values):
            outer, carry, xs = values[:size], values[size:-1], values[-1]
            # Sometimes there are more rounds than are unrolled.
            xs = jnp.concatenate([xs] * repeats)

            def step(carry, x):
                *carry, y = body(outer, [*carry, x])
                return carry, y

            carry, ys = lax.scan(step, list(carry), xs, reverse=is_reversed)
            return *carry, ys[: len(values[-1])]

        self.add("scan", scan, [*range(size), *sources, rows], *kinds, self.kinds[rows])

    def branch(self) -> None:
        predicate = self.find(lambda kind: kind == Kind("bool", ()))
        if predicate is None:
            return
        sources = self._carry()
        kinds = [self.kinds[i] for i in sources]
        yes, no = self.inner(kinds, kinds), self.inner(kinds, kinds)
        size = len(self.kinds)

        def branch(*values):
            outer, own = values[:size], values[size:-1]
            # `jax.vmap` turns this branch into a selection, but not `lax.switch`.
            return tuple(
                lax.cond(
                    values[-1],
                    lambda: yes(outer, own),
                    lambda: no(outer, own),
                )
            )

        self.add("cond", branch, [*range(size), *sources, predicate], *kinds)


@st.composite
def programs(draw: Callable) -> tuple[list[Kind], list[Step]]:
    """Make the kinds of the operands of a program, and its steps."""
    kind = st.builds(Kind, st.sampled_from(DTYPES), st.sampled_from(SHAPES))
    kinds = draw(st.lists(kind, min_size=2, max_size=4))
    # Without an index and a predicate few steps are possible.
    kinds += [Kind(draw(st.sampled_from(INTEGERS[:3])), ()), Kind("bool", ())]
    made = Programs(draw, kinds, depth=2)
    return kinds, made.grow(draw(st.integers(1, 8)))
