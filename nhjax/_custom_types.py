"""Aliases for the arrays and scalars that appear in public signatures."""

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Array, Bool, Float, Int


FloatScalar: TypeAlias = Float[Array, ""]
FloatScalarLike: TypeAlias = float | int | Float[Array, ""] | np.ndarray
IntScalar: TypeAlias = Int[Array, ""]
BoolScalar: TypeAlias = Bool[Array, ""]
Args: TypeAlias = Any

# The functions L(t, q, v, args) of shape () and Φ(t, q, v, args) of shape () or (m,);
# for Hamiltonian systems they take (t, q, p, args).
PhaseFunction: TypeAlias = Callable[[Any, Any, Any, Any], Any]
# The force F(t, q, v, args) or F(t, q, v, multipliers, args), of shape (n,).
ForceFunction: TypeAlias = Callable[..., Any]
# The holonomic constraints Γ(t, q, args), of shape () or (k,).
PositionFunction: TypeAlias = Callable[[Any, Any, Any], Any]
