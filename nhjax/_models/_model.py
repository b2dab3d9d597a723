"""The outcome of an import from SymPy: a system, its parameters and its names."""

import math
import numbers
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Args, FloatScalarLike
from .._errors import is_traced, ShapeError
from .._initial import initial_state
from .._system import LagrangianSystem, State
from ._printed import parameter_values


class SymPyModel(eqx.Module):
    """A model that `from_sympy` has imported.

    - `system`: the system, whose `args` are a dictionary of the parameters by name.
    - `args`: the values that were given for parameters.
    - `coordinates`: the names of the coordinates, in the order of q.
    - `parameters`: the names of all parameters.
    """

    system: LagrangianSystem
    args: dict[str, Array]
    coordinates: tuple[str, ...] = eqx.field(static=True)
    parameters: tuple[str, ...] = eqx.field(static=True)

    def initial_state(
        self,
        q: Mapping[Any, FloatScalarLike] | Float[Array, " n"],
        v: Mapping[Any, FloatScalarLike] | Float[Array, " n"],
        *,
        t: FloatScalarLike = 0.0,
        args: Args = None,
        project: bool = False,
        keep_q: Any = None,
        keep_v: Any = None,
    ) -> State:
        """Make a consistent state, as `nhjax.initial_state` does.

        **Arguments:**

        - `q`, `v`: coordinates and velocities, as arrays, or as dictionaries by the
            names of coordinates, or by the coordinates of SymPy themselves; those that
            are left out are zero.
        - `t`: the time.
        - `args`: the parameters, those of the model by default.
        - `project`: move the state to the constraints.
        - `keep_q`, `keep_v`: the coordinates and velocities that the projection must
            not change: indices, names or coordinates of SymPy, one or several.

        **Returns:** a `State`.

        **Raises:** as `nhjax.initial_state`; `ValueError` for unknown names and those
        given twice; `TypeError` for parameters that are no real numbers.
        """
        q, v = self._array("q", q), self._array("v", v)
        args = self.args if args is None else args
        # Before JAX sorts the keys, which it cannot if they are symbols.
        parameter_values(self.parameters, args)
        return initial_state(
            self.system,
            q,
            v,
            t=t,
            args=args,
            project=project,
            keep_q=_with_names(keep_q),
            keep_v=_with_names(keep_v),
        )

    def _array(self, name: str, given: Any) -> Array:
        if not isinstance(given, Mapping):
            return given
        values = _by_name(f"`{name}`", given)
        unknown = [key for key in values if key not in self.coordinates]
        if unknown:
            raise ValueError(
                f"`{name}` has {', '.join(unknown)}, but the coordinates are "
                f"{', '.join(self.coordinates)}."
            )
        found = [values.get(key, 0.0) for key in self.coordinates]
        made = [jnp.asarray(x, jnp.result_type(float)) for x in found]
        for key, x in zip(self.coordinates, made, strict=True):
            if x.shape != ():
                raise ShapeError(
                    f"`{name}[{key!r}]` has shape {x.shape}, but a coordinate is a "
                    "scalar; for several states use `jax.vmap`."
                )
        return jnp.stack(made)


def _with_names(chosen: Any) -> Any:
    """Replace coordinates of SymPy, alone or in a sequence, by their names."""
    if isinstance(chosen, (list, tuple, set, frozenset)):
        return [_name(x) for x in chosen]
    return _name(chosen)


def _name(x: Any) -> Any:
    """Return the name of a symbol or a coordinate q(t), and anything else as it is."""
    return x if isinstance(x, str) else getattr(x, "name", x)


def _by_name(where: str, given: Mapping[Any, Any]) -> dict[str, Any]:
    """Key a dictionary by names, where symbols and coordinates q(t) were keys."""
    values = {}
    for key, value in given.items():
        name = str(_name(key))
        if name in values:
            raise ValueError(f"{where} has {name} twice.")
        values[name] = value
    return values


def parameter_defaults(
    parameters: Mapping[Any, Any], known: tuple[str, ...]
) -> dict[str, Array]:
    """Return the values of parameters by name, as arrays that suit any precision."""
    if not isinstance(parameters, Mapping):
        raise TypeError(
            "from_sympy: `parameters` must be a dictionary of values by symbol or "
            f"name, got {parameters!r}."
        )
    values = {}
    for name, value in _by_name("from_sympy: `parameters`", parameters).items():
        if name not in known:
            raise ValueError(
                f"from_sympy: `parameters` has {name}, but the symbols of the model "
                f"are {', '.join(known) or 'none'}."
            )
        if not eqx.is_array_like(value) or jnp.iscomplexobj(value):
            # Such as a number of SymPy.
            value = _number(name, value)
        value = float(value) if isinstance(value, numbers.Real) else value
        values[name] = jnp.asarray(value)
        if values[name].shape != ():
            raise ShapeError(
                f"from_sympy: `parameters[{name!r}]` has shape {values[name].shape}, "
                "but a parameter is a scalar; for several values use `jax.vmap` over "
                "`args`."
            )
        if not is_traced(value) and not math.isfinite(np.asarray(value)):
            raise ValueError(f"from_sympy: `parameters[{name!r}]` is {value}.")
    return values


def _number(name: str, value: Any) -> float:
    try:
        if isinstance(value, str):
            raise TypeError
        return float(value)
    except (TypeError, ValueError):
        raise TypeError(
            f"from_sympy: `parameters[{name!r}]` must be a real number, got {value!r}."
        ) from None
