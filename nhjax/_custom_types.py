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

# L(t, q, v, args) -> (),  Φ(t, q, v, args) -> () or (m,),  F(t, q, v, args) -> (n,),
# and of (t, q, p, args) for Hamiltonian systems
PhaseFunction: TypeAlias = Callable[[Any, Any, Any, Any], Any]
# Γ(t, q, args) -> () or (k,)
PositionFunction: TypeAlias = Callable[[Any, Any, Any], Any]
