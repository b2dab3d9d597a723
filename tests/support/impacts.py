"""Motions with events in closed form, and as runs: a rod, a latch, a slide."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.integrate import quad
from scipy.optimize import brentq

import nhjax
from nhjax import Event, LobattoIIIAB


class Rod(NamedTuple):
    """A uniform rod with two tips that falls in a vertical plane onto the floor y = 0.

    Its state is (x, y, θ), with (x, y) the centre, and the rates; a tip that touches
    the floor gets a vertical impulse, by Newton's law with the coefficient of
    restitution.
    """

    mass: float = 1.3
    half: float = 0.5
    gravity: float = 1.1
    restitution: float = 0.7

    @property
    def inertia(self):
        return self.mass * self.half**2 / 3

    def flight(self, z, t):
        """The state at a time t after z, without an impact."""
        q, v = z
        fall = np.array([0.0, -self.gravity, 0.0])
        return q + t * v + 0.5 * t**2 * fall, v + t * fall

    def height(self, z, tip):
        q, _ = z
        return q[1] + tip * self.half * np.sin(q[2])

    def after_impact(self, z, tip):
        q, v = z
        arm = tip * self.half * np.cos(q[2])
        normal = np.array([0.0, 1.0, arm])
        inverse = np.array([1 / self.mass, 1 / self.mass, 1 / self.inertia])
        impulse = -(1 + self.restitution) * (normal @ v) / (normal @ (inverse * normal))
        return q, v + impulse * inverse * normal

    def bounces(self, z, end):
        """The impacts up to a time: (times, tips, states before), and the end."""
        t, times, tips, before = 0.0, [], [], []
        while True:
            found = [x for tip in (1, -1) if (x := self._touch(z, tip, end - t))]
            if not found:
                return np.array(times), tips, before, self.flight(z, end - t)
            dt, tip = min(found)
            t, z = t + dt, self.flight(z, dt)
            times.append(t)
            tips.append(tip)
            before.append(z)
            z = self.after_impact(z, tip)

    def _touch(self, z, tip, within):
        """The first time at which a tip comes down to the floor, and the tip."""
        times = np.linspace(0.0, within, 4000)[1:]
        heights = [self.height(self.flight(z, t), tip) for t in times]
        for k in range(1, len(times)):
            if heights[k - 1] > 0 >= heights[k]:
                root = brentq(
                    lambda t: self.height(self.flight(z, t), tip),
                    times[k - 1],
                    times[k],
                    xtol=1e-15,
                )
                return root, tip
        return None


class Latch(NamedTuple):
    """Two rotors on a shaft, the first on a spring, which lock together when they meet.

    The first starts from rest at the angle -a, the second waits at the angle b.
    """

    first: float = 0.8
    second: float = 0.5
    stiffness: float = 1.7
    a: float = 1.0
    b: float = 0.3

    def meeting(self):
        """The time at which the rotors meet, and their rates before and after."""
        nu = np.sqrt(self.stiffness / self.first)
        t = np.arccos(-self.b / self.a) / nu
        rate = self.a * nu * np.sin(nu * t)
        return t, rate, rate * self.first / (self.first + self.second)

    def locked(self, t):
        """The common angle and rate a time t after they have met."""
        nu = np.sqrt(self.stiffness / (self.first + self.second))
        _, _, rate = self.meeting()
        c, s = np.cos(nu * t), np.sin(nu * t)
        return self.b * c + rate / nu * s, -self.b * nu * s + rate * c


class Slide(NamedTuple):
    """A particle that slides down a sphere of radius 1 and leaves it."""

    angle: float = 0.1
    rate: float = 0.3
    gravity: float = 1.0

    @property
    def cosine(self):
        """The cosine of the angle from the top at which the pressure vanishes."""
        return (2 * np.cos(self.angle) + self.rate**2 / self.gravity) / 3

    @property
    def time(self):
        """The time until the pressure vanishes, from the energy."""

        def slowness(x):
            fall = np.cos(self.angle) - np.cos(x)
            return 1 / np.sqrt(self.rate**2 + 2 * self.gravity * fall)

        end = np.arccos(self.cosine)
        return quad(slowness, self.angle, end, epsabs=1e-13, epsrel=1e-13)[0]


ROD, SLIDE = Rod(), Slide()
START = np.array([0.2, 1.0, 0.4]), np.array([0.3, 0.2, 1.5])


def turned(q, v, back=1.0):
    """Turn a planar velocity from the body to space; with `back` = -1, the reverse."""
    c, s = jnp.cos(q[2]), back * jnp.sin(q[2])
    return jnp.stack([c * v[0] - s * v[1], s * v[0] + c * v[1], v[2]])


def rod_system(manifold=None):
    masses = jnp.array([ROD.mass, ROD.mass, ROD.inertia])
    return nhjax.LagrangianSystem(
        lambda t, q, v, args: (
            0.5 * jnp.sum(masses * v**2) - ROD.mass * ROD.gravity * q[1]
        ),
        manifold=manifold,
    )


def impact(tip, on_group=False):
    def height(t, y, args):
        return y.q[1] + tip * ROD.half * jnp.sin(y.q[2])

    def reset(t, y, args):
        v = turned(y.q, y.v) if on_group else y.v
        arm = tip * ROD.half * jnp.cos(y.q[2])
        normal = jnp.stack([jnp.zeros_like(arm), jnp.ones_like(arm), arm])
        inverse = jnp.array([1 / ROD.mass, 1 / ROD.mass, 1 / ROD.inertia])
        impulse = (1 + args) * (normal @ v) / (normal @ (inverse * normal))
        v = v - impulse * inverse * normal
        return y.q, turned(y.q, v, -1.0) if on_group else v

    return Event(height, direction=False, reset=reset, max_events=8)


def rod_run(
    on_group, method, dt, num_steps, q, v, restitution, tips=(1, -1), **options
):
    """Run the rod, in coordinates of the plane or on the group of its motions."""
    system = rod_system(nhjax.SE2() if on_group else None)
    v = turned(q, v, -1.0) if on_group else v
    return nhjax.integrate(
        system,
        method,
        nhjax.initial_state(system, q, v),
        dt=dt,
        num_steps=num_steps,
        args=restitution,
        event=[impact(tip, on_group) for tip in tips],
        **options,
    )


def slide(stages, dt, gravity: Any = 1.0, closure="symmetric", **options: Any):
    """Run the slide until the sphere's pressure, its multiplier, changes sign."""
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v - args * q[2],
        holonomic=lambda t, q, args: 0.5 * (q @ q - 1.0),
    )
    s, c = np.sin(SLIDE.angle), np.cos(SLIDE.angle)
    q, v = jnp.array([s, 0.0, c]), SLIDE.rate * jnp.array([c, 0.0, -s])
    y0 = nhjax.initial_state(system, q, v, args=gravity, project=True)
    return nhjax.integrate(
        system,
        LobattoIIIAB(stages, closure),
        y0,
        dt=dt,
        num_steps=round(3 / dt),
        args=gravity,
        event=Event(lambda t, y, args: y.multiplier[0]),
        **options,
    )
