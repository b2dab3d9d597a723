from ._abstract import AbstractLieGroup as AbstractLieGroup
from ._euclidean import Euclidean as Euclidean
