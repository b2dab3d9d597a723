"""A step of a run with events, whole or truncated at the first event."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..._compile import TraceCache
from ..._custom_types import BoolScalar, FloatScalar
from ..._method import AbstractMethod
from ..._numerics import (
    AbstractImplicitFunction,
    has_tangent,
    nan_tangent_unless,
    zero_unless,
)
from ..._results import RESULTS
from ..._step import ImplicitStep, StepArguments, StepOutcome, tangent_of_outcome
from ..._system import State
from ._event import Conditions, ConditionSigns, with_continuous_multiplier


class TruncatedStep(NamedTuple):
    """A step to a node or to an event.

    - `outcome`: the outcome of the step.
    - `h`: the size of the step.
    - `fired`: the index of the event that truncates the step, -1 for no event.
    - `values`: the values of the conditions at the step's end.
    - `crossed`: the conditions that crossed zero in the step.
    """

    outcome: StepOutcome
    h: FloatScalar
    fired: Int[Array, ""]
    values: Float[Array, " e"]
    crossed: Bool[Array, " e"]


class _Found(NamedTuple):
    """The size of a truncated step and its event, or why the search failed."""

    h: FloatScalar
    fired: Int[Array, ""]
    result: RESULTS


# The arguments of a step, and the conditions of its events.
Given: TypeAlias = tuple[StepArguments, Conditions]


class ImplicitTruncatedStep(AbstractImplicitFunction[Given, TruncatedStep]):
    """A step of size h, or of size θ h if it is truncated at the first event.

    The size θ h of a truncated step is a root of g(t + θ h, y(θ h)), where g is the
    condition of the event and y is the end of the step, so that

    d(θ h) = - (∂g/∂h)⁻¹ dg,

    where dg is the change of g at fixed step size. If g does not change with the step
    size, the derivative of θ h is NaN.

    - `step`: takes a step of any size.
    - `signs`: the signs of the conditions at the start of the step.
    - `truncates`: whether to truncate the step at the first event in it.
    - `values_at_end`: if the step is truncated, the values of the conditions at the end
        of the whole step.
    - `known_event`: the event at which a step of the given size is known to end, -1 for
        no event; None if the event must be searched for.
    """

    step: ImplicitStep
    signs: ConditionSigns
    truncates: BoolScalar
    values_at_end: Float[Array, " e"]
    known_event: Int[Array, ""] | None

    @property
    def programs(self) -> TraceCache | None:
        """Return the step's cache of traced programs."""
        return self.step.programs

    def solve(self, arguments: Given) -> TruncatedStep:
        """Find the size of the step, and take it."""
        h, none = arguments[0].h, -jnp.ones((), jnp.int32)
        found = _Found(h, none, RESULTS.successful)
        if self.known_event is not None:
            found = found._replace(fired=self.known_event)
        else:
            found = jax.lax.cond(
                self.truncates, lambda: self._first(arguments), lambda: found
            )
        step = self._trial(arguments, found.h)
        result = RESULTS.where(
            found.result == RESULTS.successful, step.outcome.result, found.result
        )
        return step._replace(
            outcome=step.outcome._replace(result=result), fired=found.fired
        )

    def _first(self, given: Given) -> _Found:
        """Find the first event in a step, by smaller trial steps from its start."""
        arguments, conditions = given
        h, sign = arguments.h, self.signs.sign
        values_at_end = self._without_start_zero(self.values_at_end, h)
        one = jnp.ones((), h.dtype)
        whole = Bracket.open_from(self.signs.value)
        whole = whole.with_point(
            one, values_at_end, conditions.crossed(sign, values_at_end)
        )

        def narrower(search: tuple[Bracket, FloatScalar, RESULTS]):
            bracket, _, _ = search
            theta = bracket.next_place()
            step = self._trial(given, theta * h)
            values = self._without_start_zero(step.values, step.h)
            return (
                bracket.with_point(theta, values, step.crossed),
                theta,
                step.outcome.result,
            )

        bracket, last, result = jax.lax.while_loop(
            lambda search: (search[2] == RESULTS.successful) & ~search[0].found,
            narrower,
            (whole, one, RESULTS.successful),
        )
        theta = jnp.where(result == RESULTS.successful, bracket.upper, last)
        return _Found(theta * h, jnp.argmax(bracket.crossed).astype(jnp.int32), result)

    def _trial(self, given: Given, h: FloatScalar) -> TruncatedStep:
        """Take a step of any size, and compute the conditions at its end."""
        arguments, conditions = given
        at = eqx.tree_at(lambda x: x.h, arguments, h)
        outcome = self.step(at)
        values = _values(at, conditions, self.step.method, outcome.step_state.state)
        solved = outcome.result == RESULTS.successful
        unknown = solved & ~jnp.all(jnp.isfinite(values))
        result = RESULTS.where(unknown, RESULTS.nonfinite_event, outcome.result)
        crossed = conditions.crossed(
            self.signs.sign, self._without_start_zero(values, h)
        )
        none = -jnp.ones((), jnp.int32)
        outcome = outcome._replace(result=result)
        return TruncatedStep(outcome, h, none, values, crossed)

    def _without_start_zero(
        self, values: Float[Array, " e"], h: FloatScalar
    ) -> Float[Array, " e"]:
        """Divide the conditions that are zero at the start by the size of the step.

        This removes the zero at the start and keeps all other zeros.
        """
        return jnp.where(self.signs.at_zero, values / jnp.abs(h), values)

    def tangent(
        self, arguments: Given, rates: Given, solution: TruncatedStep
    ) -> TruncatedStep:
        """Compute the tangents of the end of the step and of its size."""
        (given, conditions), (of_given, of_conditions) = arguments, rates
        is_truncated = solution.fired >= 0
        # The size of a truncated step is a result, not an argument.
        given = eqx.tree_at(lambda x: x.h, given, solution.h)
        rate = of_given.h
        if rate is None:
            rate = jnp.zeros_like(solution.h)
        else:
            rate = jnp.where(is_truncated, 0, rate)
        of_given = eqx.tree_at(
            lambda x: x.h, of_given, rate, is_leaf=lambda leaf: leaf is None
        )
        perturbed, fixed = eqx.partition(given, has_tangent(of_given))
        functions, others = eqx.partition(conditions, has_tangent(of_conditions))
        changes = self._changes(given, others, solution, fixed)
        # With `jax.checkpoint`, reverse mode stores only states and stages.
        change, dh = jax.checkpoint(changes, prevent_cse=False)(
            perturbed,
            functions,
            solution.outcome.stages,
            solution.outcome.step_state.state,
            (of_given, of_conditions),
        )
        none = jax.tree.map(lambda _: None, solution)
        tangent = tangent_of_outcome(solution.outcome, change)
        return none._replace(outcome=tangent, h=dh)

    def _changes(
        self,
        arguments: StepArguments,
        others: Conditions,
        step: TruncatedStep,
        fixed: StepArguments,
    ) -> Callable[..., Any]:
        """Return the function that computes the tangents of a step and of its size.

        `others` and `fixed` are the parts of the conditions and of the arguments that
        have no tangents.
        """
        ok = ~self.step.skip & (step.outcome.result == RESULTS.successful)
        is_truncated = ok & (step.fired >= 0)
        is_size = eqx.tree_at(
            lambda x: x.h, jax.tree.map(lambda _: False, arguments), True
        )
        size, rest = eqx.partition(arguments, is_size)
        unit = eqx.tree_at(lambda x: x.h, size, jnp.ones_like(step.h))

        def condition(given, fixed, functions, y):
            at, all_of_them = eqx.combine(given, fixed), eqx.combine(functions, others)
            return _values(at, all_of_them, self.step.method, y)[step.fired]

        def changes(given, functions, x, y, rates):
            frozen = self.step.frozen_iteration(arguments, x)
            change = self.step.changes(frozen, given, fixed, x, rates[0], ok)
            by_size = jax.lax.cond(
                is_truncated,
                lambda: self.step.changes(frozen, size, rest, x, unit, is_truncated),
                lambda: jax.tree.map(jnp.zeros_like, change),
            )
            _, slope = jax.jvp(
                lambda size, y: condition(size, rest, functions, y),
                (size, y),
                (unit, by_size[1]),
            )
            # Without an event, set tangents to zero: a condition may lack a derivative.
            _, gained = jax.jvp(
                lambda given, functions, y: condition(given, fixed, functions, y),
                (given, functions, y),
                zero_unless(is_truncated, (*rates, change[1])),
            )
            resolved = ~is_truncated | (
                jnp.abs(slope * step.h) > _flat(self.signs, step)
            )
            dh = -zero_unless(is_truncated, gained) / jnp.where(
                is_truncated & resolved, slope, 1
            )
            moved: Any = sum(jnp.sum(x) for x in jax.tree.leaves(rates))
            dh = nan_tangent_unless(resolved, jnp.where(resolved, dh, moved))
            total = jax.tree.map(lambda a, b: a + dh * b, change, by_size)
            return total, rates[0].h + dh

        return changes


