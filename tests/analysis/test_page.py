"""The analysis page: its code blocks run and print the results shown."""

import jax.numpy as jnp
import numpy as np

from support.pages import blocks, page, run_page


def test_analysis_page_when_run_prints_as_shown():
    namespace = run_page("analysis")
    (printed,) = blocks(page("analysis"), "text")
    assert str(namespace["report"]) == printed.removesuffix("\n")
    # The force on the disc rotates with its heading and keeps its magnitude.
    pull = jnp.linalg.norm(namespace["sol"].ys[:, :2], axis=1)
    np.testing.assert_allclose(pull, pull[0], rtol=1e-12)
    assert float(pull[0]) > 0.5
