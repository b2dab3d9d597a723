"""A partitioned Runge-Kutta method from the coefficients of a user."""

import equinox as eqx
import numpy as np
from numpy.typing import ArrayLike

from ._abstract import AbstractMethod, check_chart, check_closure
from ._tableau import Tableau, user_tableau


class PartitionedRungeKutta(AbstractMethod):
    """A method from any Runge-Kutta tableau (a, b) for q, with its conjugate for p.

    The nodes c_i = Σ_j a_ij and the symplectic conjugate â_ij = b_j (1 - a_ji / b_i)
    follow from the tableau. The float64 coefficients are taken as exact, and the
    conditions on them are checked to 1e-13. (At s = 12 the defect of the first order
    that a tableau lacks may itself be that small, and `orders` is then too high.) For
    systems with constraints the tableau must satisfy H1, H2 and H3.

    !!! example

        >>> method = PartitionedRungeKutta(a=[[0, 0], [0.5, 0.5]], b=[0.5, 0.5])
        >>> method.order, method.a_hat.tolist()
        (2, [[0.5, 0.0], [0.5, 0.0]])
    """

    stages: int = eqx.field(static=True)
    closure: str = eqx.field(static=True)
    chart: str = eqx.field(static=True)
    _coefficients: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    _weights: tuple[float, ...] = eqx.field(static=True)

    def __init__(
        self,
        a: ArrayLike,
        b: ArrayLike,
        closure: str = "symmetric",
        chart: str = "middle",
    ):
        """
        **Arguments:**

        - `a`: the coefficients a_ij, shape (s, s), not traced.
        - `b`: the weights b_j, shape (s,), none of them zero and of sum 1.
        - `closure`, `chart`: as for `LobattoIIIAB`.

        **Raises:**

        A `ValueError` if a shape is wrong, an entry is not finite, a weight is zero,
        the weights do not sum to 1, or `closure` or `chart` is not one of the choices.
        """
        a = np.asarray(a, dtype=np.float64)
        b = np.asarray(b, dtype=np.float64)
        if b.ndim != 1 or b.size == 0:
            raise ValueError(f"b must have shape (s,) with s >= 1, got {b.shape}")
        if a.shape != (b.size, b.size):
            raise ValueError(
                f"a must have shape {(b.size, b.size)} to match b, got {a.shape}"
            )
        for name, array in (("a", a), ("b", b)):
            if not np.isfinite(array).all():
                raise ValueError(f"{name} must be finite, got {array.tolist()}")
        if (b == 0).any():
            raise ValueError(
                f"b must have no zero weight, got {b.tolist()}: the symplectic "
                "conjugate b_j (1 - a_ji / b_i) would not exist"
            )
        if abs(b.sum() - 1) > 1e-13:
            raise ValueError(f"b must sum to 1, got {float(b.sum())!r}")
        self.stages = b.size
        self.closure = check_closure(closure)
        self.chart = check_chart(chart)
        self._coefficients = tuple(tuple(row) for row in a.tolist())
        self._weights = tuple(b.tolist())

    def _tableau(self) -> Tableau:
        return user_tableau(self._coefficients, self._weights)
