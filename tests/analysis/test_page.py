"""The page about this room: its blocks run as printed, and are right."""

import jax.numpy as jnp
import numpy as np

from oracles.pages import blocks, page, run_page


def test_the_page_runs_as_printed():
    namespace = run_page("analysis")
    (printed,) = blocks(page("analysis"), "text")
    assert str(namespace["report"]) == printed.removesuffix("\n")
    # The pull on the disc turns with its heading, and keeps its size.
    pull = jnp.linalg.norm(namespace["sol"].ys[:, :2], axis=1)
    np.testing.assert_allclose(pull, pull[0], rtol=1e-12)
    assert float(pull[0]) > 0.5
