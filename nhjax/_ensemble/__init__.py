"""Ensembles that outgrow one call: chunks of members, and statistics on the way."""

from ._ensemble import ensemble as ensemble
from ._extremes import Maximum as Maximum, Minimum as Minimum
from ._histogram import Histogram as Histogram, HistogramCounts as HistogramCounts
from ._moments import Mean as Mean, Variance as Variance
from ._outcome import EnsembleOutcome as EnsembleOutcome
from ._reduction import AbstractReduction as AbstractReduction
