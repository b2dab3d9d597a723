"""The page about this room: its blocks run as printed, and are right."""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from oracles.pages import blocks


PAGE = Path(__file__).parents[2] / "docs" / "analysis.md"


def test_the_page_runs_as_printed():
    text = PAGE.read_text(encoding="utf-8")
    namespace: dict[str, Any] = {"__name__": "analysis"}
    for block in blocks(text):
        exec(compile(block, PAGE.name, "exec"), namespace)
    (printed,) = blocks(text, "text")
    assert str(namespace["report"]) == printed.removesuffix("\n")
    # The pull on the disc turns with its heading, and keeps its size.
    pull = jnp.linalg.norm(namespace["sol"].ys[:, :2], axis=1)
    np.testing.assert_allclose(pull, pull[0], rtol=1e-12)
    assert float(pull[0]) > 0.5
