"""The closures, which express a step's multipliers by as many unknowns as equations.

The constraint at stage 1 holds by hypothesis H1, which leaves (s - 1) equations per
constraint for s multipliers. A closure writes the multipliers as

    (Λ^1, ..., Λ^s) = start λ_k + end λ_{k+1} + E y,    y of s - 1 entries,

and the leading part of the constraints' linearisation is A_{2:,:} E.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ._conditions import stability_at_infinity
from ._precision import CONTEXT, to_float64
from ._tableau import Tableau


@dataclass(frozen=True, eq=False)
class ClosureWeights:
    """The weights of a closure, by which a step's multipliers follow from its unknowns.

    They are read-only float64 arrays; instances are compared by identity.

    **Fields:**

    - `E`: shape (s, s-1), the weights of the unknowns y.
    - `start`: shape (s,), the weights of the multiplier λ_k at t_k.
    - `end`: shape (s,), the weights of the continuous multiplier λ_c(q_{k+1}, p_{k+1}).
    - `response`: shape (s-1,), the change of y which, with a change of λ_{k+1} by one,
        leaves Σ_j a_ij Λ^j, i >= 2, as they are.
    - `stage_response`: shape (s,), by how much Σ_j â_ij Λ^j change then.
    """

    E: np.ndarray
    start: np.ndarray
    end: np.ndarray
    response: np.ndarray
    stage_response: np.ndarray


@lru_cache(maxsize=128)
def make_closure_weights(t: Tableau, symmetric: bool) -> ClosureWeights:
    """Make the weights of the closure of a tableau that satisfies H1, H2 and H3.

    If the closure is not symmetric, Λ^1 = λ_k and y = (Λ^2, ..., Λ^s), as in the
    equations of the paper. The symmetric closure has y = (ν, Λ^2, ..., Λ^{s-1}),
    Λ^1 = λ_k + ν and Λ^s = λ_{k+1} + σ ν. A step back exchanges the two ends and maps
    ν to σ ν, so that it retraces the step if σ = ±1. Of these two σ = -R_A(∞) is the
    one for which A_{2:,:} E is invertible, because the solutions of
    Σ_j a_ij Λ^j = 0, i >= 2, have Λ^s = R_A(∞) Λ^1.

    **Arguments:**

    - `t`: the tableau.
    - `symmetric`: whether to make the symmetric closure; needs R_A(∞) = ±1.

    **Returns:**

    A `ClosureWeights`, the same object at every call.

    !!! example

        >>> from nhjax._method._tableau import lobatto_tableau
        >>> make_closure_weights(lobatto_tableau(3), symmetric=True).E.tolist()
        [[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]]
    """
    s = t.stages
    e = CONTEXT.matrix(s, s - 1)
    end = [CONTEXT.mpf(0)] * s
    if symmetric:
        e[0, 0] = CONTEXT.one
        e[s - 1, 0] = CONTEXT.mpf(-round(stability_at_infinity(t)))
        end[s - 1] = CONTEXT.one
        for i in range(1, s - 1):
            e[i, i] = CONTEXT.one
    else:
        for i in range(1, s):
            e[i, i - 1] = CONTEXT.one
    # These two are part of a Jacobian, for which float64 is enough.
    weights, last = to_float64(e), to_float64(end)
    response = -np.linalg.solve(t.a[1:] @ weights, t.a[1:] @ last)
    return ClosureWeights(
        E=weights,
        start=to_float64([CONTEXT.one] + [CONTEXT.mpf(0)] * (s - 1)),
        end=last,
        response=to_float64(list(response)),
        stage_response=to_float64(list(t.a_hat @ (weights @ response + last))),
    )
