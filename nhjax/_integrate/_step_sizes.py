"""The controllers of step sizes, the option `stepsize_controller` of `integrate`."""

import math
from abc import abstractmethod
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from .._custom_types import (
    Args,
    BoolScalar,
    FloatScalar,
    FloatScalarLike,
    PhaseFunction,
)
from .._errors import Check, DTypeError, is_traced, naming, ShapeError
from .._manifold import AbstractLieGroup
from .._method import AbstractMethod
from .._numerics import ClosureConverted, inverse, max_norm, small_einsum
from .._results import RESULTS
from .._step import local_error, StepOutcome, StepState
from .._system import (
    AbstractMechanicalSystem,
    check_signature,
    linearise,
    no_array,
    State,
)


# The data that a controller carries from step to step.
Memory: TypeAlias = PyTree[Array]


class StepContext(NamedTuple):
    """The data that all steps of a run share.

    - `direction`: 1.0 for a run forward in time, -1.0 for a run backward in time.
    - `dt`: the step size that the user gave, or None.
    - `length`: the time from the start to the end of the run; infinite if it is not
        known.
    """

    system: AbstractMechanicalSystem
    method: AbstractMethod
    args: Args
    direction: FloatScalar
    dt: FloatScalar | None
    length: FloatScalar


class Attempt(NamedTuple):
    """A step that was tried: from the time t, of size h, with its outcome.

    - `chosen`: the size that the controller chose. The size h may differ from it in
        the last step of a run, and in the parts of a step before and after an event.
    - `is_solved`: whether the equations of the step were solved.
    - `is_whole`: whether the step ends where a step of the size `chosen` would end.
        Otherwise it ends earlier, at the end of the run.
    - `node`: the number of steps before this step.
    """

    t: FloatScalar
    h: FloatScalar
    chosen: FloatScalar
    start: StepState
    outcome: StepOutcome
    is_solved: BoolScalar
    is_whole: BoolScalar
    node: Int[Array, ""]


class Decision(NamedTuple):
    """The decision of a controller about a step.

    - `is_accepted`: whether the step is accepted. An unsolved step is never accepted.
    - `result`: `RESULTS.successful`, or the reason why the run fails.
    - `size`: the size of the next step, or of the next attempt at the same step.
    - `memory`: the data of the controller after an accepted step.
    - `error`: the estimated error of the step in units of the tolerance; None for a
        controller without a tolerance.
    """

    is_accepted: BoolScalar
    result: RESULTS
    size: FloatScalar
    memory: Memory
    error: FloatScalar | None = None


class AbstractStepSizeController(eqx.Module):
    """The way in which a run chooses its step sizes: option `stepsize_controller`."""

    @property
    def estimates_errors(self) -> bool:
        """Return whether the decisions of the controller have an estimated `error`."""
        return False

    def checks(self) -> list[Check]:
        """Return the checks of the controller's traced parameters."""
        return []

    @abstractmethod
    def init(
        self, context: StepContext, t: FloatScalar, start: StepState
    ) -> tuple[FloatScalar, Memory, RESULTS]:
        """Return the size of the first step, the initial memory, and a result.

        The result is `RESULTS.successful`, or the reason why the run fails.
        """

    @abstractmethod
    def adapt(self, context: StepContext, attempt: Attempt, memory: Memory) -> Decision:
        """Accept or reject a step, and choose the size of the next one."""

    def resume(
        self, context: StepContext, size: FloatScalar, memory: Memory
    ) -> tuple[FloatScalar, Memory]:
        """Return the size and the memory with which a run continues from a checkpoint.

        `size` and `memory` are the values in the checkpoint.
        """
        return jnp.abs(size) * context.direction, memory

    def after_reset(
        self, context: StepContext, t: FloatScalar, after: StepState
    ) -> tuple[FloatScalar, Memory, RESULTS] | None:
        """Return new values as `init` does, after an event has reset the state.

        None, the default, means that the size and the memory stay the same.
        """
        del context, t, after
        return None

    def given_size(
        self, context: StepContext, node: Int[Array, ""]
    ) -> FloatScalar | None:
        """Return the size of a step if the user gave it; otherwise None."""
        del context, node
        return None

    def check(
        self,
        system: AbstractMechanicalSystem,
        method: AbstractMethod,
        t: FloatScalar,
        y: State,
        args: Args,
    ) -> None:
        """Raise if the controller cannot be used for a run."""
        del system, method, t, y, args

    def closure_converted(
        self, system: AbstractMechanicalSystem, t: FloatScalar, y: State, args: Args
    ) -> "AbstractStepSizeController":
        """Return the controller; arrays that its functions close over become leaves."""
        del system, t, y, args
        return self


