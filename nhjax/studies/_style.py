"""The colours of the figures of studies."""

import contextlib
from collections.abc import Iterator


# Okabe and Ito: the colour-blind tell them apart, and so does a grey printer mostly.
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#000000")


@contextlib.contextmanager
def colour_blind_safe() -> Iterator[None]:
    """Draw and save figures within this, for colours that everyone tells apart."""
    import matplotlib
    from cycler import cycler

    with matplotlib.rc_context({"axes.prop_cycle": cycler(color=COLOURS)}):
        yield
