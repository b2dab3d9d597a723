"""The methods: their tableaux, order conditions and closures of the multipliers."""

from ._methods import (
    AbstractMethod as AbstractMethod,
    CLOSURES as CLOSURES,
    Gauss as Gauss,
    LobattoIIIAB as LobattoIIIAB,
    PartitionedRungeKutta as PartitionedRungeKutta,
)
