from ._abstract import AbstractMechanicalSystem as AbstractMechanicalSystem
from ._hamiltonian import HamiltonianSystem as HamiltonianSystem
from ._lagrangian import LagrangianSystem as LagrangianSystem
