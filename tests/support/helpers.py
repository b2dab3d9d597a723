"""Systems and runs that several test files share."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import nhjax
from nhjax import systems
from support.driven import ARGS, DRIVEN, driven_state


CVT = systems.ContinuouslyVariableTransmission

CLOSURES = ("propagated", "consistent", "symmetric")
# Without a fallback, a failed run does not compile Newton's method as well.
SOLVERS = {
    "simplified": nhjax.SimplifiedNewton(fallback=False),
    "dense": nhjax.Newton(),
}

GALLERY = {
    "particle": systems.NonholonomicParticle(1.7, 0.6),
    "sleigh": systems.ChaplyginSleigh(1.3, 0.2, 0.3),
    "knife edge": systems.KnifeEdge(),
    "rolling disc": systems.VerticalRollingDisc(
        1.2, 0.5, 0.25, 0.8, v0=(1.04, 0, 1.3, 0.7)
    ),
    "Appell": systems.Appell(1.4, 0.7, 0.5),
    "CVT low": CVT.low(),
    "CVT high": CVT.high(),
    "chaotic": systems.ChaoticSystem(),
    "oscillator": systems.HarmonicOscillator(),
}


def gallery_state(name):
    """The system and the initial state of an example, without `args`."""
    return GALLERY[name].system, GALLERY[name].initial_state()


BESIDE = ("particle", "chaotic", "sleigh", "Appell")
_ENDS = np.cumsum([GALLERY[name].q0.size for name in BESIDE])


def parts_side_by_side(x):
    """The part of each system in positions or velocities of `SIDE_BY_SIDE`."""
    return jnp.split(x, _ENDS)


def _beside_lagrangian(t, q, v, args):
    pieces = list(zip(parts_side_by_side(q), parts_side_by_side(v), strict=True))
    total = DRIVEN.lagrangian(t, *pieces.pop(), args)
    for name, (q_part, v_part) in zip(BESIDE, pieces, strict=True):
        total = total + GALLERY[name].lagrangian(t, q_part, v_part, None)
    return total


def _beside_constraint(t, q, v, args):
    pieces = list(zip(parts_side_by_side(q), parts_side_by_side(v), strict=True))
    last = DRIVEN.constraint(t, *pieces.pop(), args)
    values = [
        GALLERY[name].constraint(t, q_part, v_part, None)
        for name, (q_part, v_part) in zip(BESIDE, pieces, strict=True)
    ]
    return jnp.concatenate([jnp.atleast_1d(value) for value in [*values, last]])


def _beside_friction(t, q, v, args):
    parts = parts_side_by_side(v)
    rest = [jnp.zeros_like(part) for part in parts[:-1]]
    return jnp.concatenate([*rest, DRIVEN.friction(t, q, parts[-1], args)])


# One program for five uncoupled systems: n = 19, m = 5.
SIDE_BY_SIDE = nhjax.LagrangianSystem(
    _beside_lagrangian, nonholonomic=_beside_constraint, force=_beside_friction
)


def side_by_side_state():
    """The consistent states of `BESIDE` and of the driven system, one after another."""
    states = [gallery_state(name)[1] for name in BESIDE] + [driven_state()]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *states)


class SideBySide(eqx.Module):
    """Uncoupled examples as one system on a product manifold."""

    examples: tuple

    @property
    def manifold(self):
        """The product of the examples' manifolds."""
        return nhjax.ProductGroup(*(e.system.manifold_of(e.q0) for e in self.examples))

    def parts(self, x):
        """Each example's part of the last axis of velocities or momenta."""
        ends = np.cumsum([example.v0.size for example in self.examples])
        return jnp.split(x, ends[:-1], axis=-1)

    def lagrangian(self, t, q, v, args):
        """The sum of the Lagrangians."""
        terms = zip(self.examples, q, self.parts(v), strict=True)
        return sum(example.lagrangian(t, g, u, args) for example, g, u in terms)

    def nonholonomic(self, t, q, v, args):
        """The nonholonomic constraints one after another."""
        terms = zip(self.examples, q, self.parts(v), strict=True)
        return jnp.concatenate(
            [
                jnp.atleast_1d(example.system.nonholonomic(t, g, u, args))
                for example, g, u in terms
                if example.system.nonholonomic is not None
            ]
        )

    def holonomic(self, t, q, args):
        """The holonomic constraints one after another."""
        return jnp.concatenate(
            [
                jnp.atleast_1d(example.system.holonomic(t, g, args))
                for example, g in zip(self.examples, q, strict=True)
                if example.system.holonomic is not None
            ]
        )

    def multipliers(self, x):
        """Each example's part of the last axis of multipliers.

        Multipliers of all nonholonomic constraints come before those of holonomic ones.
        """
        rows, end = [[] for _ in self.examples], 0
        for kind in ("nonholonomic", "holonomic"):
            for mine, example in zip(rows, self.examples, strict=True):
                if (function := getattr(example.system, kind)) is not None:
                    velocity = [example.v0] if kind == "nonholonomic" else []
                    size = jnp.size(function(0.0, example.q0, *velocity, None))
                    mine.extend(range(end, end + size))
                    end += size
        return [x[..., np.array(mine, int)] for mine in rows]

    def system(self, force=None):
        """The system of all examples, with the kinds of constraints that occur."""
        kinds = {
            kind: getattr(self, kind)
            for kind in ("nonholonomic", "holonomic")
            if any(getattr(e.system, kind) is not None for e in self.examples)
        }
        return nhjax.LagrangianSystem(
            self.lagrangian, manifold=self.manifold, force=force, **kinds
        )

    def initial_state(self, system, **others):
        """The initial state of all examples together."""
        q = tuple(example.q0 for example in self.examples)
        v = jnp.concatenate([example.v0 for example in self.examples])
        return nhjax.initial_state(system, q, v, **others)