def _decided(attempt: Attempt, size: FloatScalar, memory: Memory) -> Decision:
    """Accept a solved step; the run fails if the step is not solved."""
    result = RESULTS.where(
        attempt.is_solved, RESULTS.successful, attempt.outcome.result
    )
    return Decision(attempt.is_solved, result, size, memory)


class ConstantStepSize(AbstractStepSizeController):
    """Steps of the size `dt`, the default of `nhjax.integrate`.

    With `t1` in place of `num_steps`, the last step is shortened if it would pass `t1`.

    !!! example

        >>> import nhjax
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> sol = nhjax.integrate(disc.system, nhjax.LobattoIIIAB(3),
        ...     disc.initial_state(), dt=0.3, t1=1.0)
        >>> float(sol.t1), int(sol.stats["num_steps"])
        (1.0, 4)
    """

    def init(
        self, context: StepContext, t: FloatScalar, start: StepState
    ) -> tuple[FloatScalar, Memory, RESULTS]:
        """Return |dt|, with a minus sign for a run backward in time."""
        del t, start
        return _size_of_user(context), (), RESULTS.successful

    def adapt(self, context: StepContext, attempt: Attempt, memory: Memory) -> Decision:
        """Accept every step that is solved."""
        return _decided(attempt, _size_of_user(context), memory)

    def resume(
        self, context: StepContext, size: FloatScalar, memory: Memory
    ) -> tuple[FloatScalar, Memory]:
        """Return `dt`, which may differ from the `dt` of the earlier run."""
        del size
        return _size_of_user(context), memory

    def given_size(self, context: StepContext, node: Int[Array, ""]) -> FloatScalar:
        """Return |dt|, with a minus sign for a run backward in time."""
        del node
        return _size_of_user(context)


def _size_of_user(context: StepContext) -> FloatScalar:
    assert context.dt is not None
    return jnp.abs(context.dt) * context.direction


class GivenStepSizes(AbstractStepSizeController):
    """Steps of the sizes in an array `dt` of `nhjax.integrate`."""

    sizes: Float[Array, " num_steps"]

    def init(
        self, context: StepContext, t: FloatScalar, start: StepState
    ) -> tuple[FloatScalar, Memory, RESULTS]:
        """Return the first size."""
        del context, t, start
        return self.sizes[0], (), RESULTS.successful

    def adapt(self, context: StepContext, attempt: Attempt, memory: Memory) -> Decision:
        """Accept every step that is solved."""
        del context
        following = jnp.minimum(attempt.node + 1, self.sizes.shape[0] - 1)
        return _decided(attempt, self.sizes[following], memory)

    def resume(
        self, context: StepContext, size: FloatScalar, memory: Memory
    ) -> tuple[FloatScalar, Memory]:
        """Return the first size: a resumed run has its own array of sizes."""
        del context, size
        return self.sizes[0], memory

    def given_size(self, context: StepContext, node: Int[Array, ""]) -> FloatScalar:
        """Return the size of the step with the index `node`."""
        del context
        return self.sizes[jnp.minimum(node, self.sizes.shape[0] - 1)]


