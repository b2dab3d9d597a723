"""Methods: tableaux, their order conditions and their closures of the multipliers."""

from nhjax._method._abstract import AbstractMethod as AbstractMethod
from nhjax._method._collocation import Gauss as Gauss, LobattoIIIAB as LobattoIIIAB
from nhjax._method._partitioned import PartitionedRungeKutta as PartitionedRungeKutta
