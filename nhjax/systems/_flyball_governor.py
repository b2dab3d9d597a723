"""Watt's flyball governor."""

import math
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._custom_types import Args, FloatScalarLike
from .._system import LagrangianSystem
from ._base import (
    AbstractExample,
    coordinates,
    given_forces,
    parameter,
    require_positive,
    require_possible,
    require_shape,
)


class FlyballGovernor(AbstractExample):
    """A turning shaft with two hinged rods, whose flyballs lift a slider on the shaft.

    L = (J_s + J_m)/2 φ̇² + m/2 ṡ² - m g s + Σ_{k=1,2} (m_r/2 |ċ_k|² + M/2 |ḃ_k|²
    + B/2 |u̇_k|² + A/2 φ̇² sin² β_k - g (m_r c_k + M b_k) · e_z) - V.

    Here q = (φ, β₁, β₂, s): the angle of the shaft and the angles of the rods below the
    horizontal [rad], and the height of the slider [m], which turns with the shaft. Each
    rod has the direction u_k = ± cos β_k e(φ) - sin β_k e_z, with the horizontal unit
    vector e(φ), and its hinge p_k is at the radius a and the height h. The centre of
    the rod is c_k = p_k + ½ l u_k, and its ball is b_k = p_k + l u_k.

    A coupler of length d ties the middle of each rod to the slider at the radius a; d_k
    is the distance between its ends. The couplers are either rigid rods
    (`couplers="rods"`), with V = 0 and Φ_k = d_k² - d², or springs with dampers
    (`"springs"`), with V = Σ K/2 (d_k - d)² and the forces -C ḋ_k. With springs and the
    published parameters, the system is stiff.

    `args` is None or the torque on the shaft [N m], a scalar.

    **Parameters:** `shaft_inertia` J_s, `slider_inertia` J_m, `rod_inertias` (A, B)
    along and across a rod [kg m²]; `slider_mass` m, `rod_mass` m_r, `ball_mass` M [kg];
    `rod_length` l, `coupler_length` d, `arm` a, `height` h [m]; `stiffness` K [N/m],
    `damping` C [N s/m]; `gravity` g [m/s²]; `couplers`.

    **Source:** González, Dopico, Lugrís and Cuadrado, *A benchmarking system for MBS
    simulation software* (2006), problem A05, and the problem "stiff flyball governor"
    of the IFToMM library of computational benchmark problems.

    !!! example

        >>> from nhjax.systems import FlyballGovernor
        >>> governor = FlyballGovernor.turning(angle=0.6, rate=5.0)
        >>> system, y0 = governor.system, governor.initial_state()
        >>> round(float(y0.multiplier[0]), 3)
        -29.359
    """

    shaft_inertia: Array = eqx.field(converter=parameter, default=5e-6)
    slider_inertia: Array = eqx.field(converter=parameter, default=5e-3)
    rod_inertias: Array = eqx.field(converter=coordinates, default=(5e-6, 0.0250025))
    slider_mass: Array = eqx.field(converter=parameter, default=3.0)
    rod_mass: Array = eqx.field(converter=parameter, default=0.3)
    ball_mass: Array = eqx.field(converter=parameter, default=5.0)
    rod_length: Array = eqx.field(converter=parameter, default=1.0)
    coupler_length: Array = eqx.field(converter=parameter, default=0.5)
    arm: Array = eqx.field(converter=parameter, default=0.05)
    height: Array = eqx.field(converter=parameter, default=1.0)
    stiffness: Array = eqx.field(converter=parameter, default=8e5)
    damping: Array = eqx.field(converter=parameter, default=4e4)
    gravity: Array = eqx.field(converter=parameter, default=9.81)
    couplers: Literal["rods", "springs"] = eqx.field(
        static=True, default="rods", kw_only=True
    )
    q0: Array = eqx.field(
        converter=coordinates,
        default=(0.0, math.pi / 6, math.pi / 6, 0.5),
        kw_only=True,
    )
    v0: Array = eqx.field(
        converter=coordinates, default=(2 * math.pi, 0.0, 0.0, 0.0), kw_only=True
    )

    def __check_init__(self) -> None:
        require_shape((2,), rod_inertias=self.rod_inertias)
        require_shape((4,), q0=self.q0, v0=self.v0)
        require_positive(
            shaft_inertia=self.shaft_inertia,
            slider_inertia=self.slider_inertia,
            rod_inertias=self.rod_inertias,
            slider_mass=self.slider_mass,
            rod_mass=self.rod_mass,
            ball_mass=self.ball_mass,
            rod_length=self.rod_length,
            coupler_length=self.coupler_length,
        )
        if self.couplers not in ("rods", "springs"):
            raise ValueError(
                f'`couplers` must be "rods" or "springs", got {self.couplers!r}.'
            )

    @classmethod
    def turning(
        cls,
        angle: ArrayLike,
        rate: ArrayLike,
        angle_rate: ArrayLike = 0.0,
        **parameters: Any,
    ) -> "FlyballGovernor":
        """Create a governor with both rods at `angle` and a shaft that turns at `rate`.

        The slider is below the middles of the rods, at the height at which both
        couplers have the length d. `parameters` are the parameters of the class.
        """
        governor = cls(**parameters)
        dtype = governor.q0.dtype
        beta, dbeta, dphi = (jnp.asarray(x, dtype) for x in (angle, angle_rate, rate))
        half, coupler = 0.5 * governor.rod_length, governor.coupler_length

        def slider(beta):
            fall = jnp.sqrt(coupler**2 - (half * jnp.cos(beta)) ** 2)
            return governor.height - half * jnp.sin(beta) - fall

        s, ds = jax.jvp(slider, (beta,), (dbeta,))
        require_possible(
            jnp.isfinite(s),
            f"`coupler_length` {coupler} does not reach from rod to slider.",
        )
        start: dict[str, Any] = {
            "q0": jnp.stack([jnp.zeros_like(beta), beta, beta, s]),
            "v0": jnp.stack([dphi, dbeta, dbeta, ds]),
        }
        return cls(**(parameters | start))

    @property
    def system(self) -> LagrangianSystem:
        """Return the system to integrate; its pytree leaves are the parameters."""
        rigid = self.couplers == "rods"
        return LagrangianSystem(
            self.lagrangian,
            holonomic=self.holonomic if rigid else None,
            force=self.force,
        )

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian, kinetic minus potential energy."""
        hinges_and_rods, rates = jax.jvp(self._rods, (q,), (v,))
        axial, transverse = self.rod_inertias.astype(v.dtype)
        inertia = self.shaft_inertia + self.slider_inertia
        twice = inertia * v[0] ** 2 + self.slider_mass * v[3] ** 2
        weight = self.slider_mass * q[3]
        for mass, share in ((self.rod_mass, 0.5), (self.ball_mass, 1.0)):
            reach = share * self.rod_length
            (hinge, rod), (dhinge, drod) = hinges_and_rods, rates
            twice = twice + mass * jnp.sum((dhinge + reach * drod) ** 2)
            weight = weight + mass * jnp.sum((hinge + reach * rod)[:, 2])
        twice = twice + transverse * jnp.sum(rates[1] ** 2)
        twice = twice + axial * v[0] ** 2 * jnp.sum(jnp.sin(q[1:3]) ** 2)
        return 0.5 * twice - self.gravity * weight - self._strain(q)

    def holonomic(self, t: FloatScalarLike, q: Array, args: Args) -> Array:
        """Compute the constraints Φ_k = d_k² - d² of rigid couplers."""
        return self._square_distances(q) - self.coupler_length**2

    def force(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the generalised force of the dampers and of the torque `args`."""
        torque = given_forces(args, (), v.dtype, "a torque on the shaft")
        driving = jnp.zeros_like(v).at[0].set(torque)
        if self.couplers == "rods":
            return driving

        def distances(q):
            return jnp.sqrt(self._square_distances(q))

        _, rates = jax.jvp(distances, (q,), (v,))
        (resisting,) = jax.vjp(distances, q)[1](-self.damping * rates)
        return driving + resisting

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the vertical angular momentum and, without springs, the energy."""
        momentum = jax.grad(self.lagrangian, argnums=2)(t, q, v, None)
        conserved = {"vertical_momentum": momentum[0]}
        if self.couplers == "springs":
            return conserved
        return conserved | {"energy": self.energy(t, q, v)}

    def points(self, t: FloatScalarLike, q: Array) -> dict[str, Array]:
        """Compute the positions of hinges, rod middles, balls and slider joints."""
        hinges, rods = self._rods(q)
        lifted = hinges.at[:, 2].set(q[3])
        places = {
            "hinge": hinges,
            "middle": hinges + 0.5 * self.rod_length * rods,
            "ball": hinges + self.rod_length * rods,
            "slider": lifted,
        }
        return {
            f"{name}_{k + 1}": place[k]
            for name, place in places.items()
            for k in (0, 1)
        }

    def _rods(self, q: Array) -> tuple[Float[Array, "2 3"], Float[Array, "2 3"]]:
        """Compute the hinges p_k, and the unit vectors u_k along the rods."""
        outward = jnp.stack([jnp.cos(q[0]), jnp.sin(q[0])])
        radial = jnp.stack([outward, -outward])
        cos, sin = jnp.cos(q[1:3])[:, None], jnp.sin(q[1:3])[:, None]
        hinges = self.height * jnp.ones_like(sin)
        hinges = jnp.concatenate([self.arm * radial, hinges], axis=1)
        return hinges, jnp.concatenate([cos * radial, -sin], axis=1)

    def _square_distances(self, q: Array) -> Float[Array, " 2"]:
        """Compute d_k², the squared distances from rod middles to the slider."""
        half = 0.5 * self.rod_length
        fall = self.height - q[3] - half * jnp.sin(q[1:3])
        return (half * jnp.cos(q[1:3])) ** 2 + fall**2

    def _strain(self, q: Array) -> Array:
        if self.couplers == "rods":
            return jnp.zeros_like(q[0])
        stretch = jnp.sqrt(self._square_distances(q)) - self.coupler_length
        return 0.5 * self.stiffness * jnp.sum(stretch**2)