class PIDController(AbstractStepSizeController):
    r"""Steps whose estimated error is at most a tolerance.

    The error of a step is estimated from the forces at its stages; see
    `docs/step_sizes.md`. The error of each component of the state y is divided by
    atol + rtol |y|, and e_n is the root mean square of these quotients. A step is
    accepted if e_n <= 1. Otherwise, or if the equations of the step are not solved, the
    step is repeated with a smaller size. The next size is

        h_{n+1} = h_n safety e_n^{-β1} e_{n-1}^{-β2} e_{n-2}^{-β3}

    within the limits of `factormin` and `factormax`. The exponents, with the order p of
    the method and k = p + 1, are

        β1 = (pcoeff + icoeff + dcoeff) / k,  β2 = -(pcoeff + 2 dcoeff) / k,
        β3 = dcoeff / k

    (Söderlind, Digital filters in adaptive time-stepping, 2003, and the controller of
    the same name in diffrax). If the errors grow from step to step, so that
    r_n = (h_n / h_{n-1}) (e_{n-1} / e_n)^(1/k) is below one, the next size is at most
    h_n safety e_n^{-1/k} r_n (Gustafsson, Control-theoretic techniques for stepsize
    selection in implicit Runge-Kutta methods, 1994). Use a method with three stages or
    more: with two stages, the estimated error of some steps is zero. Sizes that follow
    the error destroy the reversibility of a method, so that energies may drift; see
    `nhjax.ReversibleController`.

    **Arguments:**

    - `rtol`, `atol`: the relative and the absolute tolerance. For a position on a
        group, |y| is the largest absolute value among the numbers of the element.
    - `pcoeff`, `icoeff`, `dcoeff`: the coefficients of the controller. With the default
        coefficients, the next size depends on e_n and r_n only.
    - `dtmin`, `dtmax`: the smallest and the largest size of a step, in units of time,
        both positive. A run that needs steps smaller than `dtmin` fails. The last
        step of a run and steps to events may be smaller.
    - `factormin`, `factormax`: the limits of the ratio h_{n+1} / h_n.
    - `safety`: a factor below 1, which makes rejections rare. For the same error at the
        end, smooth motions need about 4 percent fewer attempts with the default than
        with 0.9, the default of diffrax.

    **Raises:** `ValueError` if a number is outside of its range.

    !!! example

        >>> import nhjax
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> sol = nhjax.integrate(disc.system, nhjax.LobattoIIIAB(3),
        ...     disc.initial_state(), t1=10.0,
        ...     stepsize_controller=nhjax.PIDController(rtol=1e-6, atol=1e-6))
        >>> float(sol.t1)
        10.0
    """

    rtol: FloatScalarLike
    atol: FloatScalarLike
    pcoeff: FloatScalarLike = 0.0
    icoeff: FloatScalarLike = 1.0
    dcoeff: FloatScalarLike = 0.0
    dtmin: FloatScalarLike | None = None
    dtmax: FloatScalarLike | None = None
    factormin: FloatScalarLike = 0.2
    factormax: FloatScalarLike = 10.0
    safety: FloatScalarLike = 0.85

    def __check_init__(self):
        ranges = {
            "rtol": (0, np.inf),
            "atol": (0, np.inf),
            "dtmin": (0, np.inf),
            "dtmax": (0, np.inf),
            "factormin": (0, 1),
            "factormax": (1, np.inf),
            "safety": (0, 1),
            "pcoeff": (-np.inf, np.inf),
            "icoeff": (-np.inf, np.inf),
            "dcoeff": (-np.inf, np.inf),
        }
        for name, (least, most) in ranges.items():
            value = getattr(self, name)
            if value is None or is_traced(value):
                continue
            if not _is_number(value):
                raise TypeError(
                    f"PIDController: `{name}` must be a real number, got {value!r}."
                )
            number = float(value)
            may_be_zero = name == "atol"
            is_above = number >= least if may_be_zero else number > least
            if not (np.isfinite(number) and is_above and number <= most):
                least = f"{'>=' if may_be_zero else '>'} {least}"
                limit = "" if np.isinf(most) else f" and <= {most}"
                advice = ""
                if name == "rtol" and number == 0:
                    advice = " Round-off is relative, so that rtol = 0 cannot be met."
                raise ValueError(
                    f"PIDController: `{name}` must be finite, {least}{limit}, "
                    f"got {number}.{advice}"
                )
        least, most = self.dtmin, self.dtmax
        if least is None or most is None or is_traced(least, most):
            return
        if not least <= most:
            raise ValueError(
                f"PIDController: `dtmin` = {least} is larger than `dtmax` = {most}."
            )

    @property
    def estimates_errors(self) -> bool:
        """Return True: this controller estimates the error of every step."""
        return True

    def checks(self) -> list[Check]:
        """Return the checks of traced tolerances."""
        if not is_traced(self.rtol, self.atol):
            return []
        rtol, atol = jnp.asarray(self.rtol), jnp.asarray(self.atol)
        checks = [
            Check((rtol > 0) & jnp.isfinite(rtol), _bad_rtol, (rtol,)),
            Check((atol >= 0) & jnp.isfinite(atol), _bad_atol, (atol,)),
        ]
        return [check for check in checks if is_traced(*check.values)]

    def check(
        self,
        system: AbstractMechanicalSystem,
        method: AbstractMethod,
        t: FloatScalar,
        y: State,
        args: Args,
    ) -> None:
        """Raise if the error cannot be estimated from the stages of the method."""
        del system, t, y, args
        if len(np.unique(method.c)) < 2:
            raise ValueError(
                "PIDController: the error of a step is estimated from two nodes or "
                "more, but the method has one. Use a method with more stages, or "
                "`nhjax.ReversibleController`."
            )

    def init(
        self, context: StepContext, t: FloatScalar, start: StepState
    ) -> tuple[FloatScalar, Memory, RESULTS]:
        """Return `dt` or, if None, a size that changes the state by one percent."""
        # Before the first step there are no earlier errors, sizes and growth rates. The
        # logarithms of the errors start as zero. The size starts as zero, so that no
        # trend is predicted. The growth rates, explained in `local_error`, start as
        # infinite, which means unknown.
        zero = jnp.zeros((), t.dtype)
        memory = zero, zero, zero, jnp.full(2, jnp.inf, t.dtype)
        if context.dt is not None:
            size = jnp.abs(context.dt)
        else:
            size = self._first_size(context, t, start)
        size = jax.lax.stop_gradient(self._limited(size))
        return size * context.direction, memory, RESULTS.successful

    def _first_size(
        self, context: StepContext, t: FloatScalar, start: StepState
    ) -> FloatScalar:
        # Hairer, Nørsett and Wanner, Solving ordinary differential equations I, II.4.
        system, args = context.system, context.args
        u = system.fibre_coordinate(start.state)
        v = system.velocity(t, start.state.q, u, args)
        in_position, in_fibre = self._scales(context, start, start)
        manifold = system.manifold_of(start.state.q)
        position = position_sizes(manifold, start.state.q, v)
        state = max_norm(position / in_position, u / in_fibre)
        rates = v / in_position, start.lin.acceleration / in_fibre
        # Without an absolute tolerance, components that are zero have no scale, and
        # their rates are ignored.
        least = 2 * _smallest_scale(u)
        known = (
            jnp.where(scale > least, rate, 0)
            for scale, rate in zip((in_position, in_fibre), rates, strict=True)
        )
        rate = max_norm(*known)
        size = 0.01 * state / rate
        is_known = (state > 1e-5) & (rate > 1e-5) & jnp.isfinite(size)
        small = jnp.where(jnp.isfinite(context.length), context.length, 1) * 1e-6
        size = jnp.where(is_known, size, small)
        return jnp.minimum(size, context.length)

    def _limited(self, size: FloatScalar) -> FloatScalar:
        """Return a size (without sign) within `dtmin` and `dtmax`."""
        if self.dtmax is not None:
            size = jnp.minimum(size, jnp.asarray(self.dtmax, size.dtype))
        if self.dtmin is not None:
            size = jnp.maximum(size, jnp.asarray(self.dtmin, size.dtype))
        return size

    def _scales(
        self, context: StepContext, before: StepState, after: StepState
    ) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """Return atol + rtol |y| for the positions and for the fibre coordinates.

        |y| is the larger of the values before and after the step.
        """
        system, dtype = context.system, before.state.p.dtype
        rtol, atol = (jnp.asarray(x, dtype) for x in (self.rtol, self.atol))
        # A relative tolerance alone would allow no error where the state is zero.
        atol = atol + _smallest_scale(atol)
        manifold = system.manifold_of(before.state.q)

        def sizes(x: StepState) -> tuple[Array, Array]:
            u = system.fibre_coordinate(x.state)
            return position_sizes(manifold, x.state.q, u), jnp.abs(u)

        both = zip(sizes(before), sizes(after), strict=True)
        position, fibre = (jnp.maximum(one, other) for one, other in both)
        return atol + rtol * position, atol + rtol * fibre

    def adapt(self, context: StepContext, attempt: Attempt, memory: Memory) -> Decision:
        """Accept a step if its estimated error is at most one tolerance."""
        start, outcome, h = attempt.start, attempt.outcome, attempt.h
        scales = self._scales(context, start, outcome.step_state)
        last, before_last, last_size, growth_rates = memory
        error, found = local_error(
            *(context.system, context.method, attempt.t, h),
            *(start, outcome, scales, context.args, growth_rates),
        )
        error, found, size = jax.lax.stop_gradient((error, found, jnp.abs(h)))
        # The growth rate of a single step may be small by chance. Therefore the stored
        # growth rate never falls by more than a factor of 2 from step to step.
        is_first = jnp.isinf(growth_rates)
        growth_rates = jnp.where(
            is_first, found, jnp.maximum(found, 0.5 * growth_rates)
        )
        is_known = attempt.is_solved & jnp.isfinite(error)
        accepted = is_known & (error <= 1)
        dtype = error.dtype
        number = context.method.order + 1
        p, i, d = (
            jnp.asarray(x, dtype) for x in (self.pcoeff, self.icoeff, self.dcoeff)
        )
        least, most, safety = (
            jnp.asarray(x, dtype) for x in (self.factormin, self.factormax, self.safety)
        )
        estimate = jnp.where(is_known, error, jnp.inf)
        # Sums of logarithms take less time than products of powers. A logarithm of the
        # error below `bound` is replaced by `bound`, which already gives the largest
        # factor.
        bound = number * jnp.log(safety / most)
        error = jnp.log(jnp.maximum(error, float(jnp.finfo(dtype).tiny)))
        error = jnp.maximum(error, bound)
        powers = (p + i + d) * error - (p + 2 * d) * last + d * before_last
        factor = -powers / number
        # If errors grow, the next size is reduced in advance. Without this reduction, a
        # quarter of the steps of an orbit with close passes were rejected. An earlier
        # error below 0.01 counts as 0.01, because it may be small by chance.
        growth = jnp.maximum(last, math.log(0.01)) - error
        change = jnp.log(size / jnp.where(last_size > 0, last_size, size))
        trend = change + growth / number
        is_trend = accepted & (error > bound) & (trend < 0)
        predicted = trend - error / number
        factor = jnp.where(is_trend, jnp.minimum(factor, predicted), factor)
        factor = safety * jnp.exp(factor)
        factor = jnp.clip(factor, least, jnp.where(accepted, most, safety))
        factor = jnp.where(is_known, factor, least)
        following = self._limited(size * factor)
        # If a step was shorter than the chosen size, its error says little about the
        # next step, which must not become smaller than the chosen size.
        chosen = jax.lax.stop_gradient(jnp.abs(attempt.chosen))
        is_shorter = size < (1 - 1e-9) * chosen
        kept = jnp.maximum(following, chosen)
        following = jnp.where(accepted & is_shorter, kept, following)
        smallest = 16 * float(jnp.finfo(dtype).eps) * jnp.abs(attempt.t)
        if self.dtmin is not None:
            smallest = jnp.maximum(smallest, jnp.asarray(self.dtmin, dtype))
        smallest = jnp.maximum(smallest, float(jnp.finfo(dtype).tiny))
        result = RESULTS.where(
            accepted | (size > smallest), RESULTS.successful, RESULTS.dt_min_reached
        )
        # If the smallest step is not solved, the run fails for the reason that the
        # solver gives.
        result = RESULTS.where(
            (result == RESULTS.successful) | attempt.is_solved,
            result,
            outcome.result,
        )
        memory = error, last, size, growth_rates
        size = jax.lax.stop_gradient(following) * context.direction
        return Decision(accepted, result, size, memory, estimate)

    def resume(
        self, context: StepContext, size: FloatScalar, memory: Memory
    ) -> tuple[FloatScalar, Memory]:
        """Return `dt` if the user gives it, otherwise the size in the checkpoint."""
        if context.dt is not None:
            # Earlier errors and sizes say nothing about a size that the user gives.
            *_, growth_rates = memory
            zero = jnp.zeros((), size.dtype)
            memory = zero, zero, zero, growth_rates
            size = context.dt
        size = jnp.abs(size)
        size = jax.lax.stop_gradient(self._limited(size))
        return size * context.direction, memory


