"""A report on a system: dimensions, conditioning, dependences and invariances."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._compile import as_cpu_kernel, tracked_jit
from .._custom_types import Args, FloatScalarLike
from .._errors import is_traced, require
from .._initial import checked_inputs
from .._numerics import (
    dependent_rows,
    inverse,
    is_deficient,
    max_norm,
    rank_of_gram,
    reciprocal_condition,
    reciprocal_condition_of_range,
)
from .._system import (
    AbstractMechanicalSystem,
    check_functions,
    finite,
    linearise,
    parameters,
    with_kept_functions,
)
from ._motion import convert_to_velocities


# A derivative counts as zero if it vanishes at `_NUM_SAMPLES` states, at random
# distances of the order of `_SPREAD` from the given state.
_NUM_SAMPLES = 3
_SPREAD = 0.3

_MASS, _JACOBIAN = "mass matrix", "Jacobian of the nonholonomic constraints"


class SystemReport(eqx.Module):
    """The report of `check_system`; its `str` is a table.

    - `dimension`: the number n of coordinates.
    - `num_nonholonomic`, `num_holonomic`: the numbers m and k of constraints.
    - `mass_condition`, `compatibility_condition`: the condition numbers of M = ∂p/∂v
        and of C = B M⁻¹ Bᵀ, after a scaling that removes the influence of units; B is
        the Jacobian of the constraints with respect to v. If one of these numbers is
        infinite, the accelerations at the state are not determined.
    - `violations`: the values of the constraint functions by name, "Φ[0]" for
        nonholonomic ones and "Γ[0]", "dΓ[0]/dt" for holonomic ones.
    - `dependent`: the names of constraints that depend on each other, if any.
    - `num_redundant`: the number of constraints that follow from others, for a system
        that declares its constraints redundant. The reactions of the constraints in
        `dependent` are then not unique.
    - `depends_on_time`: the names of the functions that depend on t.
    - `ignorable`: the indices of coordinates that no function depends on near the given
        state. A coordinate is missed if terms that contain it cancel only up to
        round-off.
    - `constant`: the names of constant matrices, among the mass matrix and the
        Jacobian of the nonholonomic constraints.
    """

    dimension: int
    num_nonholonomic: int
    num_holonomic: int
    mass_condition: float
    compatibility_condition: float
    violations: dict[str, float]
    dependent: tuple[str, ...]
    num_redundant: int
    depends_on_time: tuple[str, ...]
    ignorable: tuple[int, ...]
    constant: tuple[str, ...]

    @property
    def degrees_of_freedom(self) -> int:
        """Return the dimension n - m - k of the permitted velocities.

        Redundant constraints do not count.
        """
        count = self.num_nonholonomic + self.num_holonomic - self.num_redundant
        return self.dimension - count

    def _size(self, name: str) -> float:
        # NaN counts as the largest violation.
        size = abs(self.violations[name])
        return size if size == size else float("inf")

    def __str__(self) -> str:
        worst = max(self.violations, key=self._size, default="")
        rows = {
            "coordinates n": self.dimension,
            "nonholonomic constraints m": self.num_nonholonomic,
            "holonomic constraints k": self.num_holonomic,
            "degrees of freedom n - m - k": self.degrees_of_freedom,
            "condition number of M": f"{self.mass_condition:.3g}",
            "condition number of C": f"{self.compatibility_condition:.3g}",
            "largest violation": f"{worst} = {self.violations[worst]:.3g}"
            if worst
            else "none",
            "dependent constraints": _comma_separated(self.dependent),
            "depend on time": _comma_separated(self.depends_on_time),
            "ignorable coordinates": _comma_separated(self.ignorable),
            "constant": _comma_separated(self.constant),
        }
        if self.num_redundant:
            rows["redundant constraints"] = self.num_redundant
            rows["reactions not unique"] = _comma_separated(self.dependent)
        return "\n".join(f"{name:30} {value}" for name, value in rows.items())


def _comma_separated(names: tuple[Any, ...]) -> str:
    return ", ".join(map(str, names)) or "none"


def check_system(
    system: AbstractMechanicalSystem,
    q: PyTree[Array],
    v: Float[Array, " n"] | None = None,
    p: Float[Array, " n"] | None = None,
    *,
    t: FloatScalarLike = 0.0,
    args: Args = None,
) -> SystemReport:
    """Report on a system at a configuration and a velocity or momentum.

    Use it for a new model: `print(nhjax.check_system(...))`. The state need not be
    consistent. If the accelerations are not determined, for instance because
    constraints are dependent, the report says so and no exception is raised.

    **Arguments:**

    - `system`: the mechanical system.
    - `q`: the configuration, as for `initial_state`.
    - `v`, `p`: the velocity of a Lagrangian system, or the momentum of a Hamiltonian
        system, shape (n,).
    - `t`, `args`: passed on to the functions of the system.

    **Returns:** a `SystemReport`. The arguments on which functions depend are found
    from derivatives at three states near the given state.

    **Raises:** the errors of `initial_state` if arguments or values returned by the
    system's functions have a wrong type or shape or are not finite; `ValueError` if a
    Lagrangian system is given `p`, or a Hamiltonian system is given `v`; `TypeError`
    under `jit`, `vmap` or `grad`.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> report = nhjax.check_system(disc.system, disc.q0, disc.v0)
        >>> report.degrees_of_freedom, report.ignorable, report.constant
        (2, (0, 1, 2), ('mass matrix',))
    """
    q, v, p, t = checked_inputs(system, q, v, p, t)
    coordinate = system.fibre_coordinate_name
    u = {"v": v, "p": p}[coordinate]
    if u is None:
        raise ValueError(
            f"Pass `{coordinate}`, the fibre coordinate of a {type(system).__name__}."
        )
    args = parameters(args)
    if is_traced(*jax.tree.leaves((q, u, t, args))):
        raise TypeError(
            "`check_system` needs concrete values: call it outside `jax.jit`, "
            "`jax.vmap` and `jax.grad`."
        )
    for name, x in (("q", q), (coordinate, u), ("t", t)):
        require(x, finite(name, x))
    check_functions(system, t, q, args)
    found = jax.tree.map(np.asarray, _measurements(system, t, q, u, args))
    for name, value in found["values"].items():
        require(value, finite(system.named(name).called, np.squeeze(value)))
    count, k = found["constraints"].size, found["position_constraints"].size
    m = count - k
    letters = [f"Φ[{i}]" for i in range(m)] + [f"Γ[{i}]" for i in range(k)]
    rates = letters[:m] + [f"d{name}/dt" for name in letters[m:]]
    values = [*found["constraints"], *found["position_constraints"]]
    changes = {key: _changes(found[key]) for key in (_MASS, _JACOBIAN)}
    # Only finite rows are reported as dependent. A row that is not finite makes the
    # condition number of C infinite.
    rows = dependent_rows(found["jacobian"]) if found["deficient"] else []
    moving = np.any(_changes(found["by_position"]), axis=0)
    return SystemReport(
        dimension=u.size,
        num_nonholonomic=m,
        num_holonomic=k,
        num_redundant=int(found["redundant"]),
        mass_condition=_condition(found["regularity"]),
        compatibility_condition=_condition(found["compatibility"]),
        violations=dict(zip(rates + letters[m:], map(float, values), strict=True)),
        dependent=tuple(letters[i] for i in rows),
        depends_on_time=tuple(
            name
            for name in system.functions(t, q, u, None, args)
            if np.any(_changes(found["by_time"][name]))
        ),
        ignorable=tuple(int(i) for i in np.flatnonzero(~moving)),
        constant=tuple(
            name
            for name, changed in changes.items()
            if not np.any(changed) and (name == _MASS or m > 0)
        ),
    )


def _changes(derivatives: np.ndarray) -> np.ndarray:
    """Return which derivatives are nonzero at any of several states (first axis).

    A NaN counts as a nonzero derivative.
    """
    return np.asarray(np.any(~(derivatives == 0), axis=0))


def _condition(reciprocal: np.ndarray) -> float:
    eps = np.finfo(reciprocal.dtype).eps
    return float(1 / reciprocal) if reciprocal > eps else float("inf")


@tracked_jit("system", "args")
def _measurements(system, t, q, u, args) -> dict[str, Any]:
    system = with_kept_functions(system, t, q, u, args)
    # NumPy's random numbers are constants of the program. JAX's random numbers would
    # take most of the compile time.
    shape = (2, _NUM_SAMPLES, u.shape[0])
    random = np.random.default_rng(0).normal(scale=_SPREAD, size=shape)
    xi, w = jnp.asarray(random, u.dtype)
    near = xi, u[None] + w * (1 + jnp.abs(u))[None]
    found = as_cpu_kernel(_derivatives, system, t, q, u, args, near, is_brief=True)
    rows, compatibility = found["jacobian"], found["delassus"]
    redundant, condition = jnp.zeros((), int), reciprocal_condition
    if system.constraints == "redundant":
        redundant = rows.shape[0] - rank_of_gram(compatibility)
        condition = reciprocal_condition_of_range
    return {
        **found,
        "regularity": reciprocal_condition(found["mass"]),
        "compatibility": condition(compatibility),
        "redundant": redundant,
        "deficient": is_deficient(rows),
    }


def _derivatives(system, t, q, u, args, near) -> dict[str, Any]:
    """Compute values and matrices at a state, and derivatives at states near it."""
    manifold = system.manifold_of(q)

    def hessian(t, xi, u):
        return system.metric(t, manifold.act(q, xi), u, args)

    def by_velocity(constraint):
        def derivative(t, xi, u):
            g = manifold.act(q, xi)
            return jax.jacfwd(constraint, argnums=2)(t, g, u, args)

        return derivative

    constraint_jacobian = by_velocity(system.kinematic_constraint)
    constraint_rows = by_velocity(system.constraint)

    def on_chart(name):
        def value(t, xi, u):
            g = manifold.act(q, xi)
            function, given = system.functions(t, g, u, multiplier, args)[name]
            return jnp.atleast_1d(function(*given))

        return value

    multiplier = None
    if system.force_takes_multipliers:
        multiplier = linearise(system, t, q, u, args).multiplier
    names = system.functions(t, q, u, multiplier, args)
    functions = {name: on_chart(name) for name in names}

    def sample(xi, u):
        point = (t, xi, u)
        by_time = {
            name: jax.jacfwd(function)(*point) for name, function in functions.items()
        }
        by_position = [
            jax.jacfwd(function, argnums=1)(*point) for function in functions.values()
        ]
        second = {
            key: max_norm(*jax.tree.leaves(jax.jacfwd(x, argnums=(0, 1, 2))(*point)))
            for key, x in ((_MASS, hessian), (_JACOBIAN, constraint_jacobian))
        }
        return by_time, jnp.concatenate(by_position), second

    by_time, by_position, second = jax.vmap(sample)(*near)
    rows = constraint_rows(t, jnp.zeros_like(u), u)
    # If a constraint is the square of an expression, its row is zero up to round-off at
    # states that satisfy the constraint. A row counts as zero if it is tiny compared to
    # the row at nearby states.
    rows_near = jax.vmap(constraint_rows, (None, 0, 0))(t, *near)
    elsewhere = jnp.max(jnp.abs(rows_near), axis=(0, 2))
    zero = jnp.finfo(u.dtype).eps ** 0.75 * elsewhere
    vanishes = jnp.max(jnp.abs(rows), axis=1) <= zero
    rows = jnp.where(vanishes[:, None], 0, rows)
    mass, rows = convert_to_velocities(system, hessian(t, jnp.zeros_like(u), u), rows)
    # `check_system` requires these values to be finite. The values of constraints are
    # returned separately.
    values = {
        name: function(t, jnp.zeros_like(u), u)
        for name, function in functions.items()
        if name in (system.generator, "force")
    }
    return {
        "values": values,
        "constraints": system.constraint(t, q, u, args),
        "position_constraints": system.position_constraint(t, q, args),
        "mass": mass,
        "jacobian": rows,
        "delassus": rows @ inverse(mass) @ rows.T,
        "by_time": by_time,
        "by_position": by_position,
        **second,
    }
