"""The collocation methods: the Lobatto IIIA-IIIB pair and Gauss."""

import equinox as eqx

from ._abstract import AbstractMethod, check_closure, check_stages
from ._tableau import gauss_tableau, lobatto_tableau, Tableau


class LobattoIIIAB(AbstractMethod):
    """The Lobatto IIIA-IIIB pair: order 2s - 2, symmetric, for any system.

    Lobatto IIIA (a, b) for q and its symplectic conjugate, Lobatto IIIB (â, b), for p:
    the paper's methods. s = 2 is the trapezoidal rule with its conjugate, that is
    Störmer-Verlet for a separable Lagrangian.

    !!! example

        >>> method = LobattoIIIAB(stages=3)
        >>> method.order, method.orders
        (4, SimplifyingAssumptions(B=4, C=3, D=1, mixed=3))
    """

    stages: int = eqx.field(static=True)
    closure: str = eqx.field(static=True)

    def __init__(self, stages: int, closure: str = "symmetric"):
        """
        **Arguments:**

        - `stages`: s from 2 to 32, beyond which coefficients take minutes to find
            and nothing is gained in float64.
        - `closure`: how the constraints' multipliers are closed from step to step.
            `"propagated"` carries Λ^s to the next step as its Λ^1 (the paper's);
            `"consistent"` starts each step from the continuous multiplier of the state;
            `"symmetric"` does so at both ends, up to one unknown that makes the step
            symmetric, and remembers nothing but the state.

        **Raises:**

        A `TypeError` if `stages` is no integer; a `ValueError` if it is out of range,
        or if `closure` is not one of the three.
        """
        self.stages = check_stages(stages, 2, "LobattoIIIAB")
        self.closure = check_closure(closure)

    def _tableau(self) -> Tableau:
        return lobatto_tableau(self.stages)


class Gauss(AbstractMethod):
    """The Gauss methods: order 2s, symplectic and symmetric, without constraints.

    (a, b) is its own symplectic conjugate. Its stages do not include the ends of the
    step (H1 and H3 fail), so with constraints it is refused.

    !!! example

        >>> method = Gauss(stages=2)
        >>> method.order, method.hypotheses
        (4, Hypotheses(H1=False, H2=True, H3=False))
    """

    stages: int = eqx.field(static=True)

    def __init__(self, stages: int):
        """
        **Arguments:**

        - `stages`: s from 1 to 32, beyond which coefficients take minutes to find
            and nothing is gained in float64.

        **Raises:**

        A `TypeError` if `stages` is no integer, a `ValueError` if it is out of range.
        """
        self.stages = check_stages(stages, 1, "Gauss")

    @property
    def closure(self) -> None:
        """None: the methods take no constraints, whose multipliers a closure gives."""
        return None

    def _tableau(self) -> Tableau:
        return gauss_tableau(self.stages)