class ReversibleController(AbstractStepSizeController):
    r"""Steps whose sizes follow a density, such that the run can be retraced.

    The step density ρ is ε times the number of steps per unit of time. With a positive
    function Q(y) of the state, the argument `density`, the sizes are

        ρ_{n+1/2} = ρ_{n-1/2} + ε G(y_n),  h_{n+1/2} = ε / ρ_{n+1/2},

    where G = d/dt log Q along the motion and ρ_0 = Q(y_0) (Hairer and Söderlind,
    Explicit, time reversible, adaptive step size control, 2005). The density follows Q
    up to O(ε²). A run backward in time from a checkpoint retraces the steps of the run
    that saved it. In a reversible system with a symmetric method, energies that do not
    drift with constant steps do not drift with these steps either. No step is rejected.
    After an event has reset the state, the density starts again from Q of the new
    state.

    **Arguments:**

    - `eps`: ε > 0, the size of a step times the density. Its unit is the unit of Q
        times the unit of time.
    - `density`: Q(t, q, v, args) > 0, for Hamiltonian systems a function of (t, q, p,
        args). Q should not change if velocities change their signs. The default is an
        estimate of the fastest angular frequency of the motion, from the derivatives of
        the accelerations with respect to positions and velocities. With the default,
        `eps` is about the phase angle by which the fastest oscillation advances in one
        step.

    **Raises:** `ValueError` if `eps` is not positive. `integrate` raises a `ShapeError`
    if the density does not have the shape (), and an `IntegrationError` if it is not
    positive.

    !!! example

        >>> import nhjax
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> density = lambda t, q, v, args: 1.0 + q[0] ** 2
        >>> sol = nhjax.integrate(disc.system, nhjax.LobattoIIIAB(3),
        ...     disc.initial_state(), t1=1.0,
        ...     stepsize_controller=nhjax.ReversibleController(0.1, density))
        >>> float(sol.t1)
        1.0
    """

    eps: FloatScalarLike
    density: PhaseFunction | None = None

    def __check_init__(self):
        if self.density is not None and not callable(self.density):
            raise TypeError(
                "ReversibleController: `density` must be a function of (t, q, v, args) "
                f"or None, got {self.density!r}."
            )
        if is_traced(self.eps):
            return
        if not _is_number(self.eps):
            raise TypeError(
                f"ReversibleController: `eps` must be a real number, got {self.eps!r}."
            )
        if not (np.isfinite(self.eps) and self.eps > 0):
            raise ValueError(
                "ReversibleController: `eps` must be finite and > 0, got "
                f"{float(self.eps)}. For a run backward in time pass `t1` < `t0`."
            )

    def checks(self) -> list[Check]:
        """Return the check of ε if it is traced, otherwise an empty list."""
        if not is_traced(self.eps):
            return []
        eps = jnp.asarray(self.eps)
        return [Check((eps > 0) & jnp.isfinite(eps), _bad_eps, (eps,))]

    def closure_converted(
        self, system: AbstractMechanicalSystem, t: FloatScalar, y: State, args: Args
    ) -> "ReversibleController":
        """Return the controller; arrays that the density closes over become leaves."""
        if self.density is None:
            return self
        given = t, y.q, system.fibre_coordinate(y), args
        return ReversibleController(self.eps, ClosureConverted(self.density, *given))

    def check(
        self,
        system: AbstractMechanicalSystem,
        method: AbstractMethod,
        t: FloatScalar,
        y: State,
        args: Args,
    ) -> None:
        """Raise unless the density is a function that returns one number."""
        del method
        if self.density is None:
            return
        q, u = y.q, system.fibre_coordinate(y)
        coordinate = system.fibre_coordinate_name
        names = ("t", "q", coordinate, "args")
        check_signature("ReversibleController", "density", self.density, names)
        called = f"density(t, q, {coordinate}, args)"
        with naming(called, self.density, args):
            out = eqx.filter_eval_shape(self.density, t, q, u, args)
        shape = getattr(out, "shape", None)
        if shape != ():
            raise ShapeError(
                f"ReversibleController: `{called}` must return a number of shape (), "
                f"got {no_array(out) if shape is None else f'shape {shape}.'}"
            )
        if out.dtype != u.dtype:
            raise DTypeError(
                f"ReversibleController: `{called}` returns dtype {out.dtype}, but the "
                f"state has {u.dtype}."
            )

    def _density(
        self, context: StepContext, t: FloatScalar, y: StepState
    ) -> tuple[FloatScalar, FloatScalar]:
        """Compute Q and G = d/dt log Q along the motion."""
        system, args = context.system, context.args
        q, u = y.state.q, system.fibre_coordinate(y.state)
        manifold = system.manifold_of(q)

        def along(t: FloatScalar, xi: Array, u: Array) -> FloatScalar:
            moved = manifold.act(q, xi)
            if self.density is None:
                return fastest_frequency(system, t, moved, u, args)
            return self.density(t, moved, u, args)

        v = system.velocity(t, q, u, args)
        given = t, jnp.zeros_like(u), u
        rates = jnp.ones_like(t), v, y.lin.acceleration
        value, rate = jax.jvp(along, given, rates)
        return jax.lax.stop_gradient((value, rate / value))

    def _size(
        self, context: StepContext, density: FloatScalar, rate: FloatScalar
    ) -> FloatScalar:
        """Compute the size of a step from ρ and G at its start."""
        eps = jnp.asarray(self.eps, density.dtype) * context.direction
        return eps / (density + 0.5 * eps * rate)

    def init(
        self, context: StepContext, t: FloatScalar, start: StepState
    ) -> tuple[FloatScalar, Memory, RESULTS]:
        """Return the first size, for a density that is equal to Q of the state."""
        density, rate = self._density(context, t, start)
        size = self._size(context, density, rate)
        result = RESULTS.where(
            _is_usable(density, size, context),
            RESULTS.successful,
            RESULTS.density_not_positive,
        )
        size = jnp.where(result == RESULTS.successful, size, context.direction)
        # The memory is a single array, unlike the four arrays of a `PIDController`.
        # Checkpoints of the two controllers can therefore be told apart.
        return size, jnp.stack([density, rate]), result

    def after_reset(
        self, context: StepContext, t: FloatScalar, after: StepState
    ) -> tuple[FloatScalar, Memory, RESULTS]:
        """Start again, because the density before the reset has no meaning after it."""
        return self.init(context, t, after)

    def adapt(self, context: StepContext, attempt: Attempt, memory: Memory) -> Decision:
        """Accept every step that is solved, and compute the density after it."""
        density, rate = memory
        end = attempt.t + attempt.h
        _, following = self._density(context, end, attempt.outcome.step_state)
        eps = jnp.asarray(self.eps, density.dtype) * context.direction
        # A step that was shortened to the size h counts as a step with the smaller ε
        # that solves h = ε / (ρ + ε G / 2).
        h = jax.lax.stop_gradient(attempt.h)
        part = jnp.where(attempt.is_whole, eps, h * density / (1 - 0.5 * h * rate))
        moved = (density + 0.5 * part * rate) + 0.5 * part * following
        size = self._size(context, moved, following)
        decision = _decided(attempt, size, jnp.stack([moved, following]))
        is_bad = attempt.is_solved & ~_is_usable(moved, size, context)
        result = RESULTS.where(is_bad, RESULTS.density_not_positive, decision.result)
        return decision._replace(is_accepted=attempt.is_solved & ~is_bad, result=result)

    def resume(
        self, context: StepContext, size: FloatScalar, memory: Memory
    ) -> tuple[FloatScalar, Memory]:
        """Return the size of the next step, negative for a run backward in time."""
        del size
        density, rate = memory
        return self._size(context, density, rate), memory