def _values(
    arguments: StepArguments, conditions: Conditions, method: AbstractMethod, y: State
) -> Float[Array, " e"]:
    """Compute all conditions at the end y of a step."""
    system, args, t = arguments.system, arguments.args, arguments.t + arguments.h
    y = with_continuous_multiplier(system, method, t, y, args)
    return conditions(t, y, args)


def _flat(signs: ConditionSigns, step: TruncatedStep) -> FloatScalar:
    """Compute the bound below which a condition's change in a step counts as zero."""
    start = signs.scale(step.h)[step.fired]
    small = float(jnp.finfo(start.dtype).eps) ** 0.5
    return small * start


class Bracket(eqx.Module):
    """An interval in which the first of several functions of θ crosses zero.

    θ in [0, 1] is the fraction of a step. At the lower end no function has crossed
    zero, and at the upper end the `crossed` functions have crossed zero. The next point
    follows Chandrupatla (1997): inverse quadratic interpolation if the last three
    points allow it, and otherwise bisection. This method needs about as many
    evaluations as Newton's method, and at most about three times as many evaluations as
    bisection.

    - `new`, `other`, `old`: the newest point, which is one end of the interval; the
        other end; and the end that the newest point replaced. Each point is a pair of θ
        and the values of all functions there.
    - `is_upper`: whether the newest point is the upper end.
    - `crossed`: the functions that have crossed zero at the upper end.
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
        none = jnp.zeros(values.shape, bool)
        return cls(start, start, start, jnp.asarray(False), none)

    def with_point(
        self, theta: FloatScalar, values: Float[Array, " e"], crossed: Bool[Array, " e"]
    ) -> "Bracket":
        """Shorten the interval at θ; `crossed` marks functions that crossed zero."""
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
        """Return whether the upper end is the zero, up to round-off."""
        lower, upper = self._ends
        values = jnp.where(self.is_upper, self.new[1], self.other[1])
        exact = jnp.all(~self.crossed | (values == 0))
        return exact | (upper - lower <= 2 * self._tolerance)

    @property
    def _tolerance(self) -> float:
        return 2 * float(jnp.finfo(self.new[0].dtype).eps)

    def next_place(self) -> FloatScalar:
        """Estimate where the first of the crossed functions vanishes."""
        (a, fa), (b, fb), (c, fc) = self.new, self.other, self.old
        linear = fa / (fa - fb)
        xi, phi = (a - b) / (c - b), (fa - fb) / (fc - fb)
        may_be_quadratic = (phi**2 < xi) & ((1 - phi) ** 2 < 1 - xi)
        quadratic = fa / (fb - fa) * fc / (fb - fc)
        quadratic = quadratic + (c - a) / (b - a) * fa / (fc - fa) * fb / (fc - fb)
        # At first there are only two points, and the interpolation is linear.
        part = jnp.where(c == b, linear, jnp.where(may_be_quadratic, quadratic, 0.5))
        part = jnp.where((part >= 0) & (part <= 1), part, 0.5)
        places = jnp.where(self.crossed, a + part * (b - a), jnp.inf)
        lower, upper = self._ends
        tolerance = self._tolerance
        return jnp.clip(jnp.min(places), lower + tolerance, upper - tolerance)
