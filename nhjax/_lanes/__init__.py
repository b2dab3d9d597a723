"""A closed jaxpr of one member, compiled to native code that runs many in lanes."""

from ._elementary_functions import (
    definition as definition,
    library as library,
    SUPPORTED as SUPPORTED,
    symbol as symbol,
)
from ._emission import member_ir as member_ir
from ._native import host_width as host_width, is_available as is_available
from ._registration import Held as Held, held as held, registered as registered
from ._target import single_target as single_target, target as target
from ._unsupported import Unsupported as Unsupported