def _smallest_scale(like: Array) -> float:
    """Return a tiny number of a dtype, which keeps absolute tolerances positive."""
    return float(jnp.finfo(like.dtype).tiny) ** 0.25


def _is_usable(
    density: FloatScalar, size: FloatScalar, context: StepContext
) -> BoolScalar:
    return (density > 0) & (size * context.direction > 0) & jnp.isfinite(size)


def _bad_rtol(x: np.ndarray) -> ValueError:
    return ValueError(f"PIDController: `rtol` must be finite and > 0, got {float(x)}.")


def _bad_atol(x: np.ndarray) -> ValueError:
    return ValueError(f"PIDController: `atol` must be finite and >= 0, got {float(x)}.")


def _bad_eps(x: np.ndarray) -> ValueError:
    return ValueError(
        f"ReversibleController: `eps` must be finite and > 0, got {float(x)}."
    )


def _is_number(x: Any) -> bool:
    is_scalar = eqx.is_array_like(x) and not isinstance(x, bool | complex)
    return is_scalar and np.shape(x) == ()


def position_sizes(
    manifold: AbstractLieGroup, q: PyTree[Array], like: Float[Array, " n"]
) -> Float[Array, " n"]:
    """Return the sizes of the n coordinates of a position, in the shape of `like`.

    On a flat group, such as a vector space, the size of coordinate i is |q_i|. On all
    other groups, each of the n sizes is the largest absolute value among the numbers of
    the element, because an element may have more than n numbers.
    """
    leaves = [jnp.ravel(jnp.abs(x)) for x in jax.tree.leaves(q)]
    flat = jnp.concatenate(leaves)
    if manifold.is_flat and flat.shape == like.shape:
        return flat
    return jnp.full_like(like, jnp.max(flat))


