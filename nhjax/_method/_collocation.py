"""The collocation methods: the Lobatto IIIA-IIIB pair and Gauss."""

import equinox as eqx

from ._abstract import AbstractMethod, check_chart, check_closure, check_stages
from ._tableau import gauss_tableau, lobatto_tableau, Tableau


class LobattoIIIAB(AbstractMethod):
    """The Lobatto IIIA-IIIB pair of order 2s - 2, symmetric and fit for any system.

    It integrates q by Lobatto IIIA (a, b) and p by the symplectic conjugate, Lobatto
    IIIB (â, b). These are the paper's methods. For s = 2 it is the trapezoidal rule
    with its conjugate, which for a separable Lagrangian is the Störmer-Verlet method.

    !!! example

        >>> method = LobattoIIIAB(stages=3)
        >>> method.order, method.orders
        (4, SimplifyingAssumptions(B=4, C=3, D=1, mixed=3))
    """

    stages: int = eqx.field(static=True)
    closure: str = eqx.field(static=True)
    chart: str = eqx.field(static=True)

    def __init__(self, stages: int, closure: str = "symmetric", chart: str = "middle"):
        """
        **Arguments:**

        - `stages`: s from 2 to 32, beyond which coefficients take minutes to find
            and nothing is gained in float64.
        - `closure`: how the first of the s multipliers of a step is determined, for
            which there is no equation. `"propagated"`, the choice of the paper, carries
            Λ^s to the next step as its Λ^1. `"consistent"` takes for Λ^1 the continuous
            multiplier of the state. `"symmetric"` uses the continuous multipliers of
            the states at both ends of the step, with one unknown added that makes the
            step symmetric; a step then depends on nothing but its state.
        - `chart`: where, on a Lie group, the chart of a step has its origin. With
            `"middle"` a step leads from -ξ/2 to ξ/2 in its chart, and is symmetric;
            without constraints it is symplectic. With `"start"`, the choice of the
            paper, it leads from 0 to ξ, and is not symmetric. On a vector space the two
            are the same.

        **Raises:**

        A `TypeError` if `stages` is no integer; a `ValueError` if it is out of range,
        or if `closure` or `chart` is not one of the choices.
        """
        self.stages = check_stages(stages, 2, "LobattoIIIAB")
        self.closure = check_closure(closure)
        self.chart = check_chart(chart)

    @property
    def order(self) -> int:
        """Return the order 2s - 2."""
        return 2 * self.stages - 2

    def _tableau(self) -> Tableau:
        return lobatto_tableau(self.stages)


class Gauss(AbstractMethod):
    """The Gauss method of order 2s, symplectic and symmetric, without constraints.

    Its tableau (a, b) is its own symplectic conjugate. The stages do not include the
    ends of the step (hypotheses H1 and H3 fail), so that `integrate` refuses it for
    systems with constraints.

    !!! example

        >>> method = Gauss(stages=2)
        >>> method.order, method.hypotheses
        (4, Hypotheses(H1=False, H2=True, H3=False))
    """

    stages: int = eqx.field(static=True)
    chart: str = eqx.field(static=True)

    def __init__(self, stages: int, chart: str = "middle"):
        """
        **Arguments:**

        - `stages`: s from 1 to 32, beyond which coefficients take minutes to find
            and nothing is gained in float64.
        - `chart`: as for `LobattoIIIAB`.

        **Raises:**

        A `TypeError` if `stages` is no integer; a `ValueError` if it is out of range,
        or if `chart` is not one of the two.
        """
        self.stages = check_stages(stages, 1, "Gauss")
        self.chart = check_chart(chart)

    @property
    def closure(self) -> None:
        """Return None: the method takes no constraints, and so needs no closure."""
        return None

    @property
    def order(self) -> int:
        """Return the order 2s."""
        return 2 * self.stages

    def _tableau(self) -> Tableau:
        return gauss_tableau(self.stages)