@cache
def problem(name):
    """(system, y0, args) by name."""
    if name == "driven":
        return DRIVEN.system, driven_state(), ARGS
    if name == "side by side":
        return SIDE_BY_SIDE, side_by_side_state(), ARGS
    return *gallery_state(name), None


RECORDED_STEP, RECORDED_STEPS = 0.1, 20


def integrate_recorded(name, stages, closure, solver, y0, dt, t0=0.0, throw=True):
    """A run with all nodes and all stage data: one program for every `y0`, `dt`."""
    system, _, args = problem(name)
    return nhjax.integrate(
        system,
        nhjax.LobattoIIIAB(stages, closure),
        y0,
        dt=dt,
        num_steps=RECORDED_STEPS,
        t0=t0,
        args=args,
        stage_solver=SOLVERS[solver],
        throw=throw,
        saveat=nhjax.SaveAt(t0=True, steps=True, dense=True),
    )


@cache
def recorded(name, stages, closure, solver):
    """The run of a problem from its initial state."""
    y0 = problem(name)[1]
    return integrate_recorded(name, stages, closure, solver, y0, RECORDED_STEP)


def direction(tree, seed=0):
    """A random direction in the space of `tree`, scaled by the size of each leaf."""
    rng = np.random.default_rng(seed)

    def leaf(x):
        size = max(float(jnp.max(jnp.abs(x), initial=0.0)), 0.3)
        signs = rng.choice([-1.0, 1.0], x.shape)
        return jnp.asarray(size * signs * rng.uniform(0.3, 1.0, x.shape), x.dtype)

    return jax.tree.map(leaf, tree)


def moved(tree, along, epsilon):
    """The tree, `epsilon` along a direction."""
    return jax.tree.map(lambda x, d: x + epsilon * d, tree, along)


def dot(first, second):
    """The scalar product of two trees."""
    products = jax.tree.map(lambda x, y: jnp.sum(x * y), first, second)
    return sum(jax.tree.leaves(products))


def central_difference(function, epsilon):
    """The derivative at 0 of a function of a float, to order 6."""
    odd = [
        np.asarray(function(k * epsilon)) - np.asarray(function(-k * epsilon))
        for k in (1, 2, 3)
    ]
    return (45 * odd[0] - 9 * odd[1] + odd[2]) / (60 * epsilon)


def scalar(tree, seed=1):
    """A smooth scalar that depends on every number in a tree."""
    rng = np.random.default_rng(seed)
    return sum(
        jnp.sum(jnp.asarray(rng.uniform(0.5, 1.5, x.shape), x.dtype) * jnp.sin(x))
        for x in jax.tree.leaves(tree)
    )


def twice_constrained_pendulum():
    """A pendulum whose rod is written twice, and its start."""
    pendulum = systems.SphericalPendulum()

    def twice(t, q, args):
        return jnp.stack([pendulum.holonomic(t, q, args), q @ q - 1.0])

    system = nhjax.LagrangianSystem(
        pendulum.lagrangian, holonomic=twice, constraints="redundant"
    )
    return system, nhjax.initial_state(system, pendulum.q0, pendulum.v0)
