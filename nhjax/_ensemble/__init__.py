"""Ensembles: runs of many members in chunks, with statistics and resumable stores."""

from ._ensemble import ensemble as ensemble
from ._reductions import (
    AbstractReduction as AbstractReduction,
    Histogram as Histogram,
    HistogramCounts as HistogramCounts,
    Maximum as Maximum,
    Mean as Mean,
    Minimum as Minimum,
    Variance as Variance,
)
from ._sinks import EnsembleOutcome as EnsembleOutcome
