"""The page about this room: its blocks run as printed, and are right."""

import re
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np


PAGE = Path(__file__).parents[2] / "docs" / "analysis.md"


def test_the_page_runs_as_printed():
    text = PAGE.read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    namespace: dict[str, Any] = {"__name__": "analysis"}
    for block in blocks:
        exec(compile(block, PAGE.name, "exec"), namespace)
    (printed,) = re.findall(r"^```text\n(.*?)\n```$", text, re.MULTILINE | re.DOTALL)
    assert str(namespace["report"]) == printed
    # The pull on the disc turns with its heading, and keeps its size.
    pull = jnp.linalg.norm(namespace["sol"].ys[:, :2], axis=1)
    np.testing.assert_allclose(pull, pull[0], rtol=1e-12)
    assert float(pull[0]) > 0.5
