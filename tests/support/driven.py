"""A system that uses everything: time, a parameter, a force and `args`."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp

import nhjax


FIELD, FRICTION = 0.4, 0.25
ARGS = {"friction": jnp.asarray(FRICTION)}


class Driven(eqx.Module):
    """A mass that varies, a magnetic field, friction, and a moving constraint.

    L = ½ μ(t) (m₁ ẋ² + m₂ ẏ²) + ½ m₃ ż² + β x ẏ - ½ |q|² with μ = 1 + ½ sin t,
    Φ = ż - y ẋ - (1 + x) cos t and F = -γ v with γ = args["friction"].
    """

    masses: Any = 1.0
    field: Any = FIELD

    def lagrangian(self, t, q, v, args):
        """Masses may be one number or three."""
        mu = 1.0 + 0.5 * jnp.sin(t)
        energies = 0.5 * self.masses * v**2
        kinetic = mu * (energies[0] + energies[1]) + energies[2]
        return kinetic + self.field * q[0] * v[1] - 0.5 * (q @ q)

    def constraint(self, t, q, v, args):
        """Affine in the velocities, and explicit in time."""
        return v[2] - q[1] * v[0] - (1.0 + q[0]) * jnp.cos(t)

    def friction(self, t, q, v, args):
        """A force."""
        return -args["friction"] * v

    @property
    def system(self) -> nhjax.LagrangianSystem:
        """The complete system, with the parameters as leaves."""
        return nhjax.LagrangianSystem(
            self.lagrangian, nonholonomic=self.constraint, force=self.friction
        )


DRIVEN = Driven()


def driven_state():
    """A consistent state at t = 0."""
    q, v = jnp.array([0.5, -0.3, 0.2]), jnp.array([0.4, 0.6, 1.38])
    return nhjax.initial_state(DRIVEN.system, q, v=v, args=ARGS)
