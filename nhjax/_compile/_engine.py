"""Which engine compiles a program: chosen by the environment, and told on request."""

import os
from collections.abc import Callable
from contextvars import ContextVar
from typing import Any, NamedTuple

import jax


# In the order in which they are tried.
ENGINES = ("lanes", "kernels", "xla")


class EngineUse(NamedTuple):
    """The engine that compiles one program, and why it is this one.

    - `engine`: `"lanes"` is nhjax's own compiler, which runs the members of an ensemble
        in the lanes of vectors; `"kernels"` is XLA with one kernel for each member;
        `"xla"` is XLA without that.
    - `reason`: why no engine before it was taken, or that it was chosen.
    - `members`: the number of members of an ensemble; `None` for a single run.
    """

    engine: str
    reason: str
    members: int | None


def chosen_engine() -> str:
    """Read `NHJAX_ENGINE` from the environment: the first engine that may be taken."""
    chosen = os.environ.get("NHJAX_ENGINE", ENGINES[0])
    if chosen not in ENGINES:
        raise ValueError(
            f"The environment variable NHJAX_ENGINE is {chosen!r}, which is none of "
            f"{', '.join(map(repr, ENGINES))}: set it to one of these, or unset it."
        )
    return chosen


# A list while programs are lowered for `engines`, else None.
_uses: ContextVar[list[EngineUse] | None] = ContextVar("uses", default=None)


def note(engine: str, reason: str, members: int | None) -> None:
    """Take down which engine a program is compiled by, if anyone has asked."""
    uses = _uses.get()
    if uses is not None:
        uses.append(EngineUse(engine, reason, members))


def engines(function: Callable[..., Any], *args: Any) -> tuple[EngineUse, ...]:
    """Tell which engines compile the programs of `function(*args)` on a CPU, and why.

    The function is compiled, but not run. On the CPU an ensemble, which is a run
    under `jax.vmap`, is compiled by nhjax itself if it can, so that its members run in
    the lanes of vectors. The environment variable `NHJAX_ENGINE` with one of the values
    `lanes` (the default), `kernels` and `xla` sets the first engine that is tried; what
    has been compiled before keeps its engine until `jax.clear_caches()`.

    **Arguments:**

    - `function`: a function of arrays that can be compiled by `jax.jit`.
    - `args`: its arguments, trees of arrays.

    **Returns:** an `EngineUse` for each program, in the order of compilation: the
    engine, the reason why it is this one, and the number of members.

    !!! example

        ```python
        run = jax.vmap(lambda y0: nhjax.step(system, method, 0.0, 0.1, y0))
        for use in nhjax.engines(run, ensemble):
            print(use.engine, use.members, use.reason)
        ```
    """
    token = _uses.set(uses := [])
    try:
        # A function of its own: nothing that is cached is taken for it.
        jax.jit(lambda *args: function(*args)).lower(*args)
    finally:
        _uses.reset(token)
    return tuple(uses)
