"""The methods: their tableaux, order conditions and closures of the multipliers."""

from ._abstract import AbstractMethod as AbstractMethod, CLOSURES as CLOSURES
from ._collocation import Gauss as Gauss, LobattoIIIAB as LobattoIIIAB
from ._partitioned import PartitionedRungeKutta as PartitionedRungeKutta
