"""The search for the first zero of several functions in an interval, by brackets."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._custom_types import BoolScalar, FloatScalar


class Bracket(eqx.Module):
    """An interval of θ in which the first of some functions crosses zero.

    None has crossed it at the lower end, and the `crossed` ones have at the upper end.
    The next place to look at is that of Chandrupatla (1997): inverse quadratic
    interpolation where the three last points allow it, and otherwise the middle. It
    needs about as few evaluations as Newton's method, and never more than some three
    times those of bisection.

    - `new`, `other`, `old`: the newest point, the other end, and the one before. Each
        is θ and the values of all functions there.
    - `is_upper`: whether the newest point is the upper end.
    """

    new: tuple[FloatScalar, Float[Array, " e"]]
    other: tuple[FloatScalar, Float[Array, " e"]]
    old: tuple[FloatScalar, Float[Array, " e"]]
    is_upper: BoolScalar
    crossed: Bool[Array, " e"]

    @classmethod
    def open_from(cls, values: Float[Array, " e"]) -> "Bracket":
        """Start at θ = 0 with these values; the first point to add is θ = 1."""
        start = jnp.zeros((), values.dtype), values
        nothing = jnp.zeros(values.shape, bool)
        return cls(start, start, start, jnp.asarray(False), nothing)

    def with_point(
        self, theta: FloatScalar, values: Float[Array, " e"], crossed: Bool[Array, " e"]
    ) -> "Bracket":
        """Shorten the interval by a point in it, where some functions have crossed."""
        is_upper = jnp.any(crossed)
        same = is_upper == self.is_upper

        def either(x, y):
            return jnp.where(same, x[0], y[0]), jnp.where(same, x[1], y[1])

        return Bracket(
            new=(theta, values),
            other=either(self.other, self.new),
            old=either(self.new, self.other),
            is_upper=is_upper,
            crossed=jnp.where(is_upper, crossed, self.crossed),
        )

    @property
    def _ends(self) -> tuple[FloatScalar, FloatScalar]:
        (x, _), (y, _) = self.new, self.other
        return jnp.minimum(x, y), jnp.maximum(x, y)

    @property
    def upper(self) -> FloatScalar:
        """Return the upper end, where some functions have crossed zero."""
        return self._ends[1]

    @property
    def found(self) -> BoolScalar:
        """Tell whether the upper end is the zero, to round-off."""
        lower, upper = self._ends
        values = jnp.where(self.is_upper, self.new[1], self.other[1])
        exact = jnp.all(~self.crossed | (values == 0))
        return exact | (upper - lower <= 2 * self._tolerance)

    @property
    def _tolerance(self) -> float:
        return 2 * float(jnp.finfo(self.new[0].dtype).eps)

    def next_place(self) -> FloatScalar:
        """Find the place where the first of the crossed functions seems to vanish."""
        (a, fa), (b, fb), (c, fc) = self.new, self.other, self.old
        linear = fa / (fa - fb)
        xi, phi = (a - b) / (c - b), (fa - fb) / (fc - fb)
        may_be_quadratic = (phi**2 < xi) & ((1 - phi) ** 2 < 1 - xi)
        quadratic = fa / (fb - fa) * fc / (fb - fc)
        quadratic = quadratic + (c - a) / (b - a) * fa / (fc - fa) * fb / (fc - fb)
        # At first there are two points alone.
        part = jnp.where(c == b, linear, jnp.where(may_be_quadratic, quadratic, 0.5))
        part = jnp.where((part >= 0) & (part <= 1), part, 0.5)
        places = jnp.where(self.crossed, a + part * (b - a), jnp.inf)
        lower, upper = self._ends
        tolerance = self._tolerance
        return jnp.clip(jnp.min(places), lower + tolerance, upper - tolerance)