def fastest_frequency(
    system: AbstractMechanicalSystem,
    t: FloatScalar,
    q: PyTree[Array],
    u: Float[Array, " n"],
    args: Args,
) -> FloatScalar:
    """Estimate the fastest angular frequency of the motion near a state.

    With the acceleration a(q, u), which includes the reactions of the constraints, the
    estimate is (|∂a/∂q| + |∂a/∂u|²)^½. The norms are Frobenius norms in the metric of
    the kinetic energy, which do not depend on the units of coordinates.
    """
    manifold = system.manifold_of(q)

    def acceleration(xi: Array, u: Array) -> Array:
        return linearise(system, t, manifold.act(q, xi), u, args).acceleration

    by_position, by_fibre = jax.jacfwd(acceleration, argnums=(0, 1))(
        jnp.zeros_like(u), u
    )
    # For a Lagrangian system the metric is M. For a Hamiltonian system it is M⁻¹, and
    # the derivative of dp/dt with respect to q is a bilinear form, whose norm has M⁻¹
    # on both sides.
    metric = system.metric(t, q, u, args)
    inverse_metric = inverse(metric)
    other = inverse_metric if system.fibre_coordinate_name == "v" else metric

    def squared_norm(matrix: Array, other: Array) -> FloatScalar:
        weighted = small_einsum("ij,jk->ik", metric, matrix)
        return jnp.sum(small_einsum("ij,jk->ik", weighted, other) * matrix)

    # A square root has no derivative at zero.
    tiny = float(jnp.finfo(u.dtype).tiny) ** 0.5
    stiffness = jnp.sqrt(jnp.maximum(squared_norm(by_position, other), tiny))
    return jnp.sqrt(stiffness + squared_norm(by_fibre, inverse_metric))
