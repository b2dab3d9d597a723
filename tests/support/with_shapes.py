"""Run every feature as users do, with annotations of shapes checked.

A program: `python -m support.with_shapes` in `tests`.
"""

import runpy

from jaxtyping import install_import_hook

from support import shapes


if __name__ == "__main__":
    # Before anything of nhjax is imported.
    with install_import_hook(shapes.rooms_with_shapes(), "support.shapes.checked"):
        runpy.run_module("support.as_users_run", run_name="__main__")
